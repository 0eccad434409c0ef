"""Blocks of one visual bundle adjustment: together they are the whole problem, and their sum is solved as one."""

from dataclasses import replace

import numpy as np
import pytest
import textured_room
from textured_room import COUNT

from lvba import geometry
from lvba.blocks import visual_block, visual_joint
from lvba.blocks.visual_joint import JointCameras
from lvba.visual import image, refine, trajectory_prior, vignetting
from lvba.visual.config import VisualConfig
from lvba.visual.radiometry import NONE
from lvba.visual.scene import Inputs
from lvba.visual.states import CameraStates, VisualState
from lvba.visual.tuning import tuning
from lvba.visual.vignetting import Vignetting

CONFIG = VisualConfig()
ALL = np.arange(COUNT)


@pytest.fixture(scope="module")
def room():
    return textured_room.make()


@pytest.fixture(scope="module")
def solved(room):
    """Inputs, the undivided solution of the finest level, and what it found about noise."""
    given = Inputs(**{name: value for name, value in room[0].items() if name in Inputs.__dataclass_fields__})
    coarser = refine.refine_level(given, None, CONFIG)
    result, last = refine.finest(given, coarser, CONFIG)
    return given, result, last, tuning(last)


def core(first, end):
    mine = np.zeros(COUNT, bool)
    mine[first:end] = True
    return mine


def blocks_of(given, state, known, cores):
    laid = [
        visual_block.select_scene_points(given, state, ALL, mine, known, None, NONE, CONFIG) for mine in cores
    ]
    images, camera = given.pyramid.levels[0], given.pyramid.camera
    return laid, [
        visual_block.linearize(images, camera, each, state, known, None, camera, NONE, CONFIG)
        for each in laid
    ]


def test_tuning_is_what_the_solve_found(solved):
    _, _, last, known = solved
    assert known.noise == last.noise
    assert known.noise.shift > 0
    assert known.variance_factor == last.problem.variance_factor
    assert known.offset_scale > 0
    assert known.sigma_rotation.shape == (len(last.prior.sources), COUNT, 3)


def test_the_equations_of_all_shares_add_up_to_those_of_the_whole(solved):
    given, _, last, known = solved
    laid, parts = blocks_of(given, last.state, known, [core(0, 5), core(5, COUNT)])
    _, (whole,) = blocks_of(given, last.state, known, [core(0, COUNT)])
    assert min(each.observations for each in parts) > 100
    assert sum(each.observations for each in parts) == whole.observations
    together = visual_joint.total(parts, COUNT)
    scale = np.abs(whole.equations.dense()).max()
    np.testing.assert_allclose(together.dense(), whole.equations.dense(), atol=1e-10 * scale)
    np.testing.assert_allclose(
        together.gradient,
        whole.equations.gradient,
        atol=1e-10 * np.abs(whole.equations.gradient).max() + 1e-6,
    )
    assert together.cost == pytest.approx(whole.equations.cost, rel=1e-12)
    assert set(laid[0].points.reference) <= set(range(5))


def rounds(given, laid, start, last, known, count=8):
    now = JointCameras(start, start, last.prior, np.zeros(COUNT))
    for _ in range(count):
        found = [
            visual_block.linearize(
                *(given.pyramid.levels[0], given.pyramid.camera, each, now.state, known),
                *(None, given.pyramid.camera, NONE, CONFIG),
            )
            for each in laid
        ]
        now = visual_joint.step(now, found)
    return now, found


def test_joint_rounds_end_at_one_solution_wherever_they_begin(solved):
    given, _, last, known = solved
    laid, _ = blocks_of(given, last.state, known, [core(0, 5), core(5, COUNT)])
    delta = np.random.default_rng(1).normal(size=(COUNT, 6)) * np.repeat([1e-3, 2e-3], 3)
    poses = geometry.retract(last.state.cameras.world_from_camera, delta)
    start = VisualState(CameraStates(poses, last.state.cameras.log_exposure), last.state.calibration)
    near, _ = rounds(given, laid, last.state, last, known)
    far, found = rounds(given, laid, start, last, known)
    ends = [now.state.cameras.world_from_camera for now in (near, far)]
    assert near.converged
    assert far.converged
    assert (
        np.abs(geometry.log(geometry.inverse(ends[0]) @ ends[1])).max() < 1.5e-4 < 2e-3 < np.abs(delta).max()
    )
    # the scene points are others than those that the part was solved with
    assert np.abs(geometry.log(geometry.inverse(last.state.cameras.world_from_camera) @ ends[0])).max() < 1e-3
    assert not any(entry.taken_back for entry in far.history)
    assert visual_joint.step(far, found) is far


def test_a_step_that_costs_more_is_taken_back(solved):
    given, _, last, known = solved
    _, found = blocks_of(given, last.state, known, [core(0, COUNT)])
    now = JointCameras(last.state, last.state, last.prior, np.zeros(COUNT))
    moved = visual_joint.step(now, found)
    again = visual_joint.step(replace(moved, converged=False, cost=0.5 * moved.cost), found)
    assert again.history[-1].taken_back
    assert again.state is moved.before
    assert again.damping > moved.damping


def test_exposures_of_shares_are_those_of_the_whole(solved):
    given, _, last, known = solved
    parts, _ = blocks_of(given, last.state, known, [core(0, 5), core(5, COUNT)])
    (whole,), _ = blocks_of(given, last.state, known, [core(0, COUNT)])
    tied = visual_joint.solve_exposures([each.edges for each in parts], COUNT)
    alone = visual_joint.solve_exposures([whole.edges], COUNT)
    assert tied.pairs == alone.pairs
    np.testing.assert_allclose(tied.log_exposure, alone.log_exposure, atol=2e-3)
    assert visual_joint.solve_exposures([], COUNT) is None


def test_all_shares_have_one_vignetting(solved):
    given, _, last, known = solved
    true, pyramid = Vignetting((-0.4, -0.1, 0.0)), given.pyramid
    light = vignetting.light_of_pixels(true, pyramid.camera, pyramid.camera)
    full = np.rint(pyramid.levels[0] * light[..., None]).astype(np.uint8)
    dark = image.build_pyramid(full, pyramid.camera, len(pyramid))
    given = replace(given, pyramid=dark, camera=pyramid.camera)
    parts, _ = blocks_of(given, last.state, known, [core(0, 5), core(5, COUNT)])
    (whole,), _ = blocks_of(given, last.state, known, [core(0, COUNT)])
    tied = visual_joint.solve_exposures([each.edges for each in parts], COUNT)
    alone = visual_joint.solve_exposures([whole.edges], COUNT)
    assert tied.radiometry.vignetting.corner_loss == pytest.approx(
        alone.radiometry.vignetting.corner_loss, abs=0.01
    )
    assert alone.radiometry.vignetting.corner_loss == pytest.approx(true.corner_loss, abs=0.05)
    np.testing.assert_allclose(tied.log_exposure, alone.log_exposure, atol=2e-3)
    now = visual_joint.with_exposures(
        JointCameras(last.state, last.state, last.prior, np.zeros(COUNT)), [each.edges for each in parts]
    )
    assert now.radiometry.vignetting == tied.radiometry.vignetting


def test_without_prior_only_images_that_are_seen_move(solved):
    given, _, last, known = solved
    _, found = blocks_of(given, last.state, known, [core(0, 3)])
    now = visual_joint.step(JointCameras(last.state, last.state, None, np.zeros(COUNT)), found)
    seen = np.union1d(found[0].equations.rows, found[0].equations.columns)
    unseen = np.setdiff1d(ALL, seen)
    before, after = (s.cameras.world_from_camera for s in (last.state, now.state))
    np.testing.assert_allclose(before[unseen], after[unseen], atol=1e-12)
    assert np.abs(before[seen] - after[seen]).max() > 1e-6
    assert trajectory_prior.residuals(last.prior, last.prior.sources[0], now.state).shape == (COUNT, 6)
