"""Cameras follow scans that learned from them: on where the map moved, untouched where it did not."""

from dataclasses import replace

import numpy as np
import pytest

from lvba import geometry, pipeline, plan, simulate
from lvba.blocks import split, survey
from lvba.io.dataset import open_dataset
from lvba.io.reference import read_reference
from lvba.pipeline import Config
from lvba.steps import fused_cameras, joint_cameras, joint_prior, visual
from lvba.steps.acceptance import FUSED, VISUAL
from lvba.trajectory import align


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """(dataset, truth, artifacts by step): furnished rooms seen by a narrow LiDAR, whose scans learn millimeters."""
    folder = tmp_path_factory.mktemp("fused") / "rooms"
    sizes = {"width": 240, "height": 180, "points_per_scan": 8000}
    simulate.simulate(
        "rooms", folder, frames=20, scans=20, seed=3, lidar="non_repetitive", difficulty="easy", **sizes
    )
    dataset = open_dataset(folder)
    work = pipeline.refine(dataset)
    names = {key: step.name for key, step in work.steps.items()}
    found = {names[key]: value for key, value in plan.run(work, {}).items()}
    return dataset, read_reference(folder / "reference"), found


def given(run):
    """The arguments of `fused_cameras.start`, by name."""
    dataset, _, found = run
    cores = split.parts(dataset, Config().split, survey.load_of(dataset))
    return {
        "dataset": dataset, "cores": cores, "stages": [found["visual-choice"]],
        "cameras": found["visual-mended"], "lidar": found["lidar"], "learned": found["fusion"],
        "fused": found["fusion-gate"], "survey": found["survey"], "config": Config().visual,
    }  # fmt: skip


def camera_error(scans, cameras, truth):
    """m, root mean square, in the frame of the aligned scans."""
    frame = align(scans, truth.scans.world_from_sensor)
    off = geometry.inverse(truth.images.world_from_sensor) @ (frame @ cameras)
    return float(np.sqrt(np.square(off[:, :3, 3]).sum(axis=1).mean()))


def test_cameras_are_nearer_to_the_truth_over_the_map_that_learned_from_them(run):
    _, truth, found = run
    fused, cameras = found["fusion-gate"].world_from_scan, found["fused-cameras"]
    first, followed = (each.world_from_camera for each in (cameras.result, cameras.over_fused))
    before = camera_error(found["lidar-gate"].world_from_scan, first, truth)
    stayed, after = (camera_error(fused, each, truth) for each in (first, followed))
    assert found["visual-gate"].state == FUSED
    np.testing.assert_array_equal(found["visual-gate"].world_from_camera, followed)
    assert after < 0.95 * stayed < before
    np.testing.assert_array_equal(cameras.over_fused.log_exposure, cameras.result.log_exposure)


def test_only_the_result_with_fused_scans_has_the_cameras_that_follow_them(run):
    _, _, found = run
    cameras, accepted = found["fused-cameras"], found["visual-gate"]
    assert fused_cameras.in_use(cameras, accepted).result is cameras.over_fused
    assert fused_cameras.in_use(cameras, replace(accepted, state=VISUAL)).result is cameras.result


def test_one_step_gives_what_the_steps_of_many_parts_give(run):
    arguments = given(run)
    dataset, _, found = run
    [core], [stage] = arguments["cores"], arguments["stages"]
    survey, config, fused = (arguments[name] for name in ("survey", "config", "fused"))
    scans = [((0, 20), (lambda: found["scans"], lambda: found["moving-points"]))]
    images = [((0, 20), lambda: found["images"])]
    merged = fused_cameras.start(**arguments)
    assert fused_cameras.are_solved(merged)
    bare = fused_cameras.without_planes(arguments["lidar"])
    assert len(bare.result.planes) == 0
    planes = visual.find_planes(dataset, core.frames, scans, bare, fused, survey)
    about = (dataset, core.frames, images, bare, planes, stage)
    points = joint_cameras.select_points(*about, merged, survey, config)
    merged = joint_cameras.solve_exposures(merged, [joint_cameras.exposure_pairs(points)])
    for _ in range(Config().merge.image_rounds):
        block = joint_cameras.linearize_cameras(
            dataset, images, stage, lambda: points, merged, survey, config
        )
        merged = joint_cameras.step_cameras(merged, [block])
    left = {name: each for name, each in arguments.items() if name not in {"cores", "learned"}}
    expected = fused_cameras.finish(**(left | {"merged": merged})).over_fused
    np.testing.assert_array_equal(
        found["fused-cameras"].over_fused.world_from_camera, expected.world_from_camera
    )


def test_nothing_is_solved_again_where_the_map_stays(run):
    arguments = given(run)
    learned, fused = arguments["learned"], arguments["fused"]
    still = replace(learned, result=replace(learned.result, moved_m=learned.result.moved_m * 1e-3))
    refused = replace(fused, verdict=replace(fused.verdict, accepted=False))
    none = replace(arguments["cameras"], result=None, problem="no point is seen twice")
    for change in ({"learned": still}, {"fused": refused}, {"cameras": none}):
        merged = fused_cameras.start(**(arguments | change))
        assert not fused_cameras.are_solved(merged)
        assert merged.cameras is None
        assert merged.problem
        keep = {name: each for name, each in arguments.items() if name not in {"cores", "learned"}}
        kept = fused_cameras.finish(**(keep | {"merged": merged, "cameras": none}))
        assert kept is none


def test_rounds_begin_with_the_motion_during_each_image(run):
    arguments = given(run)
    motion = np.random.default_rng(0).normal(size=(len(arguments["survey"].keyframes), 6))
    [stage] = arguments["stages"]
    moving = [replace(stage, tuning=replace(stage.tuning, motion=motion))]
    np.testing.assert_array_equal(
        fused_cameras.start(**(arguments | {"stages": moving})).cameras.state.motion, motion
    )
    still = [replace(stage, tuning=replace(stage.tuning, motion=None))]
    assert joint_prior.motion_of_keyframes(arguments["cores"], still, arguments["survey"]) is None
