"""Intrinsics and readout time as shared parameters: what they move, and that they are found with the poses."""

from dataclasses import replace

import numpy as np
import pytest
import textured_planes

from lvba import geometry, lens
from lvba.camera import Camera
from lvba.lens import Lens
from lvba.visual import photometric, self_calibration
from lvba.visual.photometric import PhotometricState
from lvba.visual.states import Calibration, CameraStates

RAW = {
    "radial-tangential": Camera(160, 120, 95.0, 97.0, 79.3, 59.1, (-0.11, 0.03, 6e-4, -4e-4)),
    "rational": Camera(160, 120, 95.0, 97.0, 79.3, 59.1, (0.2, -0.1, 2e-4, -3e-4, 0.01, 0.3, -0.02, 0.003)),
    "equidistant": Camera(160, 120, 70.0, 71.0, 79.3, 59.1, (0.02, -0.01, 0.003, 0.001), Lens.EQUIDISTANT),
}
LAYOUT = Calibration.layout()
COUNT = 5


def pinhole_of(camera):
    return replace(camera.undistorted(), fx=0.98 * camera.fx, fy=0.98 * camera.fy)


def calibration(step):
    """Calibration (9,) of focal lengths, principal point, lens and readout."""
    return Calibration(np.eye(4), 0.0, step[:2], step[2:4], step[4:8], float(step[8]))


def ray_of(camera, raw):
    """(N, 2) normalized coordinates that raw pixels (N, 2) show."""
    u, v = (raw - [camera.cx, camera.cy]).T / np.array([[camera.fx], [camera.fy]])
    return np.stack(lens.undistort(camera.lens, camera.distortion, u, v), axis=-1)


def raw_of(camera, ray):
    found = lens.distort(camera.lens, camera.distortion, ray[:, 0], ray[:, 1])
    return np.stack(found, axis=-1) * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def pixel_of(pinhole, ray):
    return ray * [pinhole.fx, pinhole.fy] + [pinhole.cx, pinhole.cy]


def back(pinhole, pixel):
    return (pixel - [pinhole.cx, pinhole.cy]) / [pinhole.fx, pinhole.fy]


SIZES = np.array([1e-3, 1e-3, 0.1, 0.1, 1e-3, 1e-3, 1e-4, 1e-4, 1e-3])


@pytest.fixture(scope="module")
def scene():
    world, poses = textured_planes.room(), textured_planes.walk(COUNT)
    pinhole = pinhole_of(RAW["radial-tangential"])
    points, observations = textured_planes.scene_points(world, poses, pinhole, step=24)
    rng = np.random.default_rng(3)
    return points, observations, poses, rng.normal(size=(COUNT, 6)) * [0.3, 0.3, 0.3, 1, 1, 1]


def places(scene, camera, step):
    """Where the middle of each patch is in its undistorted target image where the camera is another, by (9,) `step`:
    the ray of the reference pixel in the other camera, onto the plane, into the target's raw image, and back."""
    points, observations, poses, velocity = scene
    pinhole, there = pinhole_of(camera), self_calibration.corrected(camera, calibration(step))
    at, target = observations.point, observations.target
    reference = points.reference[at]
    seen = raw_of(camera, back(pinhole, points.pixel[at].astype(float)))
    first = moved(poses, velocity, reference, step[8] * (seen[:, 1] / camera.height - 0.5))
    ray = np.column_stack([ray_of(there, seen), np.ones(len(at))])
    along = np.einsum("oij,oj->oi", first[:, :3, :3], ray)
    normal = points.normal_world[at]
    depth = np.einsum("oi,oi->o", normal, points.position_world[at] - first[:, :3, 3])
    world = first[:, :3, 3] + along * (depth / np.einsum("oi,oi->o", normal, along))[:, None]
    part = np.zeros(len(at))
    for _ in range(20 if step[8] else 1):
        second = moved(poses, velocity, target, step[8] * part)
        local = np.einsum("oji,oj->oi", second[:, :3, :3], world - second[:, :3, 3])
        raw = raw_of(there, local[:, :2] / local[:, 2:])
        part = raw[:, 1] / camera.height - 0.5
    return pixel_of(pinhole, ray_of(camera, raw))


def shifts_of(scene, camera, known):
    points, observations, poses, velocity = scene
    return self_calibration.shifts(camera, pinhole_of(camera), points, observations, poses, velocity, known)


@pytest.mark.parametrize("name", RAW)
def test_patches_move_by_what_another_camera_shows_there(scene, name):
    found = shifts_of(scene, RAW[name], Calibration(np.eye(4)))
    assert found.size == LAYOUT.size
    assert not found.at.any()
    for k, size in enumerate(SIZES):
        step = np.zeros(9)
        step[k] = 1e-3 * size
        slope = (places(scene, RAW[name], step) - places(scene, RAW[name], -step)) / (2e-3 * size)
        np.testing.assert_allclose(found.by[:, :, k], slope, atol=2e-5 * np.abs(slope).max() + 1e-7)


@pytest.mark.parametrize("name", RAW)
def test_where_the_camera_is_far_off_they_move_by_all_of_it(scene, name):
    step = np.array([0.02, -0.01, 2.0, -1.5, 0.02, -0.01, 1e-3, -1e-3, 0.0])
    found = shifts_of(scene, RAW[name], calibration(step))
    expected = places(scene, RAW[name], step) - places(scene, RAW[name], np.zeros(9))
    assert np.abs(expected).max() > 2
    np.testing.assert_allclose(found.at, expected, atol=1e-9)


def test_the_readout_moves_patches_to_the_row_that_is_read_there(scene):
    step = np.array([0.02, 0.0, 2.0, 0.0, 0.02, 0.0, 0.0, 0.0, 0.04])
    found = shifts_of(scene, RAW["equidistant"], calibration(step))
    expected = places(scene, RAW["equidistant"], step) - places(scene, RAW["equidistant"], np.zeros(9))
    assert np.abs(expected).max() > 2
    np.testing.assert_allclose(found.at, expected, atol=1e-3)


def moved(poses, velocity, image, seconds):
    return poses[image] @ geometry.exp(velocity[image] * seconds[:, None])


@pytest.fixture(scope="module")
def problem(scene):
    points, observations, poses, _ = scene
    camera = RAW["radial-tangential"]
    pinhole = pinhole_of(camera)
    images = textured_planes.render(textured_planes.room(), poses, pinhole, np.ones(COUNT), noise=1.0)
    known = photometric.prepare(
        images, pinhole, points, observations, 7, sigma=4.0, offset_sigma=np.full(len(points), 0.01)
    )
    return replace(known, shifts=shifts_of(scene, camera, Calibration(np.eye(4))))


def state_of(problem, poses, shared=None):
    rough = textured_planes.disturbed(poses, 0.002, 0.02)
    offset = np.random.default_rng(1).normal(0, 0.002, len(problem.points))
    still = np.zeros(LAYOUT.size) if shared is None else shared
    return PhotometricState(CameraStates(rough, np.linspace(0, 0.02, COUNT)), offset, still)


def test_the_gradient_is_that_of_the_cost(problem, scene):
    """By differences, planes held: half a step this way and that, as large as a bilinear image is smooth."""
    exact = replace(problem, offset_sigma=None, elimination=None)
    state = state_of(problem, scene[2])
    border = photometric.linearize(exact, state).equations.border
    for k, size in zip(problem.shifts.columns, SIZES, strict=True):
        step = np.zeros(LAYOUT.size)
        step[k] = 0.02 * size
        ends = [
            photometric.linearize(exact, replace(state, shared=sign * step)).equations.cost
            for sign in (1, -1)
        ]
        slope = (ends[0] - ends[1]) / (2 * step[k])
        scale = np.sqrt(border.hessian[k, k])
        assert border.gradient[k] / scale == pytest.approx(slope / scale, rel=0.05, abs=0.5)


def test_the_border_is_what_a_dense_elimination_of_the_planes_leaves(problem, scene):
    state = state_of(problem, scene[2])
    found = photometric.linearize(problem, state)
    points, seen, by = problem.points, problem.observations, problem.shifts.by
    reference = points.reference[seen.point]
    images, count, m = 7 * COUNT, len(points), by.shape[2]
    hessian, gradient = np.zeros((images + m + count,) * 2), np.zeros(images + m + count)
    jacobians = observation_jacobians(problem, state)
    for o in range(len(seen)):
        index = np.concatenate([
            7 * reference[o] + np.arange(7), 7 * seen.target[o] + np.arange(7), images + np.arange(m),
            [images + m + seen.point[o]],
        ])  # fmt: skip
        row = np.zeros((3, 15 + m))
        row[:, :14], row[:, -1] = jacobians[o, :, :14], jacobians[o, :, 14]
        row[:2, 14:-1] = by[o]
        xx, xy, yy, xq, yq, qq, xr, yr, qr = problem.information[o] * found.sums[o, :9]
        square = np.array([[xx, xy, xq], [xy, yy, yq], [xq, yq, qq]])
        np.add.at(hessian, np.ix_(index, index), row.T @ square @ row)
        np.add.at(gradient, index, row.T @ [xr, yr, qr])
    planes = images + m + np.arange(count)
    hessian[planes, planes] += 1 / problem.offset_sigma**2
    gradient[planes] += state.offset / problem.offset_sigma**2
    kept = np.arange(images + m)
    through = hessian[np.ix_(kept, planes)] / hessian[planes, planes]
    left = hessian[np.ix_(kept, kept)] - through @ hessian[np.ix_(planes, kept)]
    pull = gradient[kept] - through @ gradient[planes]
    border, columns = found.equations.border, problem.shifts.columns
    scale = np.sqrt(np.diag(left)[images:])
    np.testing.assert_allclose(
        border.hessian[np.ix_(columns, columns)] / np.outer(scale, scale),
        left[images:, images:] / np.outer(scale, scale),
        atol=1e-9,
    )
    np.testing.assert_allclose(border.gradient[columns], pull[images:], rtol=1e-7, atol=1e-7 * scale.max())
    coupling = border.coupling[:, :, columns].reshape(images, m)
    np.testing.assert_allclose(
        coupling / scale, left[:images, images:] / scale, atol=1e-8 * np.abs(coupling / scale).max()
    )
    assert not border.hessian[: columns.min()].any()


def observation_jacobians(problem, state):
    """(O, 3, 15), as the kernels have them, from the derivatives of the centers and of the planes by differences."""
    from lvba.kernels import photometric_shared as kernels
    from lvba.kernels.scene import PlanePatches

    points, seen = problem.points, problem.observations

    def centers(offset):
        position = points.position_world + offset[:, None] * points.normal_world
        patches = PlanePatches(position, points.normal_world, points.reference, points.pixel)
        return kernels.centers(
            seen.point, seen.target, state.cameras.world_from_camera, problem.intrinsics, patches
        )

    _, _, by_poses = centers(state.offset)
    found = np.zeros((len(seen), 3, 15))
    found[:, :2, :6], found[:, :2, 7:13] = by_poses[:, :, :6], by_poses[:, :, 6:]
    found[:, 2, 6], found[:, 2, 13] = -1, 1
    h = 1e-6
    found[:, :2, 14] = (centers(state.offset + h)[0] - centers(state.offset - h)[0]) / (2 * h)
    return found
