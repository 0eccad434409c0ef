"""A run of a recording whose cameras stand right beside the scans: images confirm them, and refine the scans."""

from dataclasses import replace

import numpy as np
import pytest

from lvba import pipeline, plan, simulate
from lvba.io import tum
from lvba.io.dataset import open_dataset
from lvba.io.reference import read_reference
from lvba.steps.acceptance import EXPOSED, FUSED_EXPOSED, ROUGH
from lvba.steps.lidar import carry_cameras
from lvba.trajectory import Trajectory, pose_error


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A short street with truth in reference/; its rough cameras have the errors of the rough scans, and no others."""
    folder = tmp_path_factory.mktemp("confirmed") / "street"
    sizes = {"width": 320, "height": 240, "points_per_scan": 4000}
    simulate.simulate("street", folder, frames=16, scans=16, length=12.0, seed=5, difficulty="easy", **sizes)
    rough, truth = open_dataset(folder), read_reference(folder / "reference")
    true = replace(
        rough,
        scans=replace(rough.scans, world_from_sensor=truth.scans.world_from_sensor),
        images=replace(rough.images, world_from_sensor=truth.images.world_from_sensor),
    )
    beside = carry_cameras(true, rough.scans.world_from_sensor)
    [poses] = [path for path in folder.rglob("image_poses.txt") if path.parent.name != "reference"]
    tum.write_trajectory(poses, Trajectory(rough.images.times, beside))
    return folder


@pytest.fixture(scope="module")
def run(recording):
    """Artifacts by the name of their steps."""
    work = pipeline.refine(open_dataset(recording))
    store = plan.run(work, {})
    return {step.name: store[key] for key, step in work.steps.items()}


def test_images_confirm_the_cameras_and_refine_the_scans(recording, run):
    result, truth = run["visual-gate"], read_reference(recording / "reference")
    assert result.state == FUSED_EXPOSED
    assert (result.cameras.accepted, result.cameras.confirmed, result.fusion.accepted) == (False, True, True)
    by_planes, fused = (
        pose_error(poses, truth.scans.world_from_sensor).ate_m
        for poses in (run["lidar-gate"].world_from_scan, result.world_from_scan)
    )
    assert fused < 0.8 * by_planes
    dataset = open_dataset(recording)
    carried = carry_cameras(dataset, result.world_from_scan)
    assert np.array_equal(result.world_from_camera, carried)


def test_the_result_has_all_scores_over_the_pixels_that_the_input_is_compared_over(run):
    scores = run["evaluate-result"]
    rough, before, result = (scores[name] for name in (ROUGH, EXPOSED, FUSED_EXPOSED))
    assert result.coverage_common == rough.coverage_common
    assert np.array_equal(result.images, rough.images)
    assert np.isfinite([result.psnr, result.ssim, result.psnr_full, result.psnr_leave_one_out]).all()
    assert result.psnr_leave_one_out > before.psnr_leave_one_out - 0.1
    assert result.map_entropy == run["fusion-gate"].entropy
    assert FUSED_EXPOSED not in run["evaluate"]


def test_the_report_expects_errors_of_confirmed_cameras_and_has_nothing_against_them(recording, run):
    facts, truth = run["facts"], read_reference(recording / "reference")
    assert facts["visual"]["state"] == FUSED_EXPOSED
    assert facts["visual"]["confirmed"] is True
    assert not [each for each in facts["verdict"]["reasons"] if "camera poses" in each["text"]]
    off = pose_error(run["visual-gate"].world_from_camera, truth.images.world_from_sensor).ate_m
    assert off < facts["expected_error"]["cameras"]["position_m"]
    assert facts["evaluation"]["refined"]["psnr_common"] is not None
