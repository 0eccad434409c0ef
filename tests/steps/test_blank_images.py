"""Images that show nothing judge nothing and color nothing: one of them does not make its neighbors worse."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from needed_steps import needed

from lvba import pipeline, plan
from lvba.blocks import decoded_images
from lvba.io.dataset import open_dataset
from lvba.io.images import read_image, write_image
from lvba.pipeline import Config
from lvba.products.evaluate import EvaluateConfig, instead_of_blank
from lvba.steps.acceptance import VISUAL

BLANK = 7


def test_black_and_clipped_images_are_blank_and_dark_or_bright_ones_are_not():
    rng = np.random.default_rng(0)
    images = rng.integers(10, 240, (6, 64, 96, 3), dtype=np.uint8)
    images[1], images[2], images[3] = 0, 255, images[3] // 24 + 4
    images[4, 8:] = 0
    pieces = [((10, 13), lambda: images[:3]), ((13, 16), lambda: images[3:])]
    assert list(decoded_images.blank_photos(pieces, (10, 16))) == [1, 2]
    assert list(decoded_images.blank_photos(pieces, (12, 15))) == [0]
    assert decoded_images.blank_photos([], (0, 0)).dtype == np.int32


@pytest.fixture(scope="module")
def store():
    """Artifacts of all runs here: that of the recording as it is, is made once."""
    return {}


@pytest.fixture(scope="module", params=[0, 255], ids=["black", "clipped"])
def blanked(request, recording, tmp_path_factory):
    """The recording with one image blank."""
    folder = tmp_path_factory.mktemp("blank") / "street"
    shutil.copytree(recording, folder)
    path = Path(open_dataset(folder).image_paths[BLANK])
    write_image(path, np.full_like(read_image(path), request.param))
    return folder


def run(folder, store, config, *names):
    """Artifacts by the name of their steps. names: of those that are made, all if none are given"""
    work = pipeline.refine(open_dataset(folder), config)
    plan.run(needed(work, *names) if names else work, store)
    return {step.name: store[key] for key, step in work.steps.items() if key in store}


@pytest.fixture(scope="module")
def runs(recording, blanked, store):
    """Artifacts by the name of their steps, of the recording, and with one image blank."""
    return [run(folder, store, Config()) for folder in (recording, blanked)]


def test_a_blank_image_is_not_judged_and_its_neighbors_are_predicted_as_well(runs):
    """Before, points near it had its black or white, and its neighbors lost up to 10 dB."""
    clean, blank = (made["evaluate-result"][VISUAL] for made in runs)
    assert BLANK not in blank.images
    assert set(clean.images) - set(blank.images) == {BLANK}
    others = np.isin(clean.images, blank.images)
    lost = clean.per_image["psnr_leave_one_out"][others] - blank.per_image["psnr_leave_one_out"]
    assert lost.max() < 2.0
    assert all(made["visual-gate"].cameras.accepted for made in runs)


def test_of_few_images_to_judge_another_one_is_judged_instead_of_a_blank_one(recording, blanked, store):
    few = Config(evaluate=EvaluateConfig(max_images=10))
    clean, blank = (
        run(folder, store, few, "evaluate")["evaluate"][VISUAL].images for folder in (recording, blanked)
    )
    assert len(blank) == len(clean) == 10
    assert set(clean) ^ set(blank) == {BLANK, BLANK - 1}


def test_each_blank_image_is_replaced_by_the_nearest_one_that_shows_something():
    def judged(asked, blank, among):
        return list(instead_of_blank(np.array(asked, np.int32), np.array(blank, np.int32), among))

    assert judged([2, 5], [], (0, 8)) == [2, 5]
    assert judged([0], [0, 1], (0, 8)) == [2]
    assert judged([2, 5], [5, 6], (0, 8)) == [2, 4]
    assert judged([0, 3], [0, 3], (0, 4)) == [1, 2]
    assert judged([0, 1, 2], [1], (0, 3)) == [0, 2], "there is no other"
    assert judged([4], [4, 5], (4, 6)) == [], "others are of another part"
