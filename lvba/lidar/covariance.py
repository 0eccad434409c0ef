"""How certain the refined poses are.

The information leaves the planes' own parameters free, so it knows that they are estimated too. Where surfaces are not
quite flat or cells hold bits of others, errors within a cell go together and it promises too much: then the spread of the
planes' own gradients at the solution (the "sandwich" estimator: Huber 1967, White 1982; each plane one sample) is larger
than the noise that they should have, and the covariance is scaled by as much. The sandwich itself is not used: gradients
at the solution are smaller than those at the truth, and on simulated scenes it is too narrow by a half.
"""

from dataclasses import dataclass, field

import numpy as np
import scipy.linalg

from lvba import geometry
from lvba.arrays import PoseBlocks, Poses
from lvba.lidar import noise_information, panels, plane_factor
from lvba.lidar.plane_feature import PlaneFeatures, PlaneFits, fit
from lvba.lidar.problem import Problem
from lvba.optim.normal_equations import NormalEquations


@dataclass(frozen=True)
class Covariance:
    """Of poses, local tangent [rotation | translation], rad and m.

    marginal: (S, 6, 6), relative to the trajectory as a whole: of what is left after a rigid motion has brought the
        positions as close to the truth as it can. So the first pose has one too, and no pose is worse for being far from
        the first.
    conditional: (S, 6, 6), of each pose if all others were known: how far it may be off the map around it
    step: (S - 1, 6, 6), of the motion from each scan to the next, in the later one's tangent
    variance_factor: actual over modeled variance of the gradients, at least 1
    odometry_dependence: (S - 1,), of the translation of each step: its standard deviation with planes over that by the
        odometry alone, 0 to 1; none of more than MOST_NOISE_SCANS scans
    """

    marginal: np.ndarray
    conditional: np.ndarray
    step: np.ndarray = field(default_factory=lambda: np.zeros((0, 6, 6)))
    variance_factor: float = 1.0
    odometry_dependence: np.ndarray = field(default_factory=lambda: np.zeros(0))


MOST_NOISE_SCANS = 400
"""Scans: the noise information about more of them together is not looked at, for it takes an eigenproblem of all."""


def estimate(problem: Problem, world_from_scan: Poses) -> Covariance:
    """How certain poses (S, 4, 4) that solve a problem are. No more than two matrices of all pairs of poses at once."""
    fits = fit(problem.features, world_from_scan)
    information = problem.linearize(world_from_scan, exact=False, fits=fits).dense()
    own = _blocks(information, 0)
    with_noise = problem.prior is not None and len(world_from_scan) <= MOST_NOISE_SCANS
    whole = information[6:, 6:] if with_noise else None
    inverse = _inverse(information[6:, 6:])
    del information
    # the mean, over all motions, of what the robust covariance would be relative to the plain one
    variance_factor = max(1.0, _spread_by_covariance(problem, world_from_scan, fits, inverse) / len(inverse))
    inverse *= variance_factor
    step = _of_steps(inverse, world_from_scan)
    odometry_dependence = np.zeros(0)
    if problem.prior is not None and whole is not None:
        noise = noise_information.linearize(problem.features, fits, world_from_scan, problem.sigma)
        odometry = problem.prior.linearize(world_from_scan).dense()[6:, 6:]
        certain = noise_information.certain(whole - odometry, noise.dense()[6:, 6:], odometry)
        inverse = _inverse(certain / variance_factor + odometry)
        odometry_dependence = _narrowed(_of_steps(inverse, world_from_scan), problem.prior.information)
    conditional = np.stack([variance_factor * _inverse(block) for block in own])
    return Covariance(
        _aligned(inverse, world_from_scan), conditional, step, variance_factor, odometry_dependence
    )


def _blocks(matrix: np.ndarray, apart: int) -> np.ndarray:
    """(N - apart, 6, 6), of a matrix (6 N, 6 N): the blocks of each pose and the one so many places after it."""
    poses = len(matrix) // 6
    here = np.arange(poses - apart)
    return np.array(matrix.reshape(poses, 6, poses, 6)[here, :, here + apart])


def _narrowed(step: np.ndarray, odometry: np.ndarray) -> np.ndarray:
    """(S - 1,), the largest ratio, over directions of translation, of the deviations of steps (S - 1, 6, 6) to those of
    the odometry of this information (S - 1, 6, 6)."""
    known = np.linalg.cholesky(np.linalg.inv(np.linalg.inv(odometry)[:, 3:, 3:]))
    ratio = np.swapaxes(known, -1, -2) @ step[:, 3:, 3:] @ known
    return np.sqrt(np.maximum(np.linalg.eigvalsh(ratio)[:, -1], 0.0))


def _of_steps(covariance: np.ndarray, world_from_scan: np.ndarray) -> np.ndarray:
    """(S - 1, 6, 6), of the motion from each scan to the next, from the covariance (6 S - 6, 6 S - 6) of all but the
    first, which stands."""
    none = np.zeros((1, 6, 6))
    each = np.concatenate([none, _blocks(covariance, 0)])
    upper = np.concatenate([none, _blocks(covariance, 1)])
    relative = geometry.inverse(world_from_scan[1:]) @ world_from_scan[:-1]
    later = np.broadcast_to(np.eye(6), (len(relative), 6, 6))
    by_both = np.concatenate([-geometry.adjoint(relative), later], axis=2)
    pairs = np.empty((len(upper), 12, 12))
    pairs[:, :6, :6], pairs[:, 6:, 6:] = each[:-1], each[1:]
    pairs[:, :6, 6:], pairs[:, 6:, :6] = upper, np.swapaxes(upper, -1, -2)
    return np.asarray(by_both @ pairs @ np.swapaxes(by_both, -1, -2))


LEAST = 1e-12
"""rad^2 and m^2: alignment leaves nothing of the errors of very few scans, and what is divided by must not vanish."""
_WAY = 20
"""Scans before and after one that what it is uncertain of is compared with."""
_ORDINARY = 4.0
"""Times their variance that is nothing special: along a path, it grows and shrinks anyway."""


def local_covariance(covariance: Covariance, world_from_scan: Poses) -> np.ndarray:
    """(S, 6, 6), local tangent: how far each scan may be off what holds cameras at the same moment.

    At least as far as it may be off the map around it if all other scans were known. And as far as it is much less
    certain, within the trajectory, than the scans some way before and after: a group of scans that hang together and on
    the others by little is off together, but its cameras see the map of the others too.
    """
    conditional = covariance.conditional + LEAST * np.eye(6)
    rotation = world_from_scan[:, :3, :3]
    marginal = geometry.turn_tangent(covariance.marginal, rotation) + LEAST * np.eye(6)
    information = np.concatenate([np.zeros((1, 6, 6)), np.cumsum(np.linalg.inv(marginal), axis=0)])
    here = np.arange(len(marginal))
    first, last = np.maximum(here - _WAY, 0), np.minimum(here + _WAY + 1, len(marginal))
    mean = (information[last] - information[first]) / (last - first)[:, None, None]
    beyond = geometry.turn_tangent(marginal - _ORDINARY * np.linalg.inv(mean), np.swapaxes(rotation, -1, -2))
    return np.asarray(conditional + positive(beyond - conditional))


def positive(symmetric: PoseBlocks) -> np.ndarray:
    """The nearest (S, 6, 6) without negative eigenvalues."""
    values, vectors = np.linalg.eigh(symmetric)
    return np.asarray((vectors * np.maximum(values, 0.0)[:, None, :]) @ np.swapaxes(vectors, -1, -2))


def _inverse(information: np.ndarray) -> np.ndarray:
    """The inverse of a positive matrix; eigenvalues that rounding made negative count as tiny."""
    # symmetric, so its transpose in columns is the matrix itself in rows: LAPACK works on this one copy
    matrix = np.array(information).T
    try:
        factor, _ = scipy.linalg.cho_factor(matrix, lower=True, overwrite_a=True, check_finite=False)
        inverse, _ = scipy.linalg.lapack.dpotri(factor, lower=True, overwrite_c=True)
    except np.linalg.LinAlgError:
        values, vectors = scipy.linalg.eigh(information, check_finite=False)
        return np.asarray((vectors / np.maximum(values, 1e-9 * values[-1])) @ vectors.T)
    return _mirrored(inverse.T)


def _mirrored(matrix: np.ndarray) -> np.ndarray:
    """A square matrix with what is above its diagonal written below it too, in place: a copy would double the memory."""
    width = 256
    for at in range(0, len(matrix), width):
        below = at + width
        matrix[below:, at:below] = matrix[at:below, below:].T
        block = matrix[at:below, at:below]
        block[:] = np.triu(block) + np.triu(block, 1).T
    return matrix


def _spread_by_covariance(
    problem: Problem, world_from_scan: np.ndarray, fits: PlaneFits, covariance: np.ndarray
) -> float:
    """The trace of the product of the spread of all gradients, of planes and odometry, and a covariance
    (6 S - 6, 6 S - 6) of all poses but the first."""
    trace = _trace_of_product(_gradient_spread(problem, world_from_scan, fits), covariance)
    if problem.prior is not None:
        trace += _trace_of_product(problem.prior.linearize(world_from_scan), covariance)
    return trace


def _trace_of_product(equations: NormalEquations, covariance: np.ndarray) -> float:
    """tr(H C) of a Hessian and a covariance (6 S - 6, 6 S - 6) of all blocks but the first."""
    free = len(equations.gradient) - 1
    pairs = covariance.reshape(free, 6, free, 6)
    mine = equations.rows > 0
    rows, columns, blocks = equations.rows[mine] - 1, equations.columns[mine] - 1, equations.blocks[mine]
    traces = np.einsum("mab,mab->m", pairs[rows, :, columns], blocks)
    return float(np.where(rows == columns, 1.0, 2.0) @ traces)


def _gradient_spread(problem: Problem, world_from_scan: np.ndarray, fits: PlaneFits) -> NormalEquations:
    """Sum over planes of the outer products of their gradients, as the Hessian; no gradient, no cost."""
    features = problem.features
    gradient = observation_gradients(features, fits, world_from_scan) / problem.sigma**2
    if problem.projector is not None:
        in_world = geometry.turn_tangent(problem.projector, world_from_scan[:, :3, :3])
        gradient = np.einsum("oji,oj->oi", in_world[features.scan], gradient)
    scans = len(world_from_scan)
    laid = panels.pack(features, scans)
    columns = panels.fill(laid, features, gradient)
    poses = np.ascontiguousarray(world_from_scan)
    rows, others, blocks = plane_factor.hessian_blocks(laid, np.zeros((scans, 6, 6)), columns, poses)
    return NormalEquations(rows=rows, columns=others, blocks=-blocks, gradient=np.zeros((scans, 6)), cost=0.0)


def observation_gradients(features: PlaneFeatures, fits: PlaneFits, world_from_scan: Poses) -> np.ndarray:
    """Half the gradient of N lam0 by each observation's pose, (O, 6), m^2 per unit, world axes about the sensor."""
    clusters = features.clusters.weighted(features.weight).moved(world_from_scan, features.scan)
    normal = fits.normal[features.feature]
    lever = clusters.mean - world_from_scan[features.scan, :3, 3]
    height = clusters.count * np.einsum("oi,oi->o", normal, clusters.mean - fits.center[features.feature])
    xx, xy, xz, yy, yz, zz = clusters.scatter.T
    x, y, z = normal.T
    turned = np.stack([xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z], 1)
    turned += height[:, None] * lever
    return np.concatenate([np.cross(turned, normal), height[:, None] * normal], axis=1)


def _aligned(covariance: np.ndarray, world_from_scan: np.ndarray) -> np.ndarray:
    """(S, 6, 6), of each pose after the rigid motion that brings all positions closest to where they were, from the
    covariance C (6 S - 6, 6 S - 6) of all poses but the first: diagonal blocks of (I - M Q) C (I - M Q)', M rigid motions
    of all poses and Q what finds them."""
    motion, pick = alignment(world_from_scan)
    finds = np.linalg.solve(pick.T @ motion, pick.T)[:, 6:]
    common = finds @ covariance
    none = np.zeros((1, 6, 6))
    each = np.concatenate([none, _blocks(covariance, 0)])
    with_common = np.concatenate([none, np.swapaxes(common.reshape(6, -1, 6), 0, 1)])
    motion = motion.reshape(-1, 6, 6)
    cross = motion @ with_common
    own = motion @ (common @ finds.T) @ np.swapaxes(motion, -1, -2)
    return np.asarray(each - cross - np.swapaxes(cross, -1, -2) + own)


def alignment(world_from_scan: Poses) -> tuple[np.ndarray, np.ndarray]:
    """Rigid motions (6 S, 6) of all poses, local tangents, and what picks them out of a motion of all poses, (6 S, 6)."""
    arm = world_from_scan[:, :3, 3] - world_from_scan[:, :3, 3].mean(0)
    rigid = np.zeros((len(arm), 6, 6))
    rigid[:, :3, :3] = rigid[:, 3:, 3:] = np.eye(3)
    rigid[:, 3:, :3] = -geometry.hat(arm)
    seen = np.zeros_like(rigid)
    seen[:, 3:] = rigid[:, 3:]
    # positions on a line leave the rotation about it open: the orientations decide, as in `trajectory.align`
    lever = max(1e-3 * float(np.sqrt((arm**2).sum(1).mean())), 1e-6)
    seen[:, :3, :3] = lever**2 * np.eye(3)
    turn = np.zeros_like(rigid)
    turn[:, :3, :3] = turn[:, 3:, 3:] = np.swapaxes(world_from_scan[:, :3, :3], -1, -2)
    return (turn @ rigid).reshape(-1, 6), (turn @ seen).reshape(-1, 6)
