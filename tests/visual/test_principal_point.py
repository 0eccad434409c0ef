"""One more shared parameter in the photometric problem, by a field, a prior and a Jacobian: the image center."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
import textured_planes

from lvba import geometry
from lvba.camera import Camera
from lvba.optim import linear_solver, shared_parameters
from lvba.optim.levenberg_marquardt import SolverConfig, levenberg_marquardt
from lvba.optim.normal_equations import Step
from lvba.optim.shared_parameters import SharedPrior, Vector, parameter
from lvba.visual import covariance, photometric, trajectory_prior
from lvba.visual.photometric import PhotometricState
from lvba.visual.prior_config import PriorConfig
from lvba.visual.states import Calibration, CameraStates, VisualState
from lvba.visual.trajectory_prior import Prior, Source

TRUE = Camera(160, 120, 95.0, 97.0, 79.3, 59.1)
OFF = np.array([0.6, -0.5])
COUNT = 6


@dataclass(frozen=True)
class WithPrincipalPoint(Calibration):
    """The calibration, and how far the principal point is off, px."""

    center: np.ndarray = field(default_factory=lambda: np.zeros(2), metadata=parameter(Vector(2, "px")))


SIZE = WithPrincipalPoint.layout().size


def centers(problem, cameras):
    """Where each observation's patch center is in its target, (O, 2) px, and its derivative by the principal point."""
    points, seen = problem.points, problem.observations
    at = seen.point
    pose_r, pose_t = (cameras.world_from_camera[i] for i in (points.reference[at], seen.target))
    camera, normal = problem.camera, points.normal_world[at]
    focal, center = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    ray = np.column_stack([(points.pixel[at] - center) / focal, np.ones(len(at))])
    distance = np.einsum("oi,oi->o", normal, points.position_world[at] - pose_r[:, :3, 3])
    between = (
        np.eye(3)
        + np.einsum("oi,oj->oij", pose_r[:, :3, 3] - pose_t[:, :3, 3], normal) / distance[:, None, None]
    )
    warp = np.swapaxes(pose_t[:, :3, :3], 1, 2) @ between @ pose_r[:, :3, :3]
    y = np.einsum("oij,oj->oi", warp, ray)
    by_y = np.zeros((len(at), 2, 3))
    by_y[:, [0, 1], [0, 1]] = focal / y[:, 2:]
    by_y[:, :, 2] = -focal * y[:, :2] / y[:, 2:] ** 2
    by_point = np.eye(2) - by_y @ warp[:, :, :2] / focal
    return focal * y[:, :2] / y[:, 2:] + center, by_point


def by_poses(problem, cameras):
    """(O, 2, 14): the same by reference and target, by differences."""
    found, seen = np.zeros((len(problem.observations), 2, 14)), problem.observations
    ends = (problem.points.reference[seen.point], seen.target)
    for image in range(COUNT):
        for n in range(6):
            step = np.zeros((COUNT, 7))
            step[image, n] = 1e-6
            slope = centers(problem, photometric.moved(cameras, step))[0]
            slope = (slope - centers(problem, photometric.moved(cameras, -step))[0]) / 2e-6
            for end in range(2):
                mine = ends[end] == image
                found[mine, :, 7 * end + n] = slope[mine]
    return found


def by_offsets(problem, cameras):
    """(O, 2): the same by the offset of the point's plane, by differences."""
    points, ends = problem.points, []
    for step in (1e-6, -1e-6):
        moved = replace(points, position_world=points.position_world + step * points.normal_world)
        ends.append(centers(replace(problem, points=moved), cameras)[0])
    return (ends[0] - ends[1]) / 2e-6


class Photometric:
    """The photometric factor with the principal point's Jacobian: the one thing to write for it."""

    def __init__(self, problem) -> None:
        self.problem = problem

    def at(self, state: VisualState):
        off, camera = state.calibration.center, self.problem.camera
        return replace(self.problem, camera=replace(camera, cx=camera.cx + off[0], cy=camera.cy + off[1]))

    def by_shared(self, state: VisualState):
        layout = state.calibration.layout()
        found = np.zeros((len(self.problem.observations), 3, layout.size))
        found[:, :2, layout["center"]] = centers(self.at(state), state.cameras)[1]
        return found

    def linearize(self, state: VisualState):
        problem = self.at(state)
        still = PhotometricState(state.cameras, np.zeros(len(problem.points)))
        return photometric.linearize(problem, still, by_shared=self.by_shared(state)).equations


def whole(factor, state, offset_sigma=None):
    """Hessian (n, n) and gradient (n,) over images, shared parameters and plane offsets, observation by observation."""
    problem, seen = factor.at(state), factor.problem.observations
    shared, points = factor.by_shared(state), 0 if offset_sigma is None else len(factor.problem.points)
    sums = photometric.sums(problem, PhotometricState(state.cameras, np.zeros(len(problem.points))))
    poses, offsets = by_poses(problem, state.cameras), by_offsets(problem, state.cameras)
    last = 7 * COUNT + shared.shape[2]
    hessian, gradient = np.zeros((last + points,) * 2), np.zeros(last + points)
    for o in range(len(seen)):
        row = np.zeros((3, last + points))
        reference, target = problem.points.reference[seen.point[o]], seen.target[o]
        row[:2, 7 * reference : 7 * reference + 7] = poses[o, :, :7]
        row[:2, 7 * target : 7 * target + 7] = poses[o, :, 7:]
        row[2, 7 * reference + 6], row[2, 7 * target + 6] = -1.0, 1.0
        row[:, 7 * COUNT : last] = shared[o]
        if points:
            row[:2, last + seen.point[o]] = offsets[o]
        xx, xy, yy, xq, yq, qq, xr, yr, qr = sums[o, :9]
        weight = problem.information[o]
        hessian += weight * row.T @ np.array([[xx, xy, xq], [xy, yy, yq], [xq, yq, qq]]) @ row
        gradient += weight * row.T @ [xr, yr, qr]
    hessian[np.arange(last, last + points), np.arange(last, last + points)] += (
        1 / offset_sigma**2 if points else 0.0
    )
    return hessian, gradient


@pytest.fixture(scope="module")
def scene():
    world, poses = textured_planes.room(), textured_planes.walk(COUNT)
    images = textured_planes.render(world, poses, TRUE, np.ones(COUNT), noise=2.0, supersample=2)
    wrong = replace(TRUE, cx=TRUE.cx - OFF[0], cy=TRUE.cy - OFF[1])
    points, observations = textured_planes.scene_points(world, poses, TRUE, step=14)
    problem = photometric.prepare(images, wrong, points, observations, 7, sigma=4.0, variance_factor=2.0)
    start = WithPrincipalPoint(np.eye(4))
    sigma = {**PriorConfig().sigma, "center": 2.0}
    known = SharedPrior(start, shared_parameters.information(start.layout(), sigma))
    none = np.zeros((COUNT, 3))
    each, exact = np.ones((COUNT, 3)), np.zeros((COUNT, 3))
    tight = np.radians(0.05) * each, 0.003 * each, exact, exact
    prior = Prior((Source(poses, *tight),), none, none, known)
    rough = textured_planes.disturbed(poses, 0.003, 0.05)
    return Photometric(problem), prior, VisualState(CameraStates(rough, np.zeros(COUNT)), start)


def test_its_jacobian_is_that_of_the_warp(scene):
    factor, _, state = scene
    problem, h = factor.problem, 1e-5
    slopes = []
    for step in h * np.eye(2):
        ends = []
        for sign in (1, -1):
            cx, cy = np.array([problem.camera.cx, problem.camera.cy]) + sign * step
            ends.append(
                centers(replace(problem, camera=replace(problem.camera, cx=cx, cy=cy)), state.cameras)[0]
            )
        slopes.append((ends[0] - ends[1]) / (2 * h))
    assert centers(problem, state.cameras)[1] == pytest.approx(np.stack(slopes, axis=2), abs=1e-7)


def test_it_is_found_with_the_covariance_of_a_dense_twin(scene):
    factor, prior, start = scene
    free = np.ones((COUNT, 7), bool)
    free[:, 6] = False

    def linearize(state):
        return factor.linearize(state) + trajectory_prior.linearize(prior, state)

    def retract(state, step):
        return VisualState(
            photometric.moved(state.cameras, step.blocks), state.calibration.retract(step.shared)
        )

    config = SolverConfig(max_iterations=30, relative_decrease=1e-7)
    found = levenberg_marquardt(start, linearize, retract, config, free).state
    total = linearize(found)
    known = linear_solver.covariance(total, free)
    where = start.calibration.layout()["center"]
    sigma = np.sqrt(np.diag(known.shared))[where]
    assert (sigma < 0.2).all()
    assert (np.abs(found.calibration.center - OFF) < np.maximum(3 * sigma, 0.05)).all()
    hessian = whole(factor, found)[0] + trajectory_prior.linearize(prior, found).dense()
    index = np.flatnonzero(np.append(free.ravel(), np.ones(SIZE, bool)))
    inverse = np.linalg.inv(hessian[np.ix_(index, index)])
    np.testing.assert_allclose(known.shared, inverse[-SIZE:, -SIZE:], rtol=1e-4, atol=1e-12)
    pose = inverse[:6, :6]
    np.testing.assert_allclose(known.blocks[0, :6, :6], pose, rtol=1e-4, atol=1e-7 * np.abs(pose).max())
    # an extrinsic that the principal point moves with would be told wrong without it
    assert np.linalg.norm(geometry.log(found.calibration.scan_from_camera)) < 0.02


def test_plane_offsets_are_eliminated_from_the_border_too(scene):
    factor, _, state = scene
    count = len(factor.problem.points)
    sigma = np.full(count, 0.004)
    prepared = photometric.prepare(
        factor.problem.images, factor.problem.camera, factor.problem.points, factor.problem.observations, 7,
        offset_sigma=sigma, sigma=4.0, variance_factor=2.0,
    )  # fmt: skip
    factor = Photometric(prepared)
    hessian, gradient = whole(factor, state, sigma)
    last = 7 * COUNT + SIZE
    through = np.linalg.solve(hessian[last:, last:], hessian[last:, :last])
    expected = hessian[:last, :last] - hessian[:last, last:] @ through
    pull = gradient[:last] - gradient[last:] @ through
    at = PhotometricState(state.cameras, np.zeros(count))
    found = photometric.linearize(factor.at(state), at, by_shared=factor.by_shared(state))
    equations = found.equations
    np.testing.assert_allclose(equations.dense(), expected, atol=1e-6 * np.abs(expected).max())
    flat = np.append(equations.gradient.ravel(), equations.border.gradient)
    np.testing.assert_allclose(flat, pull, atol=1e-6 * np.abs(pull).max())
    step = Step(0.001 * np.random.default_rng(0).normal(size=(COUNT, 7)), np.linspace(-0.1, 0.1, SIZE))
    moved = photometric.retract(factor.at(state), at, found, step)
    offsets = -np.linalg.solve(hessian[last:, last:], gradient[last:])
    offsets -= through @ np.append(step.blocks.ravel(), step.shared)
    np.testing.assert_allclose(moved.offset, offsets, rtol=1e-4, atol=1e-6 * np.abs(offsets).max())
    assert np.abs(found.shared.single.sum(axis=0)[-2:]).max() > 0.0


def test_walls_tell_the_covariance_how_they_pull_at_it(scene):
    factor, prior, state = scene
    problem = factor.at(state)
    at = PhotometricState(state.cameras, np.zeros(len(problem.points)))
    found = photometric.linearize(problem, at, by_shared=factor.by_shared(state))
    total = found.equations + trajectory_prior.linearize(prior, state)
    walls = covariance.find_wall_clusters(problem)
    gradients = covariance.wall_gradients(problem, found, at, walls, total)
    clusters = covariance.bias_reduced_gradients(gradients, total.shared)
    assert clusters.shape[1] == 7 * COUNT + SIZE
    summed = np.asarray(clusters[:, -SIZE:].sum(axis=0)).ravel()
    assert summed == pytest.approx(found.equations.border.gradient)
