"""A run whose images are too large to judge is judged at half their size, and ends where it does by the full ones."""

import numpy as np
import pytest

from lvba import pipeline, plan, simulate
from lvba.io.dataset import open_dataset
from lvba.io.reference import read_reference
from lvba.pipeline import Config
from lvba.products import judging_size
from lvba.trajectory import pose_error


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A short street with 16 images and as many scans, truth in reference/."""
    folder = tmp_path_factory.mktemp("judging") / "street"
    sizes = {"width": 640, "height": 480, "points_per_scan": 6000}
    simulate.simulate("street", folder, frames=16, scans=16, length=12.0, seed=5, **sizes)
    return folder


@pytest.fixture(scope="module")
def runs(recording):
    """Artifacts by the name of their steps: judged at full, and at half size."""
    dataset, store, made = open_dataset(recording), {}, []
    for most in (judging_size.MOST_PIXELS, dataset.camera.width * dataset.camera.height - 1):
        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(judging_size, "MOST_PIXELS", most)
            work = pipeline.refine(dataset, Config())
            # what no image has judged is the same in both
            store = plan.run(work, store)
        made.append({step.name: store[key] for key, step in work.steps.items()})
    return made


def test_a_run_judged_at_half_size_is_accepted_and_ends_at_the_same_poses(recording, runs):
    full, half = runs
    truth, dataset = read_reference(recording / "reference"), open_dataset(recording)
    assert "photos-judging" in set(half) - set(full)
    for run in runs:
        result = run["visual-gate"]
        assert result.scans.accepted
        assert result.cameras.accepted
        assert result.exposures.accepted
    scans, cameras = (
        [getattr(run["visual-gate"], name) for run in runs]
        for name in ("world_from_scan", "world_from_camera")
    )
    assert np.array_equal(*scans)
    assert np.array_equal(*cameras)
    rough = pose_error(dataset.images.world_from_sensor, truth.images.world_from_sensor).ate_m
    assert pose_error(cameras[1], truth.images.world_from_sensor).ate_m < 0.1 * rough


def test_the_report_says_the_size_and_camera_and_map_are_as_by_the_full_images(runs):
    sizes = [run["facts"]["evaluation"]["image_size"] for run in runs]
    assert sizes == [{"width": 640, "height": 480}, {"width": 320, "height": 240}]
    cameras = [run["visual-gate"].camera for run in runs]
    assert cameras[0] == cameras[1]
    assert (cameras[0].width, cameras[0].height) == (640, 480)
    maps = [run["map"] for run in runs]
    assert maps[0].voxel_m == maps[1].voxel_m
    assert np.array_equal(maps[0].points_world, maps[1].points_world)
    both = (maps[0].views > 0) & (maps[1].views > 0)
    assert both.sum() > 0.8 * (maps[0].views > 0).sum()
    off = np.abs(maps[0].rgb[both].astype(float) - maps[1].rgb[both]).mean()
    assert off < 15
    pictures = runs[1]["pictures"]
    assert {picture.raw.shape for picture in pictures.views} == {(240, 320, 3)}


def test_figures_at_half_size_tell_the_same_gain(runs):
    gains = []
    for run in runs:
        scores = run["evaluate-result"]
        gains.append(scores[run["visual-gate"].state].psnr_leave_one_out - scores["rough"].psnr_leave_one_out)
    assert min(gains) > 1.0
    assert gains[1] == pytest.approx(gains[0], rel=0.5)
