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
from lvba.visual import trajectory_prior as priors
from lvba.visual.photometric import Linearization, Problem
from lvba.visual.states import CameraStates, VisualState
from lvba.visual.trajectory_prior import Prior

_NOISE_FACTOR = 4.0
"""Information counts from this many times what the scatter of normals makes up."""
_LEAST_TILT = 0.01
"""No normal is taken as better known than this, rad: real walls bulge, and poses of scans have errors of their own."""


@dataclass(frozen=True)
class WeakDirections:
    """count: (I,) int32, per image: common motions of it and its scene that nothing it sees holds
    common: (k, 6) float64, motions `[rotation | translation]` of all images about their middle, world axes, that
    nothing any image sees holds: rad and m, unit length where a radian counts as the scene's radius (see `_radius`)
    center: (3,) m, the middle
    """

    count: np.ndarray
    common: np.ndarray
    center: np.ndarray


def find(
    problem: Problem, linearization: Linearization, planes: Planes, weak_m: float = 0.02
) -> WeakDirections:
    """The weak directions of one solved level.

    weak_m: a motion is weak, too, where the images leave this much of it open (standard deviation, m)
    """
    points, observations = problem.points, problem.observations
    images = len(problem.images)
    if len(linearization.offset_hessian) != len(points):
        return WeakDirections(np.zeros(images, np.int32), np.zeros((0, 6)), np.zeros(3))
    center = points.position_world.mean(axis=0)
    arm = points.position_world - center
    radius = _radius(arm, weak_m)
    known, noise = _information(problem, linearization, planes, arm / radius)
    floor = np.eye(6) / weak_m**2
    common = _weak(known.sum(axis=0), noise.sum(axis=0), floor)
    entry = np.concatenate([np.arange(len(points)), observations.point])
    image = np.concatenate([points.reference, observations.target])
    count = np.zeros(images, np.int32)
    order = np.argsort(image, kind="stable")
    starts = np.searchsorted(image[order], np.arange(images + 1))
    for i in range(images):
        mine = np.unique(entry[order[starts[i] : starts[i + 1]]])
        count[i] = len(_weak(known[mine].sum(axis=0), noise[mine].sum(axis=0), floor))
    return WeakDirections(count, common / np.repeat([radius, 1.0], 3), center)


def _radius(arm: np.ndarray, least: float) -> float:
    """Root mean square distance of the scene points from their middle, m, `least` or more.

    arm: (P, 3) m. One point, or a few in one place, tell nothing of how a camera turns about them: with a radius that
    is no smaller than what counts as known of a position, all turns about them come out weak.
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


def _weak(known: np.ndarray, noise: np.ndarray, floor: np.ndarray) -> np.ndarray:
    """(k, 6): unit directions in which what is known is less than what noise makes up, or than the floor."""
    values, vectors = eigh(known, _NOISE_FACTOR * noise + floor)
    weak = vectors[:, values < 1.0].T
    return np.asarray(weak / np.linalg.norm(weak, axis=1, keepdims=True))


def hold(state: VisualState, prior: Prior, directions: WeakDirections, iterations: int = 5) -> VisualState:
    """The state with all cameras moved together, along the common weak directions only, to where the prior wants them.

    The images know nothing of such a motion but what noise makes up; so it is the prior's alone to decide.
    """
    if len(directions.common) == 0:
        return state
    for _ in range(iterations):
        hessian, gradient, _ = _prior_along(state, prior, directions)
        step = -np.linalg.solve(hessian, gradient)
        count = len(directions.common)
        to_center = geometry.from_rotation_translation(np.eye(3), directions.center)
        motion = to_center @ geometry.exp(step[:count] @ directions.common) @ geometry.inverse(to_center)
        poses = geometry.orthonormalize(motion @ state.cameras.world_from_camera)
        cameras = CameraStates(poses, state.cameras.log_exposure)
        state = VisualState(cameras, priors.retract(state.mount, step[count:]))
    return state


def held_covariance(state: VisualState, prior: Prior, directions: WeakDirections) -> np.ndarray:
    """(I, 6, 6): what the prior leaves open along the common weak directions, as covariance of each camera."""
    count = len(directions.common)
    if count == 0:
        return np.zeros((len(state.cameras), 6, 6))
    hessian, _, local = _prior_along(state, prior, directions)
    along = np.linalg.inv(hessian)[:count, :count]
    return np.asarray(local @ along @ np.swapaxes(local, 1, 2))


def _prior_along(
    state: VisualState, prior: Prior, directions: WeakDirections
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The prior's Hessian and gradient by [weak motions | mount], and each camera's tangent (I, 6, k) of the motions."""
    # where images know nothing, there is nothing to weigh the calibration against
    equations = priors.linearize(replace(prior, mount_information=None), state)
    images = len(state.cameras)
    to_center = geometry.from_rotation_translation(np.eye(3), directions.center)
    local = (
        geometry.adjoint(geometry.inverse(state.cameras.world_from_camera) @ to_center) @ directions.common.T
    )
    own = equations.blocks[(equations.rows == equations.columns) & (equations.rows < images)][:, :6, :6]
    cross = equations.blocks[(equations.rows < images) & (equations.columns == images)][:, :6]
    mount = equations.blocks[(equations.rows == images) & (equations.columns == images)][0]
    motion = np.einsum("nik,nij,njl->kl", local, own, local)
    coupling = np.einsum("nik,nij->kj", local, cross)
    hessian = np.block([[motion, coupling], [coupling.T, mount]])
    pull = np.einsum("nik,ni->k", local, equations.gradient[:images, :6])
    return hessian, np.concatenate([pull, equations.gradient[images]]), local
