"""What planes seem to say about all scans together although noise may have made it up.

A group of scans may hold fast to each other and hang on the others by little: those that see the floor of one room,
and of all other rooms only walls, can go up and down together. Each of them is well held, so `weak` does not see it.
What little the planes say about such a motion is no more than what noise of their normals feigns, so it is not
promised.
"""

from dataclasses import replace

import numpy as np
import scipy.linalg

from lvba.lidar.normal_equations import linearize_planes
from lvba.lidar.plane_feature import PlaneFeatures, PlaneFits
from lvba.lidar.weak import normal_variance

PROMISED = 8.0
"""Multiple of what noise feigns that is not promised: twice that which is not followed (`weak.SIGNAL_TO_NOISE`)."""
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
    return 0.5 * found


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
