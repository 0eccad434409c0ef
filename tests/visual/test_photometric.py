"""The photometric cost: its geometry, its residual, its derivatives, and the kernel against a plain twin."""

import naive_photometric as naive
import numba
import numpy as np
import pytest
import textured_planes

from lvba import geometry
from lvba.camera import Camera
from lvba.optim.normal_equations import Step
from lvba.visual import photometric
from lvba.visual.photometric import PhotometricState
from lvba.visual.scene_points import Observations, take
from lvba.visual.states import CameraStates

CAMERA = Camera(160, 120, 95.0, 97.0, 79.3, 59.1)


def part(points, observations, count: int):
    """The first scene points and their observations."""
    mine = observations.point < count
    kept = Observations(observations.point[mine], observations.target[mine], observations.is_global[mine])
    return take(points, np.arange(count)), kept


@pytest.fixture(scope="module")
def small():
    """A few images of the room, slightly wrong poses and exposures."""
    world, poses = textured_planes.room(), textured_planes.walk(4)
    images = textured_planes.render(world, poses, CAMERA, [1, 1.2, 0.9, 1.1], noise=2.0, supersample=1)
    points, observations = textured_planes.scene_points(world, poses, CAMERA, step=25)
    states = CameraStates(textured_planes.disturbed(poses, 0.004, 0.1), np.array([0, 0.2, -0.1, 0.05]))
    return images, points, observations, states


def still(states: CameraStates, points) -> PhotometricState:
    """Cameras over planes that are where they were found."""
    return PhotometricState(states, np.zeros(len(points)))


def test_the_squared_residual_is_what_eliminating_the_radiance_by_maximum_likelihood_leaves():
    rng = np.random.default_rng(0)
    reference, target = rng.uniform(5, 250, (2, 1000))
    eps_r, eps_t = 0.6, 1.7
    radiance = (eps_r * reference + eps_t * target) / (eps_r**2 + eps_t**2)
    left = (target - eps_t * radiance) ** 2 + (reference - eps_r * radiance) ** 2
    squared = photometric.residual(reference, target, eps_r, eps_t) ** 2
    assert np.abs(left - squared).max() < 1e-10 * left.max()


@pytest.mark.parametrize("growth", [0.0, 0.05])
def test_the_sums_of_every_observation_agree_with_the_plain_twin(small, growth, monkeypatch):
    images, points, observations, states = small
    monkeypatch.setattr(photometric, "SATURATED", 200.0)
    monkeypatch.setattr(photometric, "NOISE_GROWTH", growth)
    some = part(points, observations, 15)
    sigma = np.linspace(2.0, 6.0, len(some[1]))
    problem = photometric.prepare(images, CAMERA, *some, 7, sigma=sigma)
    fast = photometric.sums(problem, still(states, problem.points))
    slow = np.array([naive.observation_sums(problem, states, o) for o in range(len(problem.observations))])
    assert (slow[:, 10] > 0).mean() > 0.5
    assert (slow[:, 10] < 49).any(), "no pixel is masked: the masks are not tested"
    # a sample on the border of the mask or of a pixel may fall on either side in float32
    same = np.abs(fast[:, 10] - slow[:, 10]) < 0.5
    assert same.mean() > 0.97
    scale = np.abs(slow).max(axis=0)
    assert np.abs(fast[same] - slow[same]).max(axis=0) / scale == pytest.approx(np.zeros(13), abs=2e-4)


def test_the_sums_over_three_channels_are_those_of_the_channels(small):
    images, points, observations, states = small
    rng = np.random.default_rng(1)
    colored = np.concatenate([images, rng.permutation(images), images[::-1]], axis=3)
    whole = photometric.sums(
        photometric.prepare(colored, CAMERA, points, observations, 7), still(states, points)
    )
    parts = [
        photometric.sums(
            photometric.prepare(
                np.ascontiguousarray(colored[..., c : c + 1]), CAMERA, points, observations, 7
            ),
            still(states, points),
        )
        for c in range(3)
    ]
    assert whole == pytest.approx(sum(parts), rel=1e-5, abs=1e-3)


def test_the_normal_equations_agree_with_the_plain_twin(small):
    images, points, observations, states = small
    some = part(points, observations, 12)
    sigma = np.linspace(1.0, 5.0, len(some[1]))
    problem = photometric.prepare(images, CAMERA, *some, 5, sigma=sigma)
    equations = photometric.linearize(problem, still(states, problem.points)).equations
    hessian, gradient, cost = naive.normal_equations(problem, states)
    assert equations.cost == pytest.approx(cost, rel=1e-5)
    assert equations.gradient.ravel() == pytest.approx(gradient, abs=2e-4 * np.abs(gradient).max())
    assert equations.dense() == pytest.approx(hessian, abs=2e-4 * np.abs(hessian).max())


def test_the_gradient_is_the_slope_of_the_cost(small, monkeypatch):
    # smooth images and no mask, so that differences are meaningful; the Jacobian is that of the patch centre
    _, points, observations, states = small
    v, u = np.mgrid[:120, :160]
    smooth = [125 + 50 * np.sin(0.11 * u + k) * np.cos(0.13 * v - k) + 0.2 * u for k in range(4)]
    images = np.round(np.stack(smooth)).astype(np.uint8)[..., None]
    monkeypatch.setattr(photometric, "HUBER", 4.0)
    problem = photometric.prepare(images, CAMERA, points, observations, 5, sigma=8.0)
    gradient = photometric.linearize(problem, still(states, points)).equations.gradient
    slope = np.zeros_like(gradient)
    for image in range(4):
        for n in range(7):
            step = np.zeros_like(gradient)
            step[image, n] = 2e-5
            ahead, behind = (still(photometric.moved(states, d), points) for d in (step, -step))
            slope[image, n] = photometric.linearize(problem, ahead).equations.cost
            slope[image, n] -= photometric.linearize(problem, behind).equations.cost
    slope /= 4e-5
    assert gradient[:, 6] == pytest.approx(slope[:, 6], abs=2e-3 * np.abs(slope[:, 6]).max())
    assert gradient[:, :6] == pytest.approx(slope[:, :6], abs=0.03 * np.abs(slope[:, :6]).max())


@pytest.mark.parametrize("sigma_m", [None, 0.005])
def test_gradients_of_the_observations_add_up_to_the_whole(small, sigma_m):
    images, points, observations, states = small
    offset_sigma = None if sigma_m is None else np.full(len(points), sigma_m)
    problem = photometric.prepare(images, CAMERA, points, observations, offset_sigma=offset_sigma)
    state = still(states, points)
    for _ in range(60):  # the offsets alone: at their best they no longer pull the cameras
        at = photometric.linearize(problem, state)
        state = photometric.retract(problem, state, at, Step(np.zeros((len(states), 7)), np.zeros(0)))
    at = photometric.linearize(problem, state)
    total = np.zeros((len(states), 7))
    np.add.at(total, points.reference[observations.point], at.single[:, :7])
    np.add.at(total, observations.target, at.single[:, 7:14])
    whole = at.equations.gradient
    tolerance = 1e-9 if sigma_m is None else 0.02
    assert total == pytest.approx(whole, abs=tolerance * np.abs(whole).max())


def test_eliminating_plane_offsets_is_the_schur_complement(small):
    images, points, observations, states = small
    points, observations = part(points, observations, 10)
    offset_sigma = np.linspace(0.002, 0.02, 10)
    problem = photometric.prepare(images, CAMERA, points, observations, 5, offset_sigma=offset_sigma)
    state = PhotometricState(states, np.linspace(-0.01, 0.01, 10))
    hessian, gradient, cost = naive.normal_equations(problem, state.cameras, state.offset)
    cameras = 7 * len(states)
    hessian[cameras:, cameras:] += np.diag(1 / offset_sigma**2)
    gradient[cameras:] += state.offset / offset_sigma**2
    cost += 0.5 * ((state.offset / offset_sigma) ** 2).sum()
    own = np.linalg.inv(hessian[cameras:, cameras:])
    reduced = hessian[:cameras, :cameras] - hessian[:cameras, cameras:] @ own @ hessian[cameras:, :cameras]
    pulled = gradient[:cameras] - hessian[:cameras, cameras:] @ own @ gradient[cameras:]
    at = photometric.linearize(problem, state)
    assert at.equations.cost == pytest.approx(cost, rel=1e-5)
    assert at.equations.dense() == pytest.approx(reduced, abs=2e-4 * np.abs(reduced).max())
    assert at.equations.gradient.ravel() == pytest.approx(pulled, abs=2e-4 * np.abs(pulled).max())
    assert at.equations.eliminated == pytest.approx(
        0.5 * gradient[cameras:] @ own @ gradient[cameras:], rel=1e-3
    )
    step = 1e-3 * np.random.default_rng(0).normal(size=(len(states), 7))
    expected = state.offset - own @ (gradient[cameras:] + hessian[cameras:, :cameras] @ step.ravel())
    assert photometric.retract(problem, state, at, Step(step, np.zeros(0))).offset == pytest.approx(
        expected, abs=1e-5
    )


def test_any_partition_of_the_scene_points_adds_up_to_the_whole(small):
    images, points, observations, states = small
    sigma = np.full(len(points), 0.01)
    problem = photometric.prepare(images, CAMERA, points, observations, 7, offset_sigma=sigma)
    whole = photometric.linearize(problem, still(states, points)).equations
    group = np.random.default_rng(3).integers(0, 3, len(points))
    total = None
    for g in range(3):
        index = np.flatnonzero(group == g)
        renumbered = np.full(len(points), -1)
        renumbered[index] = np.arange(len(index))
        mine = group[observations.point] == g
        share = Observations(
            renumbered[observations.point[mine]].astype(np.int32), observations.target[mine],
            observations.is_global[mine],
        )  # fmt: skip
        mine = take(points, index)
        problem = photometric.prepare(images, CAMERA, mine, share, 7, offset_sigma=sigma[index])
        equations = photometric.linearize(problem, still(states, mine)).equations
        total = equations if total is None else total + equations
    assert total.cost == pytest.approx(whole.cost, rel=1e-12)
    assert total.gradient == pytest.approx(whole.gradient, rel=1e-9, abs=1e-9 * np.abs(whole.gradient).max())
    assert total.dense() == pytest.approx(whole.dense(), rel=1e-9, abs=1e-9 * np.abs(whole.dense()).max())


def test_one_thread_and_two_give_the_same_bytes(small):
    images, points, observations, states = small
    problem = photometric.prepare(
        images, CAMERA, points, observations, offset_sigma=np.full(len(points), 0.01)
    )
    threads = numba.get_num_threads()
    results = []
    try:
        for count in (1, min(2, threads)):
            numba.set_num_threads(count)
            results.append(photometric.linearize(problem, still(states, points)).equations)
    finally:
        numba.set_num_threads(threads)
    assert results[0].blocks.tobytes() == results[1].blocks.tobytes()
    assert results[0].gradient.tobytes() == results[1].gradient.tobytes()
    assert results[0].cost == results[1].cost


def test_a_patch_that_leaves_the_image_counts_as_noise_and_not_as_a_perfect_match(small):
    images, points, observations, states = small
    problem = photometric.prepare(images, CAMERA, points, observations, sigma=3.0)
    gone = states.world_from_camera.copy()
    gone[1] = gone[1] @ geometry.exp(np.array([0, 3.0, 0, 0, 0, 0]))
    away = CameraStates(gone, states.log_exposure)
    sums = photometric.sums(problem, still(away, points))
    touched = (observations.target == 1) | (points.reference[observations.point] == 1)
    assert (sums[touched, photometric.COUNT] == 0).all()
    assert photometric.linearize(problem, still(away, points)).equations.cost >= 0.5 * 81 * touched.sum()


@pytest.mark.parametrize("ratio", [2.5, 0.4])
def test_an_exposure_ratio_in_heavy_noise_comes_back_unbiased(ratio, monkeypatch):
    # dark images with sigma 6: the paper's eq. (8) read literally gives 2.384 here (and 0.569 for 0.4)
    rng = np.random.default_rng(5)
    radiance = np.repeat(np.repeat(rng.uniform(18, 44, (60, 80)), 6, axis=0), 6, axis=1)
    camera = Camera(480, 360, 400.0, 400.0, 239.5, 179.5)
    images = [
        np.round(np.clip(e * radiance + 6 * rng.normal(size=radiance.shape), 0, 255)) for e in (1.0, ratio)
    ]
    if ratio < 1:
        images = [
            np.round(np.clip(e * radiance * 2.5 + 6 * rng.normal(size=radiance.shape), 0, 255))
            for e in (1, ratio)
        ]
    images = np.stack(images).astype(np.uint8)[..., None]
    world = textured_planes.make(np.array([[0, 0, -1.0]]), np.array([[0, 0, 3.0]]), size=64)
    pose = np.eye(4)[None].repeat(2, axis=0)
    points, _ = textured_planes.scene_points(world, pose, camera, step=9, radius=4)
    count = len(points)
    keep = points.reference == 0
    points = take(points, keep)
    observations = Observations(
        np.arange(keep.sum(), dtype=np.int32), np.ones(keep.sum(), np.int32), np.zeros(keep.sum(), bool)
    )
    assert count > 1000
    monkeypatch.setattr(photometric, "HUBER", 100.0)
    monkeypatch.setattr(photometric, "DARK", 0.0)
    monkeypatch.setattr(photometric, "SATURATED", 255.0)
    problem = photometric.prepare(images, camera, points, observations, sigma=6.0)
    log_ratio = 0.0
    for _ in range(20):
        state = still(CameraStates(pose, np.array([0.0, log_ratio])), points)
        equations = photometric.linearize(problem, state).equations
        log_ratio -= equations.gradient[1, 6] / equations.dense()[13, 13]
    assert np.exp(log_ratio) == pytest.approx(ratio, rel=2e-3)
