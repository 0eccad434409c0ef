"""Linearizing the plane cost and the prior, and the damped step: apart, so that either can be replaced."""

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from lvba import geometry
from lvba.kernels import lidar as kernel
from lvba.lidar import panels
from lvba.lidar.odometry_factor import OdometryPrior
from lvba.lidar.plane_feature import PlaneFeatures, PlaneFits, fit
from lvba.lidar.point_cluster import split

HESSIAN_BYTES_PER_POSE_SQUARED = 6 * 6 * 8
"""Memory of the dense Hessian: this times the square of the number of scans."""


@dataclass(frozen=True)
class Problem:
    """Planes, how sharply they are measured, and the prior.

    features: the plane observations
    sigma: m, standard deviation of a point's distance to its plane at weight 1
    """

    features: PlaneFeatures
    sigma: float
    prior: OdometryPrior | None
    projector: np.ndarray | None = None
    """(S, 6, 6), keeps of a motion what the planes determine (see `degeneracy`); None: all of it."""

    def cost(self, world_from_scan: np.ndarray, fits: PlaneFits | None = None) -> float:
        """Half the sum of squared normalized residuals at poses (S, 4, 4); fits: of the planes there, if at hand."""
        fits = fit(self.features, world_from_scan) if fits is None else fits
        planes = 0.5 * fits.cost / self.sigma**2
        return planes + (self.prior.cost(world_from_scan) if self.prior else 0.0)


@dataclass(frozen=True)
class NormalEquations:
    """The second-order model of the cost at some poses; perturbation in world axes about each sensor.

    hessian: (6 S, 6 S) float64; gradient: (6 S,); cost: scalar
    """

    hessian: np.ndarray
    gradient: np.ndarray
    cost: float

    def __add__(self, other: "NormalEquations") -> "NormalEquations":
        return NormalEquations(
            self.hessian + other.hessian, self.gradient + other.gradient, self.cost + other.cost
        )


def linearize_planes(
    features: PlaneFeatures,
    world_from_scan: np.ndarray,
    sigma: float,
    fits: PlaneFits | None = None,
    exact: bool = True,
) -> NormalEquations:
    """Cost, exact gradient and exact (or Gauss-Newton) Hessian of the planes at poses (S, 4, 4)."""
    fits = fit(features, world_from_scan) if fits is None else fits
    rotation, translation = split(world_from_scan)
    clusters = features.clusters.weighted(features.weight)
    laid = panels.lay_out(features, len(world_from_scan))
    gradient, diagonal, columns = kernel.linearize(
        rotation,
        translation,
        *panels.by_scan(features, len(world_from_scan)),
        features.feature,
        clusters.count,
        clusters.mean,
        clusters.scatter,
        fits.total,
        fits.center,
        fits.eigenvalues,
        fits.eigenvectors,
        laid.panel,
        len(laid.feature),
        exact,
    )
    scale = 0.5 / sigma**2  # the kernel's cost is the sum of squares
    hessian = kernel.hessian(laid.starts, laid.feature, laid.seen, diagonal, columns)
    hessian *= scale
    return NormalEquations(hessian, gradient.ravel() * scale, fits.cost * scale)


def add_prior(
    equations: NormalEquations, prior: OdometryPrior, world_from_scan: np.ndarray
) -> NormalEquations:
    """The equations with the prior's added; the Hessian is changed in place, a copy would double the memory."""
    gradient, diagonal, upper = prior.linearize(world_from_scan)
    scans = len(world_from_scan)
    blocks = equations.hessian.reshape(scans, 6, scans, 6)
    here = np.arange(scans)
    blocks[here, :, here, :] += diagonal
    blocks[here[:-1], :, here[1:], :] += upper
    blocks[here[1:], :, here[:-1], :] += np.swapaxes(upper, -1, -2)
    cost = equations.cost + prior.cost(world_from_scan)
    return NormalEquations(equations.hessian, equations.gradient + gradient.ravel(), cost)


def _project(equations: NormalEquations, projector: np.ndarray) -> NormalEquations:
    """The equations with what they say about weak directions taken out; the Hessian is changed in place."""
    scans = len(projector)
    hessian, gradient = equations.hessian, equations.gradient.reshape(scans, 6)
    weak = np.flatnonzero(np.abs(projector - np.eye(6)).max((1, 2)) > 0)
    for index in weak:
        rows = slice(6 * index, 6 * index + 6)
        hessian[rows] = projector[index].T @ hessian[rows]
        hessian[:, rows] = hessian[:, rows] @ projector[index]
    gradient = np.einsum("nji,nj->ni", projector, gradient)
    return NormalEquations(hessian, gradient.ravel(), equations.cost)


def linearize(
    problem: Problem, world_from_scan: np.ndarray, exact: bool = True, fits: PlaneFits | None = None
) -> NormalEquations:
    """The normal equations of the whole problem at poses (S, 4, 4); fits: of the planes there, if at hand."""
    equations = linearize_planes(problem.features, world_from_scan, problem.sigma, fits, exact)
    if problem.projector is not None:
        equations = _project(equations, problem.projector)
    return add_prior(equations, problem.prior, world_from_scan) if problem.prior else equations


def damped_step(equations: NormalEquations, damping: np.ndarray) -> np.ndarray | None:
    """The step (S, 6) of (H + diag(damping)) x = -g, first pose fixed; None where that matrix is not positive.

    damping: (6,), added to the information of each scan's motion.
    """
    hessian = equations.hessian[6:, 6:].copy()
    diagonal = np.arange(len(hessian))
    hessian[diagonal, diagonal] += np.tile(damping, len(hessian) // 6)
    try:
        factor = scipy.linalg.cho_factor(hessian.T, lower=True, overwrite_a=True, check_finite=False)
    except np.linalg.LinAlgError:
        return None
    step = -scipy.linalg.cho_solve(factor, equations.gradient[6:], check_finite=False)
    return np.concatenate([np.zeros(6), step]).reshape(-1, 6)


def retract(world_from_scan: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Poses (S, 4, 4) moved by (S, 6) in world axes about each sensor."""
    turn = geometry.exp(np.concatenate([step[:, :3], np.zeros((len(step), 3))], axis=1))
    moved = world_from_scan.copy()
    moved[:, :3, :3] = turn[:, :3, :3] @ world_from_scan[:, :3, :3]
    moved[:, :3, 3] += step[:, 3:]
    moved[1:] = geometry.orthonormalize(moved[1:])
    return moved
