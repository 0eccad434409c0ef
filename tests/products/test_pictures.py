"""Pictures of the report."""

import box_world
import numba
import numpy as np
import pytest

from lvba import geometry
from lvba.kernels import splats, zbuffer
from lvba.products import evaluate, pictures


@pytest.fixture(scope="module")
def made():
    world = box_world.make()
    rng = np.random.default_rng(1)
    shaken = geometry.retract(world.world_from_camera, rng.normal(0, [0.03] * 3 + [0.05] * 3, (6, 6)))
    rough = evaluate.State(world.cloud(), world.views(shaken, np.zeros(6)))
    refined = evaluate.State(world.cloud(), world.views())
    scores = evaluate.evaluate({"rough": rough, "refined": refined})
    return pictures.make(rough, refined, scores)


def test_the_best_the_middling_and_the_worst_image_are_shown(made):
    assert len(made.views) == 3
    gains = [picture.psnr_after - picture.psnr_before for picture in made.views]
    assert gains[0] > 0
    assert gains[0] >= gains[1] >= gains[2]
    for picture in made.views:
        assert picture.raw.shape == picture.before.shape == picture.after.shape == (72, 96, 3)


def test_crops_show_where_most_changed(made):
    assert 1 <= len(made.crops) <= 4
    for crop in made.crops:
        assert crop.raw.shape == (24, 32, 3)
        assert crop.psnr_after > crop.psnr_before


def test_the_report_begins_where_the_gain_shows_most(made):
    best = made.best
    assert best.raw.shape == best.before.shape == best.after.shape == (43, 57, 3)
    assert best.psnr_after > best.psnr_before


def test_brightness_alone_does_not_choose_the_place():
    """On the left the map was shifted before; on the right it was only dark."""
    rng = np.random.default_rng(5)
    raw = np.repeat(rng.integers(60, 200, (60, 160, 1)), 3, axis=2).astype(np.uint8)
    before = raw.astype(np.float32)
    before[:, :80] = np.roll(before[:, :80], 3, axis=1)
    before[:, 80:] -= 60
    covered = np.ones(raw.shape[:2], bool)
    shown = [pictures._Shown(raw, one, one, covered) for one in (before, raw.astype(np.float32))]
    _, place = pictures._where_it_shows(shown, covered)
    assert place[1].stop <= 84


@pytest.mark.filterwarnings("error")
def test_a_black_area_of_the_photograph_is_no_place_where_detail_shows():
    """Sums over its windows come out slightly below zero, as differences of sums over all that is above and before it."""
    rng = np.random.default_rng(5)
    raw = np.repeat(rng.integers(60, 200, (240, 640, 1)), 3, axis=2).astype(np.uint8)
    raw[:, 240:] = 0
    before = np.roll(raw.astype(np.float32), 3, axis=1)
    before[:, 240:] = 0
    covered = np.ones(raw.shape[:2], bool)
    shown = [pictures._Shown(raw, one, one, covered) for one in (before, raw.astype(np.float32))]
    _, place = pictures._where_it_shows(shown, covered)
    assert place[1].start < 200


def test_identical_states_give_no_crops():
    world = box_world.make(images=3)
    state = evaluate.State(world.cloud(), world.views())
    scores = evaluate.evaluate({"rough": state, "refined": state})
    same = pictures.make(state, state, scores)
    assert same.crops == ()
    assert same.best is None


def test_filling_closes_small_gaps_and_keeps_what_is_there():
    entries = np.full((2, 9, 9), zbuffer.EMPTY, np.int64)
    entries[:, 4, 4], entries[:, 4, 6] = 20 << 32 | 1, 10 << 32 | 2
    filled = splats.fill(entries, 2)
    assert filled[0, 4, 4] == entries[0, 4, 4]
    assert filled[0, 4, 5] == entries[0, 4, 6]
    assert filled[0, 2, 2] == entries[0, 4, 4]
    assert filled[0, 0, 0] == zbuffer.EMPTY


def test_scores_do_not_depend_on_the_number_of_threads():
    world = box_world.make(images=4)
    state = evaluate.State(world.cloud(), world.views())
    before = numba.get_num_threads()
    found = []
    for threads in (1, before):
        numba.set_num_threads(threads)
        try:
            found.append(evaluate.evaluate({"one": state})["one"])
        finally:
            numba.set_num_threads(before)
    for name in found[0].per_image:
        assert found[0].per_image[name].tobytes() == found[1].per_image[name].tobytes()
    assert found[0].map_entropy == found[1].map_entropy
