"""Information about all scans together that is due to noise of the planes' normals alone.

A group of scans may hold fast to each other and hang on the others by little: those that see the floor of one room,
and of all other rooms only walls, can go up and down together. Each of them is well held, so `degeneracy` does not see
it. What little the planes say about such a motion is no more than what noise of their normals makes up: the covariance
does not count it, and a step weighs it against the odometry.
"""

from dataclasses import replace

import numpy as np
import scipy.linalg

from lvba import geometry
from lvba.arrays import Poses, StepSigmas
from lvba.lidar import plane_factor
from lvba.lidar.degeneracy import TRUSTED_POINTS, normal_variance
from lvba.lidar.plane_feature import PlaneFeatures, PlaneFits, fit
from lvba.lidar.problem import LidarSolution, Problem
from lvba.optim import normal_equations
from lvba.optim.levenberg_marquardt import damped_step
from lvba.optim.normal_equations import NormalEquations

MOST_SCANS = 250
"""More together are not weighed: each round takes an eigenproblem of all, 0.4 s for 100 scans, cubic."""
COVARIANCE_FACTOR = 16.0
"""Multiple of the noise information that the covariance does not count: four times that which is not followed of a
single scan (`degeneracy.SIGNAL_TO_NOISE`). Normals are off by twice what `degeneracy.TRUSTED_POINTS` have it, in
simulated rooms of known walls: cells hold bits of other surfaces, and their faces cut the noise off at a slant. 32 is too
modest in the open."""
STEP_FACTOR = 16.0
"""Multiple of the noise information at which the planes' information counts half in a step. Of 1, 4, 16 and 64 in six
simulated rooms, 16 brought groups back (four: half of the way) without giving up what planes do know (64)."""
STEP_POINTS = 200.0
"""Points that a normal counts for at most in a step. By 50 (`degeneracy.TRUSTED_POINTS`), a depth camera's scans of a
cabinet (noise of 14 mm, a thousand points on a plane), which planes held to 3 mm, went 18 mm off with the odometry.
Of 50, 200 and all, in 30 simulations each: cabinets with a depth camera 7.3, 5.2, 4.8 mm (geometric mean), rooms with one
31, 32, 36 mm, rooms with a narrow LiDAR 77, 70, 68 mm."""
_LEAST_NOISE = 1e-3
"""Noise information at least, relative to the odometry's: planes say nothing a thousand times better than noise has
it."""
_LEAST_VARIANCE = 1e-12
"""rad^2, of a normal: planes of no thickness keep a weight, which the elimination of their parameters divides by."""


def linearize(
    features: PlaneFeatures,
    fits: PlaneFits,
    world_from_scan: Poses,
    sigma: float,
    trusted: float = TRUSTED_POINTS,
) -> NormalEquations:
    """Information about the poses (S, 4, 4) that noise of the planes' normals makes up: its Hessian; the rest means
    nothing.

    A normal that is off by e towards a tangent takes a motion along that tangent for one of e times its size along the
    normal. So this is the planes' Gauss-Newton Hessian with the tangents for normals, each plane weighted by the variance
    of its normal towards it. The planes' own parameters are eliminated: a motion common to all scans that see a plane
    counts for nothing, as in the true one.
    sigma: m, of a point; trusted: points that a normal counts for at most
    """
    variances = normal_variance(fits, trusted)
    terms = []
    for tangent in (1, 2):
        variance = np.maximum(variances[:, tangent - 1], _LEAST_VARIANCE)
        weighed = replace(features, weight=features.weight * variance[features.feature])
        axes = fits.eigenvectors.copy()
        axes[:, 0] = fits.eigenvectors[:, tangent]
        turned = replace(fits, total=fits.total * variance, eigenvectors=axes)
        terms.append(plane_factor.linearize(weighed, world_from_scan, sigma, turned, exact=False))
    return terms[0] + terms[1]


def certain(information: np.ndarray, noise: np.ndarray, odometry: np.ndarray) -> np.ndarray:
    """What is left of the planes' information (N, N) without what noise makes up and the odometry knows anyway.

    noise: (N, N) float64, taken out COVARIANCE_FACTOR times; odometry: (N, N) float64, positive. Motions about which the
    planes say less than these two are not determined by them at all.
    information: (N, N) float64
    """
    floor = COVARIANCE_FACTOR * noise + odometry
    left = information - floor
    try:
        scipy.linalg.cholesky(left, check_finite=False)
        return np.asarray(left)
    except np.linalg.LinAlgError:
        values, vectors = scipy.linalg.eigh(
            information, floor, subset_by_value=(-np.inf, 1.0), check_finite=False
        )
    open_motions = floor @ vectors
    return np.asarray(left + (open_motions * (1.0 - values)) @ open_motions.T)


def weighed(
    information: np.ndarray, gradient: np.ndarray, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The planes' information (N, N) and gradient (N,), each motion weighed by mu / (mu + STEP_FACTOR).

    mu: times as much information about the motion as noise makes up. All scaled by the odometry's deviations, noise (N,
    N) too. mu and the motions: the generalized eigenproblem of the two, in which both are diagonal.
    information: (N, N) float64; gradient: (N,) float64; noise: (N, N) float64
    """
    floor = noise + _LEAST_NOISE * np.eye(len(noise))
    mu, motions = scipy.linalg.eigh(information, floor, check_finite=False)
    mu = np.maximum(mu, 0.0)
    weight = mu / (mu + STEP_FACTOR)
    back = floor @ motions
    return (back * (mu * weight)) @ back.T, back @ (weight * (motions.T @ gradient))


def linearize_weighed(
    problem: Problem, world_from_scan: Poses, prior_sigmas: StepSigmas, fits: PlaneFits
) -> NormalEquations:
    """Gauss-Newton's equations of a problem at poses (S, 4, 4), in which planes count by what they say beyond noise.

    prior_sigmas: (6,), rad and m, of the odometry from scan to scan. The first pose does not occur: its block is zero,
    but for the odometry.
    """
    planes = plane_factor.linearize(problem.features, world_from_scan, problem.sigma, fits, exact=False)
    noise = linearize(problem.features, fits, world_from_scan, problem.sigma, STEP_POINTS)
    scale = np.broadcast_to(np.diag(prior_sigmas), (len(world_from_scan), 6, 6))
    planes, noise = planes.projected(scale), noise.projected(scale)
    information, pull = weighed(planes.dense()[6:, 6:], planes.gradient[1:].ravel(), noise.dense()[6:, 6:])
    hessian, gradient = np.zeros((planes.gradient.size,) * 2), np.zeros(planes.gradient.shape)
    hessian[6:, 6:], gradient[1:] = information, pull.reshape(-1, 6)
    equations = normal_equations.from_dense(hessian, gradient, planes.cost)
    equations = equations.projected(
        np.broadcast_to(np.diag(1.0 / prior_sigmas), (len(world_from_scan), 6, 6))
    )
    others = problem.linearize_others(world_from_scan)
    return equations if others is None else equations + others


def solve(problem: Problem, world_from_scan: Poses, prior_sigmas: StepSigmas) -> LidarSolution:
    """One Gauss-Newton step of a problem with a prior, in which planes count by what they say beyond noise.

    prior_sigmas: (6,), rad and m, of the odometry from scan to scan. The first pose stays. The cost of the planes may
    rise by what a motion that noise had made up had gained.
    """
    fits = fit(problem.features, world_from_scan)
    equations = linearize_weighed(problem, world_from_scan, prior_sigmas, fits)
    free = np.ones(equations.gradient.shape, bool)
    free[0] = False
    step, _ = damped_step(equations, 0.0, free, 1.0 / prior_sigmas**2)
    moved = world_from_scan if step is None else geometry.retract(world_from_scan, step.blocks)
    return LidarSolution(moved, problem.cost(world_from_scan, fits), problem.cost(moved), 1)
