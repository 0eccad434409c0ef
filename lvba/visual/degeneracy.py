"""Directions in which the images do not hold the cameras, because no plane they see faces that way.

A plane moved along its normal looks to the images as all cameras moved the other way. So what the images know of a
common motion is what point-to-plane registration knows of it: `sum of w a a^T`, `a = [(p - c) x n, n]`, with w the
photometric information on each plane's offset. Normals are noisy: over a bare plane their scatter alone makes up
information along the plane. What scatter can make up is subtracted by comparison, not taken for granted.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import eigh

from lvba import geometry
from lvba.lidar.plane import Planes
from lvba.optim import linear_solver
from lvba.optim.levenberg_marquardt import SolverConfig, levenberg_marquardt
from lvba.optim.normal_equations import NormalEquations, Step
from lvba.visual import trajectory_prior
from lvba.visual.photometric import Linearization, Problem
from lvba.visual.states import CameraStates, VisualState
from lvba.visual.trajectory_prior import Prior

_NOISE_FACTOR = 4.0
"""Information counts from this many times what the scatter of normals makes up."""
_LEAST_TILT = 0.01
"""No normal is taken as better known than this, rad: real walls bulge, and poses of scans have errors of their own."""


@dataclass(frozen=True)
class DegenerateDirections:
    """count: (I,) int32, per image: common motions of it and its scene that nothing it sees holds
    common: (k, 6) float64, motions `[rotation | translation]` of all images about their middle, world axes, that
    nothing any image sees holds: rad and m, unit length where a radian counts as the scene's radius (see `_radius`)
    center: (3,) m, the middle
    """

    count: np.ndarray
    common: np.ndarray
    center: np.ndarray


def find(
    problem: Problem, linearization: Linearization, planes: Planes, degenerate_m: float = 0.02
) -> DegenerateDirections:
    """The degenerate directions of one solved level.

    degenerate_m: a motion is degenerate, too, where the images leave this much of it open (standard deviation, m)
    """
    points, observations = problem.points, problem.observations
    images = len(problem.images)
    if len(linearization.offset_hessian) != len(points):
        return DegenerateDirections(np.zeros(images, np.int32), np.zeros((0, 6)), np.zeros(3))
    center = points.position_world.mean(axis=0)
    arm = points.position_world - center
    radius = _radius(arm, degenerate_m)
    known, noise = _information(problem, linearization, planes, arm / radius)
    floor = np.eye(6) / degenerate_m**2
    common = _degenerate(known.sum(axis=0), noise.sum(axis=0), floor)
    entry = np.concatenate([np.arange(len(points)), observations.point])
    image = np.concatenate([points.reference, observations.target])
    count = np.zeros(images, np.int32)
    order = np.argsort(image, kind="stable")
    starts = np.searchsorted(image[order], np.arange(images + 1))
    for i in range(images):
        mine = np.unique(entry[order[starts[i] : starts[i + 1]]])
        count[i] = len(_degenerate(known[mine].sum(axis=0), noise[mine].sum(axis=0), floor))
    return DegenerateDirections(count, common / np.repeat([radius, 1.0], 3), center)


def _radius(arm: np.ndarray, least: float) -> float:
    """Root mean square distance of the scene points from their middle, m, `least` or more.

    arm: (P, 3) m. One point, or a few in one place, tell nothing of how a camera turns about them: with a radius that
    is no smaller than what counts as known of a position, all turns about them come out degenerate.
    """
    return max(float(np.sqrt(np.square(arm).sum(axis=1).mean())), least)


def _information(
    problem: Problem, linearization: Linearization, planes: Planes, arm: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(P, 6, 6): what each point tells of a common motion, and what its normal's scatter alone would make up."""
    assert problem.offset_sigma is not None
    points = problem.points
    precision = 1 / problem.offset_sigma**2
    seen = np.maximum(linearization.offset_hessian - precision, 0.0)
    weight = seen * precision / (seen + precision)
    row = np.concatenate([np.cross(arm, points.normal_world), points.normal_world], axis=1)
    known = np.einsum("p,pi,pj->pij", weight, row, row)
    noise = np.zeros_like(known)
    variance = planes.sigma_offset[points.plane, None] ** 2 / np.maximum(
        planes.eigenvalues[points.plane], 1e-12
    )
    variance += _LEAST_TILT**2
    for k in (1, 2):
        axis = planes.axes[points.plane, :, k]
        row = np.concatenate([np.cross(arm, axis), axis], axis=1)
        noise += np.einsum("p,pi,pj->pij", weight * variance[:, k], row, row)
    return known, noise


def _degenerate(known: np.ndarray, noise: np.ndarray, floor: np.ndarray) -> np.ndarray:
    """(k, 6): unit directions in which what is known is less than what noise makes up, or than the floor."""
    values, vectors = eigh(known, _NOISE_FACTOR * noise + floor)
    open_motions = vectors[:, values < 1.0].T
    return np.asarray(open_motions / np.linalg.norm(open_motions, axis=1, keepdims=True))


_HOLD = SolverConfig(max_iterations=20, initial_damping=0.0, relative_decrease=1e-9, step_tolerance=1e-9)


def return_to_prior(state: VisualState, prior: Prior, directions: DegenerateDirections) -> VisualState:
    """The state with all cameras moved together, along the common degenerate directions only, to the prior.

    The images know nothing of such a motion but what noise makes up; so it is the prior's alone to decide.
    """
    if len(directions.common) == 0:
        return state
    # where images know nothing, there is nothing to weigh the calibration against
    prior = replace(prior, calibration=replace(prior.calibration, counted=None))
    to_center = geometry.from_rotation_translation(np.eye(3), directions.center)

    def moved(at: VisualState, step: Step) -> VisualState:
        motion = to_center @ geometry.exp(step.blocks[0] @ directions.common) @ geometry.inverse(to_center)
        poses = geometry.orthonormalize(motion @ at.cameras.world_from_camera)
        cameras = CameraStates(poses, at.cameras.log_exposure)
        return replace(at, cameras=cameras, calibration=at.calibration.retract(step.shared))

    return levenberg_marquardt(state, lambda at: _prior_along(at, prior, directions), moved, _HOLD).state


def held_covariance(state: VisualState, prior: Prior, directions: DegenerateDirections) -> np.ndarray:
    """(I, 6, 6): what the prior leaves open along the common degenerate directions, as covariance of each camera."""
    if len(directions.common) == 0:
        return np.zeros((len(state.cameras), 6, 6))
    prior = replace(prior, calibration=replace(prior.calibration, counted=None))
    along = linear_solver.covariance(_prior_along(state, prior, directions)).blocks[0]
    local = _tangents(state, directions)
    return np.asarray(local @ along @ np.swapaxes(local, 1, 2))


def _prior_along(state: VisualState, prior: Prior, directions: DegenerateDirections) -> NormalEquations:
    """The prior's equations over the degenerate motions, one block, bordered by the calibration."""
    by_motion = np.zeros((len(state.cameras), 7, len(directions.common)))
    by_motion[:, :6] = _tangents(state, directions)
    return trajectory_prior.linearize(prior, state).together(by_motion)


def _tangents(state: VisualState, directions: DegenerateDirections) -> np.ndarray:
    """(I, 6, m): each camera's tangent of the degenerate motions."""
    to_center = geometry.from_rotation_translation(np.eye(3), directions.center)
    carry = geometry.adjoint(geometry.inverse(state.cameras.world_from_camera) @ to_center)
    return np.asarray(carry @ directions.common.T)
