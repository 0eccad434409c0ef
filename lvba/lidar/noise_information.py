"""What planes seem to say about all scans together although noise may have made it up.

A group of scans may hold fast to each other and hang on the others by little: those that see the floor of one room,
and of all other rooms only walls, can go up and down together. Each of them is well held, so `degeneracy` does not see
it. What little the planes say about such a motion is no more than what noise of their normals feigns: it is not promised,
and it is weighed against the odometry by what it is worth.
"""

from dataclasses import replace

import numpy as np
import scipy.linalg

from lvba.lidar.damped_newton import Solution
from lvba.lidar.degeneracy import normal_variance
from lvba.lidar.normal_equations import NormalEquations, Problem, add_prior, linearize_planes, retract
from lvba.lidar.plane_feature import PlaneFeatures, PlaneFits, fit

MOST_SCANS = 250
"""More together are not weighed: each round takes an eigenproblem of all, 0.4 s for 100 scans, cubic."""
PROMISED = 16.0
"""Multiple of what noise feigns that is not promised: four times that which is not followed of a single scan
(`degeneracy.SIGNAL_TO_NOISE`). Normals are off by twice what `degeneracy.TRUSTED_POINTS` have it, in simulated rooms of
known walls: cells hold bits of other surfaces, and their faces cut the noise off at a slant. 32 is too modest in the
open."""
FOLLOWED = 16.0
"""Multiple of what noise feigns at which the planes' word counts half. Of 1, 4, 16 and 64 in six simulated rooms, 16
brought groups back (four: half of the way) without giving up what planes do know (64)."""
_LEAST_FEIGNED = 1e-3
"""What noise feigns at least, relative to the odometry: planes say nothing a thousand times better than noise has it."""
_LEAST_VARIANCE = 1e-12
"""rad^2, of a normal: planes of no thickness keep a weight, which the elimination of their parameters divides by."""


def feigned_information(
    features: PlaneFeatures, fits: PlaneFits, world_from_scan: np.ndarray, sigma: float
) -> np.ndarray:
    """What noise of the planes' normals says about the poses (S, 4, 4): (6 S, 6 S), world axes about each sensor.

    A normal that is off by e towards a tangent takes a motion along that tangent for one of e times its size along the
    normal. So this is the planes' Gauss-Newton Hessian with the tangents for normals, each plane weighted by the variance
    of its normal towards it. The planes' own parameters are eliminated: a motion common to all scans that see a plane
    counts for nothing, as in the true one.
    sigma: m, of a point.
    """
    variances = normal_variance(fits)
    found = np.zeros((6 * len(world_from_scan),) * 2)
    for tangent in (1, 2):
        variance = np.maximum(variances[:, tangent - 1], _LEAST_VARIANCE)
        weighed = replace(features, weight=features.weight * variance[features.feature])
        axes = fits.eigenvectors.copy()
        axes[:, 0] = fits.eigenvectors[:, tangent]
        turned = replace(fits, total=fits.total * variance, eigenvectors=axes)
        found += linearize_planes(weighed, world_from_scan, sigma, turned, exact=False).hessian
    return found


def certain(told: np.ndarray, feigned: np.ndarray, odometry: np.ndarray) -> np.ndarray:
    """What is left of the planes' information (N, N) without what noise feigns and the odometry knows anyway.

    feigned: (N, N), taken out PROMISED times; odometry: (N, N), positive. Motions about which the planes say less than
    these two are not determined by them at all.
    """
    noise = PROMISED * feigned + odometry
    left = told - noise
    try:
        scipy.linalg.cholesky(left, check_finite=False)
        return left
    except np.linalg.LinAlgError:
        values, vectors = scipy.linalg.eigh(told, noise, subset_by_value=(-np.inf, 1.0), check_finite=False)
    open_motions = noise @ vectors
    return np.asarray(left + (open_motions * (1.0 - values)) @ open_motions.T)


def weighed(told: NormalEquations, feigned: np.ndarray) -> NormalEquations:
    """What planes say, each motion weighed by mu / (mu + FOLLOWED), mu times as much told about it as noise feigns.

    told: of N unknowns, scaled by the odometry's deviations, as feigned (N, N) is.
    mu and the motions: the generalized eigenproblem of the two, in which both are diagonal.
    """
    floor = feigned + _LEAST_FEIGNED * np.eye(len(feigned))
    mu, motions = scipy.linalg.eigh(told.hessian, floor, check_finite=False)
    mu = np.maximum(mu, 0.0)
    weight = mu / (mu + FOLLOWED)
    back = floor @ motions
    return NormalEquations(
        (back * (mu * weight)) @ back.T, back @ (weight * (motions.T @ told.gradient)), told.cost
    )


def solve(problem: Problem, world_from_scan: np.ndarray, prior_sigmas: np.ndarray) -> Solution:
    """One Gauss-Newton step of a problem with a prior, in which planes count by what they say beyond noise.

    prior_sigmas: (6,), rad and m, of the odometry from scan to scan. The first pose stays. The cost of the planes may
    rise by what a motion that noise had made up had gained.
    """
    fits = fit(problem.features, world_from_scan)
    planes = linearize_planes(problem.features, world_from_scan, problem.sigma, fits, exact=False)
    feigned = feigned_information(problem.features, fits, world_from_scan, problem.sigma)
    scale = np.tile(prior_sigmas, len(world_from_scan))
    both = np.outer(scale, scale)
    scaled = NormalEquations((planes.hessian * both)[6:, 6:], (planes.gradient * scale)[6:], planes.cost)
    equations = weighed(scaled, (feigned * both)[6:, 6:])
    size = len(scale)
    odometry = NormalEquations(np.zeros((size, size)), np.zeros(size), 0.0)
    if problem.prior is not None:
        odometry = add_prior(odometry, problem.prior, world_from_scan)
    hessian = equations.hessian + (odometry.hessian * both)[6:, 6:]
    gradient = equations.gradient + (odometry.gradient * scale)[6:]
    step = -scipy.linalg.solve(hessian, gradient, assume_a="pos", check_finite=False) * scale[6:]
    moved = retract(world_from_scan, np.concatenate([np.zeros(6), step]).reshape(-1, 6))
    return Solution(moved, problem.cost(world_from_scan, fits), problem.cost(moved), 1)
