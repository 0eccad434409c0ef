"""How certain the refined poses are.

The information leaves the planes' own parameters free, so it knows that they are estimated too. Where surfaces are not
quite flat or cells hold bits of others, errors within a cell go together and it is too large: then the spread of the
planes' own gradients at the solution (the "sandwich" estimator: Huber 1967, White 1982; each plane one sample) is larger
than the noise that they should have, and the covariance is scaled by as much. The sandwich itself is not used: gradients
at the solution are smaller than those at the truth, and on simulated scenes it is too narrow by a half. Errors that
planes close to each other share, as a depth camera's, show in neither (`lidar.group_deletion`).
"""

from dataclasses import dataclass, field, replace

import numpy as np

from lvba import geometry
from lvba.arrays import PoseBlocks, Poses
from lvba.lidar import dense_covariance, group_deletion, noise_information, panels, plane_factor
from lvba.lidar.plane_feature import PlaneFeatures, PlaneFits, fit
from lvba.lidar.problem import Problem
from lvba.optim.normal_equations import NormalEquations


@dataclass(frozen=True)
class Covariance:
    """Of poses, local tangent [rotation | translation], rad and m.

    marginal: (S, 6, 6), relative to the trajectory as a whole: of what is left after the alignment that errors against a
        reference are counted after (`trajectory.align_for_errors`). So the first pose has one too, and no pose is worse
        for being far from the first.
    conditional: (S, 6, 6), of each pose if all others were known: how far it may be off the map around it
    in_map: (S, 6, 6), as `marginal`, but after the rigid motion that brings the points about all scanners as close as it
        can, however far the path extends
    step: (S - 1, 6, 6), of the motion from each scan to the next, in the later one's tangent
    variance_factor: actual over modeled variance of the gradients, at least 1
    shared_factor: what errors that planes close to each other share multiply `marginal` by, at least 1. It is for
        expected errors; scans and cameras are weighed against each other without, for both follow the planes
    odometry_dependence: (S - 1,), of the translation of each step: its standard deviation with planes over that by the
        odometry alone, 0 to 1; none of more than MOST_NOISE_SCANS scans
    """

    marginal: np.ndarray
    conditional: np.ndarray
    in_map: np.ndarray
    step: np.ndarray = field(default_factory=lambda: np.zeros((0, 6, 6)))
    variance_factor: float = 1.0
    shared_factor: float = 1.0
    odometry_dependence: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def with_own(self, own: PoseBlocks, world_from_scan: Poses) -> "Covariance":
        """Of poses (S, 4, 4) that are each off by something more, independently; own: (S, 6, 6) or (0, 6, 6), nothing."""
        if not len(own):
            return self
        step = self.step
        if len(step):
            carry = carry_to_next(world_from_scan)
            step = step + own[1:] + carry @ own[:-1] @ np.swapaxes(carry, -1, -2)
        return replace(
            self,
            marginal=self.marginal + own,
            conditional=self.conditional + own,
            in_map=self.in_map + own,
            step=step,
        )


MAP_M = 2.0
"""m: points this far from a scanner are where the map is. Where it moves by more than that, the positions decide."""
MOST_NOISE_SCANS = 400
"""Scans: the noise information about more of them together is not looked at, for it takes an eigenproblem of all."""


def estimate(problem: Problem, world_from_scan: Poses) -> Covariance:
    """How certain poses (S, 4, 4) that solve a problem are. No more than two matrices of all pairs of poses at once."""
    fits = fit(problem.features, world_from_scan)
    information = problem.linearize(world_from_scan, exact=False, fits=fits).dense()
    own = dense_covariance.blocks(information, 0)
    with_noise = problem.prior is not None and len(world_from_scan) <= MOST_NOISE_SCANS
    whole = information[6:, 6:] if with_noise else None
    inverse = dense_covariance.inverse(information[6:, 6:])
    del information
    # the mean, over all motions, of what the robust covariance would be relative to the plain one
    variance_factor = max(1.0, _spread_by_covariance(problem, world_from_scan, fits, inverse) / len(inverse))
    shared_factor = max(1.0, group_deletion.variance_factor(problem, world_from_scan) / variance_factor)
    inverse *= variance_factor
    step = _of_steps(inverse, world_from_scan)
    odometry_dependence = np.zeros(0)
    others = problem.linearize_others(world_from_scan)
    if problem.prior is not None and others is not None and whole is not None:
        noise = noise_information.linearize(problem.features, fits, world_from_scan, problem.sigma)
        odometry = others.dense()[6:, 6:]
        certain = noise_information.certain(whole - odometry, noise.dense()[6:, 6:], odometry)
        inverse = dense_covariance.inverse(certain / variance_factor + odometry)
        odometry_dependence = _narrowed(_of_steps(inverse, world_from_scan), problem.prior.information)
    conditional = np.stack([variance_factor * dense_covariance.inverse(block) for block in own])
    return Covariance(
        marginal=dense_covariance.aligned(inverse, world_from_scan),
        conditional=conditional,
        in_map=dense_covariance.aligned(inverse, world_from_scan, MAP_M),
        step=step,
        variance_factor=variance_factor,
        shared_factor=shared_factor,
        odometry_dependence=odometry_dependence,
    )


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
    each = np.concatenate([none, dense_covariance.blocks(covariance, 0)])
    upper = np.concatenate([none, dense_covariance.blocks(covariance, 1)])
    carry = carry_to_next(world_from_scan)
    by_both = np.concatenate([-carry, np.broadcast_to(np.eye(6), carry.shape)], axis=2)
    pairs = np.empty((len(upper), 12, 12))
    pairs[:, :6, :6], pairs[:, 6:, 6:] = each[:-1], each[1:]
    pairs[:, :6, 6:], pairs[:, 6:, :6] = upper, np.swapaxes(upper, -1, -2)
    return np.asarray(by_both @ pairs @ np.swapaxes(by_both, -1, -2))


def carry_to_next(world_from_scan: Poses) -> np.ndarray:
    """(S - 1, 6, 6) float64: what an error of each of poses (S, 4, 4) makes of the next, if the motion between them is
    right."""
    return geometry.adjoint(geometry.inverse(world_from_scan[1:]) @ world_from_scan[:-1])


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
    in_map = geometry.turn_tangent(covariance.in_map, rotation) + LEAST * np.eye(6)
    information = np.concatenate([np.zeros((1, 6, 6)), np.cumsum(np.linalg.inv(in_map), axis=0)])
    here = np.arange(len(in_map))
    first, last = np.maximum(here - _WAY, 0), np.minimum(here + _WAY + 1, len(in_map))
    mean = (information[last] - information[first]) / (last - first)[:, None, None]
    beyond = geometry.turn_tangent(in_map - _ORDINARY * np.linalg.inv(mean), np.swapaxes(rotation, -1, -2))
    return np.asarray(conditional + positive(beyond - conditional))


def positive(symmetric: PoseBlocks) -> np.ndarray:
    """The nearest (S, 6, 6) without negative eigenvalues."""
    values, vectors = np.linalg.eigh(symmetric)
    return np.asarray((vectors * np.maximum(values, 0.0)[:, None, :]) @ np.swapaxes(vectors, -1, -2))


def _spread_by_covariance(
    problem: Problem, world_from_scan: np.ndarray, fits: PlaneFits, covariance: np.ndarray
) -> float:
    """The trace of the product of the spread of all gradients, of planes, odometry and IMU, and a covariance
    (6 S - 6, 6 S - 6) of all poses but the first."""
    trace = _trace_of_product(_gradient_spread(problem, world_from_scan, fits), covariance)
    others = problem.linearize_others(world_from_scan)
    if others is not None:
        trace += _trace_of_product(others, covariance)
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
