"""Reference patches that move with the pose of their camera: against differences, a plain twin, and the fixed form."""

import naive_photometric_moving as naive
import numba
import numpy as np
import pytest
import textured_planes

from lvba import trajectory
from lvba.camera import Camera
from lvba.kernels import photometric_moving as kernels
from lvba.visual import bundle_adjustment, photometric
from lvba.visual.photometric import PhotometricState
from lvba.visual.states import Calibration, CameraStates, VisualState
from lvba.visual.variant import Variant

CAMERA = Camera(160, 120, 95.0, 97.0, 79.3, 59.1)
COUNT = 4
MOVING = {"patch": 5, "reference_pixels": "moving"}


@pytest.fixture(scope="module")
def small():
    """A few images of the room, its points where their pixels see them from the true poses, and states nearby."""
    world, poses = textured_planes.room(), textured_planes.walk(COUNT)
    images = textured_planes.render(world, poses, CAMERA, [1, 1.2, 0.9, 1.1], noise=2.0, supersample=1)
    points, observations = textured_planes.scene_points(world, poses, CAMERA, step=30)
    near = CameraStates(textured_planes.disturbed(poses, 0.01, 0.2), np.array([0, 0.2, -0.1, 0.05]))
    return images, points, observations, poses, near


def problem_of(small, **more) -> photometric.Problem:
    images, points, observations, *_ = small
    return photometric.prepare(images, CAMERA, points, observations, **more)


def still(cameras: CameraStates, problem: photometric.Problem) -> PhotometricState:
    return PhotometricState(cameras, np.zeros(len(problem.points)))


def test_the_centers_of_a_patch_move_as_differences_say(small):
    *_, near = small
    problem = problem_of(small, **MOVING)
    points, pose = problem.points, near.world_from_camera
    for o in range(0, len(problem.observations), 7):
        p = problem.observations.point[o]
        found = kernels.observation_jacobian(
            np.ascontiguousarray(pose), problem.intrinsics,
            points.position_world[p], points.normal_world[p], points.reference[p],
            problem.observations.target[o],
        )  # fmt: skip
        expected = naive.jacobian(problem, near, o)
        assert found == pytest.approx(expected, rel=1e-5, abs=1e-4)
        assert np.abs(expected[3:, :6]).max() > 50, "the reference pixel does not move"


@pytest.mark.parametrize("growth", [0.0, 0.0625])
def test_the_normal_equations_agree_with_the_plain_twin(small, growth, monkeypatch):
    *_, near = small
    monkeypatch.setattr(photometric, "SATURATED", 200.0)
    monkeypatch.setattr(photometric, "NOISE_GROWTH", growth)
    problem = problem_of(small, **MOVING, sigma=np.linspace(2.0, 6.0, len(small[2])))
    offset = np.linspace(-0.01, 0.01, len(problem.points))
    state = PhotometricState(near, offset)
    at = photometric.linearize(problem, state)
    count = at.sums[:, photometric.COUNT]
    assert (count == 25).any()
    assert ((count > 0) & (count < 25)).any(), "no pixel is masked: the masks are not tested"
    hessian, gradient, cost = naive.normal_equations(problem, near, offset)
    cameras = 7 * COUNT
    assert at.equations.cost == pytest.approx(cost, rel=1e-9)
    close = {"rel": 1e-6, "abs": 1e-6 * np.abs(gradient).max()}
    assert at.equations.gradient.ravel() == pytest.approx(gradient[:cameras], **close)
    own = np.bincount(problem.observations.point, at.single[:, 14], len(problem.points))
    assert own == pytest.approx(gradient[cameras:], **close)
    dense = at.equations.dense()
    assert dense == pytest.approx(hessian[:cameras, :cameras], rel=1e-6, abs=1e-6 * np.abs(hessian).max())


def test_eliminating_plane_offsets_is_the_schur_complement(small):
    *_, near = small
    sigma = np.linspace(0.002, 0.02, len(small[1]))
    problem = problem_of(small, **MOVING, offset_sigma=sigma)
    hessian, gradient, _ = naive.normal_equations(problem, near, np.zeros(len(sigma)))
    cameras = 7 * COUNT
    cross = hessian[:cameras, cameras:]
    own = np.linalg.inv(hessian[cameras:, cameras:] + np.diag(1 / sigma**2))
    equations = photometric.linearize(problem, still(near, problem)).equations
    reduced = hessian[:cameras, :cameras] - cross @ own @ cross.T
    pulled = gradient[:cameras] - cross @ own @ gradient[cameras:]
    assert equations.dense() == pytest.approx(reduced, abs=1e-6 * np.abs(reduced).max())
    assert equations.gradient.ravel() == pytest.approx(pulled, abs=1e-6 * np.abs(pulled).max())


def test_the_gradient_is_the_slope_of_the_cost(small, monkeypatch):
    # smooth images and no mask, so that differences are meaningful; the Jacobian is that of the patch centre
    *_, near = small
    v, u = np.mgrid[:120, :160]
    smooth = [125 + 50 * np.sin(0.11 * u + k) * np.cos(0.13 * v - k) + 0.2 * u for k in range(COUNT)]
    images = np.round(np.stack(smooth)).astype(np.uint8)[..., None]
    monkeypatch.setattr(photometric, "HUBER", 4.0)
    problem = problem_of((images, *small[1:]), **MOVING, sigma=8.0)
    gradient = photometric.linearize(problem, still(near, problem)).equations.gradient
    slope = np.zeros_like(gradient)
    for image, n in np.ndindex(slope.shape):
        step = np.zeros_like(gradient)
        step[image, n] = 2e-5
        costs = [
            photometric.cost(problem, photometric.sums(problem, still(photometric.moved(near, d), problem)))
            for d in (step, -step)
        ]
        slope[image, n] = (costs[0] - costs[1]) / 4e-5
    assert gradient[:, 6] == pytest.approx(slope[:, 6], abs=2e-3 * np.abs(slope[:, 6]).max())
    assert gradient[:, :6] == pytest.approx(slope[:, :6], abs=0.03 * np.abs(slope[:, :6]).max())


def test_where_no_camera_has_moved_the_cost_is_that_of_fixed_pixels(small, monkeypatch):
    *_, poses, near = small
    monkeypatch.setattr(photometric, "DARK", 0.0)
    monkeypatch.setattr(photometric, "SATURATED", 255.0)
    fixed, moving = (problem_of(small, reference_pixels=how) for how in ("fixed", "moving"))
    true = still(CameraStates(poses, near.log_exposure), fixed)
    one, other = photometric.sums(fixed, true), photometric.sums(moving, true)[:, :13]
    assert (one[:, photometric.COUNT] == other[:, photometric.COUNT]).all()
    assert (one[:, photometric.COUNT] == 81).mean() > 0.9
    assert photometric.cost(moving, other) == pytest.approx(photometric.cost(fixed, one), rel=1e-5)
    assert np.abs(other - one).max(axis=0) / np.abs(one).max(axis=0) == pytest.approx(np.zeros(13), abs=2e-4)


def test_cameras_that_move_together_along_a_plane_change_the_cost_only_where_patches_move(small):
    images, points, observations, poses, _ = small
    floor = points.plane[observations.point] == np.bincount(points.plane).argmax()
    only = textured_planes.Observations(
        observations.point[floor], observations.target[floor], observations.is_global[floor]
    )
    normal = points.normal_world[observations.point[floor][0]]
    slid = poses.copy()
    slid[:, :3, 3] += 0.02 * np.linalg.svd(normal[None])[2][1]
    change = {}
    for how in ("fixed", "moving"):
        problem = photometric.prepare(images, CAMERA, points, only, reference_pixels=how)
        true, moved = (
            photometric.sums(problem, still(CameraStates(pose, np.log([1, 1.2, 0.9, 1.1])), problem))
            for pose in (poses, slid)
        )
        change[how] = abs(moved[:, photometric.COST].sum() / true[:, photometric.COST].sum() - 1)
    assert change["fixed"] < 1e-4
    assert change["moving"] > 1e-2


def test_one_thread_and_two_give_the_same_bytes(small):
    *_, near = small
    problem = problem_of(small, **MOVING, offset_sigma=np.full(len(small[1]), 0.01))
    threads = numba.get_num_threads()
    found = []
    try:
        for count in (1, min(2, threads)):
            numba.set_num_threads(count)
            found.append(photometric.linearize(problem, still(near, problem)))
    finally:
        numba.set_num_threads(threads)
    assert found[0].sums.tobytes() == found[1].sums.tobytes()
    assert found[0].single.tobytes() == found[1].single.tobytes()
    assert found[0].equations.blocks.tobytes() == found[1].equations.blocks.tobytes()
    assert found[0].equations.gradient.tobytes() == found[1].equations.gradient.tobytes()


def test_the_variant_reaches_the_solve():
    camera, count = Camera(320, 240, 190.0, 190.0, 159.5, 119.5), 6
    world, poses = textured_planes.room(), textured_planes.walk(count)
    images = textured_planes.render(world, poses, camera, np.ones(count), noise=2.0)
    points, observations = textured_planes.scene_points(world, poses, camera, step=20)
    rough = textured_planes.disturbed(poses, 0.005, 0.1)
    start = VisualState(textured_planes.states(rough), Calibration(np.eye(4)))
    found = {}
    for how in ("fixed", "moving"):
        variant = Variant(reference_pixels=how, exposures="joint")
        found[how] = bundle_adjustment.solve(
            images, camera, points, observations, start, None, variant=variant
        )
        before = trajectory.pose_error(rough, poses)
        after = trajectory.pose_error(found[how].state.cameras.world_from_camera, poses)
        assert after.ate_m < 0.5 * before.ate_m
        assert after.rotation_deg < 0.5 * before.rotation_deg
        assert np.abs(found[how].photometric.offset).max() > 0
    # both patches are read between pixels, which smooths the noise of both
    fixed, moving = (np.median(found[how].problem.sigma) for how in ("fixed", "moving"))
    assert moving < 0.9 * fixed
