"""A camera that the visual stage left in a wrong place is where its neighbors have it, and does not sink the others."""

from dataclasses import fields, replace
from types import SimpleNamespace

import numpy as np
import pytest
from image_scores import scores_of

from lvba import geometry, pipeline, plan, simulate
from lvba.blocks.split import SplitConfig
from lvba.camera import Camera
from lvba.dataset import Dataset, RigCamera
from lvba.io.dataset import open_dataset
from lvba.io.reference import read_reference
from lvba.pipeline import Config
from lvba.products import evaluate
from lvba.steps import acceptance, camera_outliers
from lvba.steps.camera_outliers import SOLVED
from lvba.steps.outcomes import VisualStage
from lvba.trajectory import Trajectory, pose_error
from lvba.visual.result import VisualResult
from lvba.visual.states import Calibration

COUNT = 40
TURN = np.array([0.0, np.radians(2.0), 0.0, 0.0, 0.0, 0.0])
SPREAD = np.repeat([np.radians(0.1), 0.005], 3)


def deviations(rng):
    """(COUNT, 6): noise of each frame, and a slow drift."""
    slow = np.cumsum(rng.normal(size=(COUNT, 6)), axis=0)
    return SPREAD * (rng.normal(size=(COUNT, 6)) + 0.3 * slow)


@pytest.mark.parametrize("spoiled", [(), (0,), (COUNT - 1,), (17,), (17, 18), (5, 30)])
def test_those_that_leave_their_neighbors_are_named_and_no_others(spoiled):
    for seed in range(30):
        values = deviations(np.random.default_rng(seed))
        values[list(spoiled)] += TURN
        assert tuple(camera_outliers.outlier_indices(values)) == spoiled


def test_no_more_are_named_than_a_few():
    values = deviations(np.random.default_rng(0))
    values[5:35:5] += TURN
    assert len(camera_outliers.outlier_indices(values)) == max(
        camera_outliers.LEAST, int(camera_outliers.MOST * COUNT)
    )


def test_where_all_follow_exactly_none_is_an_outlier():
    assert len(camera_outliers.outlier_indices(np.zeros((COUNT, 6)))) == 0


def path(rng):
    """World poses (COUNT, 4, 4) of a walk that turns."""
    tangents = np.cumsum(rng.normal(0, [0.05] * 3 + [0.1] * 3, (COUNT, 6)), axis=0)
    return geometry.retract(np.tile(np.eye(4), (COUNT, 1, 1)), tangents)


class Walk:
    """Cameras solved close to where the LiDAR trajectory has them, one of them not; every third is no keyframe."""

    def __init__(self, seed, spoiled):
        rng = np.random.default_rng(seed)
        rough, times = path(rng), np.arange(float(COUNT))
        deviation = SPREAD * rng.normal(size=(COUNT, 6))
        self.truth = geometry.retract(rough, deviation)
        names = tuple(f"/somewhere/{number}.png" for number in range(COUNT))
        mounted = RigCamera(Camera(640, 480, 500, 500, 320, 240), np.eye(4))
        at = Trajectory(times, rough)
        self.dataset = Dataset("walk", names, at, names, at, (mounted,))
        self.scans = SimpleNamespace(world_from_scan=rough)
        poses = self.truth.copy()
        poses[spoiled] = geometry.retract(poses[spoiled], TURN)
        small = np.tile(np.diag((0.1 * SPREAD) ** 2), (COUNT, 1, 1))
        nothing = dict.fromkeys((each.name for each in fields(VisualResult)), None)
        given = {
            "world_from_camera": poses,
            "covariance": small,
            "local_covariance": small,
            "own_covariance": small,
            "keyframes": np.setdiff1d(np.arange(COUNT), np.arange(1, COUNT, 3)),
            "calibration": Calibration(np.eye(4)),
            "clock_epoch": 0.0,
            "warnings": (),
            "substituted": np.zeros(0, np.int64),
        }
        self.visual = VisualStage(VisualResult(**nothing | given))

    def mended(self, gain, ssim):
        """The result where images are predicted better by so much (dB, SSIM) at their neighbors' deviation."""
        outlying = camera_outliers.find(self.dataset, self.scans, self.visual).outlying
        compared = {SOLVED: scores(outlying, 20.0, 0.5)}
        compared |= {name: scores(outlying, 20.0 + gain, 0.5 + ssim) for name in ("carried", "spline")}
        return camera_outliers.mend(self.dataset, self.scans, self.visual, [compared]).result


def scores(images, psnr, ssim):
    per_image = {name: np.zeros(len(images)) for name in evaluate._FIGURES}
    per_image |= {name: np.full(len(images), ssim if "ssim" in name else psnr) for name in acceptance.LOSSES}
    return scores_of(per_image, images)


def off(walk, result, image):
    return geometry.log(geometry.inverse(walk.truth[image]) @ result.world_from_camera[image])


def test_it_is_put_where_its_neighbors_are_and_is_named():
    walk = Walk(3, 20)
    result = walk.mended(3.0, 0.1)
    assert np.linalg.norm(off(walk, walk.visual.result, 20)[:3]) > np.radians(1.9)
    assert np.linalg.norm(off(walk, result, 20)[:3]) < np.radians(0.5)
    assert 20 not in result.keyframes
    # image 19 is no keyframe: it follows those on both sides
    assert list(result.substituted) == [19, 20]
    others = np.setdiff1d(np.arange(COUNT), [19, 20])
    np.testing.assert_array_equal(
        result.world_from_camera[others], walk.visual.result.world_from_camera[others]
    )
    np.testing.assert_array_equal(result.covariance[others], walk.visual.result.covariance[others])
    [warning] = result.warnings
    assert "The cameras of 20.png left" in warning


def test_its_promise_is_kept():
    errors = []
    for seed in range(60):
        walk = Walk(seed, 20)
        result = walk.mended(3.0, 0.1)
        errors.append(off(walk, result, 20) / np.sqrt(np.diagonal(result.covariance[20])))
    assert 0.5 < np.square(errors).mean() < 2.0


@pytest.mark.parametrize(("gain", "ssim"), [(0.05, 0.1), (3.0, 0.001), (3.0, -0.1), (0.0, 0.0)])
def test_where_images_do_not_say_it_is_where_all_expect_it(gain, ssim):
    walk = Walk(3, 20)
    result = walk.mended(gain, ssim)
    assert np.linalg.norm(off(walk, result, 20)[:3]) < np.radians(0.5)
    assert list(result.substituted) == [19, 20]
    assert "The cameras of 20.png left" in result.warnings[0]


@pytest.mark.parametrize(("gain", "ssim"), [(0.05, 0.1), (3.0, 0.001), (3.0, -0.1), (0.0, 0.0)])
def test_where_images_do_not_say_and_one_expects_it_alone_it_stays_and_is_uncertain(gain, ssim):
    """Before the second scan there is no spline."""
    walk = Walk(3, 0)
    result = walk.mended(gain, ssim)
    np.testing.assert_array_equal(result.world_from_camera, walk.visual.result.world_from_camera)
    assert len(result.substituted) == len(result.warnings) == 0
    turned = np.sqrt(np.trace(result.covariance[0][:3, :3]))
    assert np.radians(1.5) < turned < np.radians(3.0)


def test_where_images_say_that_it_is_right_nothing_changes():
    walk = Walk(3, 20)
    result = walk.mended(-3.0, -0.1)
    np.testing.assert_array_equal(result.world_from_camera, walk.visual.result.world_from_camera)
    np.testing.assert_array_equal(result.covariance, walk.visual.result.covariance)


def test_splines_do_not_say_where_cameras_beyond_the_second_scan_are():
    """There they are cubics through scans on one side."""
    walk = Walk(3, 0)
    outliers = camera_outliers.find(walk.dataset, walk.scans, walk.visual)
    assert list(outliers.outlying) == [0]
    assert {each.name for each in outliers.expectations} == {"carried", "spline"}
    assert outliers.names_for(0) == ["carried"]
    assert outliers.names_for(3) == ["carried", "spline"]


def test_where_none_is_an_outlier_no_image_is_asked():
    walk = Walk(3, [])
    assert camera_outliers.find(walk.dataset, walk.scans, walk.visual) is None
    assert camera_outliers.mend(walk.dataset, walk.scans, walk.visual, [{}]) is walk.visual


@pytest.fixture(scope="module")
def yard(tmp_path_factory):
    """A courtyard of 24 images and as many scans, long enough for two parts."""
    folder = tmp_path_factory.mktemp("outliers") / "yard"
    sizes = {"width": 320, "height": 240, "points_per_scan": 6000}
    simulate.simulate("courtyard", folder, frames=24, scans=24, length=18.0, seed=5, **sizes)
    return folder


@pytest.fixture(scope="module", params=[{"by": "none"}, {"by": "count", "size": 12}], ids=["one", "parts"])
def work(yard, request):
    return pipeline.refine(open_dataset(yard), replace(Config(), split=SplitConfig(**request.param)))


@pytest.fixture(scope="module")
def store(work):
    return plan.run(work, {})


@pytest.mark.parametrize("image", [0, 17])
def test_a_run_with_a_camera_that_failed_keeps_the_others(yard, work, store, image):
    names = {key: step.name for key, step in work.steps.items()}
    key = next(key for key, name in names.items() if name == "visual")
    before = list(names)[: list(names).index(key)]
    poses = store[key].result.world_from_camera.copy()
    poses[image] = geometry.retract(poses[image], 2 * TURN)
    failed = VisualStage(replace(store[key].result, world_from_camera=poses), "", store[key].tuning)
    mended = plan.run(work, {each: store[each] for each in before if each in store} | {key: failed})
    facts = next(mended[each] for each, name in names.items() if name == "facts")
    accepted = next(mended[each] for each, name in names.items() if name == "visual-gate")
    assert accepted.cameras.accepted
    assert facts["visual"]["substituted"] == [image]
    assert any(
        f"{open_dataset(yard).image_paths[image]}".split("/")[-1] in each for each in facts["warnings"]
    )
    truth = read_reference(yard / "reference").images.world_from_sensor
    error = pose_error(accepted.world_from_camera, truth)
    assert error.rotation_max_deg < 0.5
    wider, without = (
        next(run[each] for each, name in names.items() if name == "facts")["expected_error"]["cameras"]
        for run in (mended, store)
    )
    assert wider["per_frame_m"][image] > without["per_frame_m"][image]
