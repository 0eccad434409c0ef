"""How far each observation of a plane is trusted."""

from dataclasses import dataclass

import numpy as np

from lvba.arrays import Poses
from lvba.kernels import lidar as kernel
from lvba.lidar.plane_feature import PlaneFeatures, PlaneFits, fit

WEIGHT_CUTOFF = 4.0
"""Distance to the plane, in expected standard deviations, at which an observation's weight falls to a quarter: noise
alone hardly gets there, a second surface does."""
WEIGHT_PASSES = 2
"""How often planes and weights are found in turn; a third pass changes neither."""


@dataclass(frozen=True)
class Weights:
    """Weights of O observations and what they were made from.

    weight: (O,) float64, 1 for a typical point that fits, more where surfaces are measured better
    sigma: m, standard deviation of a point's distance to its plane, within one scan
    offset_sigma: (O,) float64, m, standard deviation of an observation's distance to its plane, beyond that of its points
    """

    weight: np.ndarray
    sigma: float
    offset_sigma: np.ndarray


def observation_weights(
    features: PlaneFeatures, world_from_scan: Poses, passes: int = WEIGHT_PASSES
) -> Weights:
    """Weights from the distances of observations to the planes at poses (S, 4, 4).

    An observation of n points with variance v about its plane is expected to be off by v / n + c v: errors that its
    points have in common do not become less with their number. One c for all, since such errors grow as the noise does:
    with the square of the distance in a depth camera, and both along the beam. All are estimated from the data,
    robustly, so that one cutoff serves rough and refined poses. Geman-McClure weights, times the information that such
    an observation has.
    passes: how often planes and weights are found in turn; 0: all points weigh the same, as in BALM2
    """
    weight = np.ones(len(features.scan))
    count = features.clusters.count
    for turn in range(max(passes, 1)):
        fits = fit(features.with_weight(weight), world_from_scan)
        distance, within = _distances(features, fits, world_from_scan)
        if turn == 0:
            sigma = _within_scan_sigma(within, count)
        own = _own_variance(features, within, sigma)
        common = _common_fraction(distance, count, own)
        if passes == 0:
            break
        variance = own * (1.0 / count + common)
        robust = 1.0 / (1.0 + distance**2 / (variance * WEIGHT_CUTOFF**2)) ** 2
        weight = robust * sigma**2 / (count * variance)
    return Weights(weight, sigma, np.sqrt(common * own))


_SHRINK = 10.0
"""Points that the noise of a plane, and of one scan on it, is drawn to the common one by."""
_FLOOR = 0.1
"""No noise is taken for less than this part of the typical one."""


def _own_variance(features: PlaneFeatures, within: np.ndarray, sigma: float) -> np.ndarray:
    """Variance of a point's distance to its plane, for each observation (O,), m^2.

    Its own scatter, the less trusted the fewer its points, drawn to that of its plane, and that to all planes'.
    """
    feature, count = features.feature, features.clusters.count
    squares = np.bincount(feature, within, len(features)) + _SHRINK * sigma**2
    freedom = np.bincount(feature, count - 1, len(features)) + _SHRINK
    plane = (squares / freedom)[feature]
    own = (within + _SHRINK * plane) / (count - 1 + _SHRINK)
    return np.asarray(np.maximum(own, (_FLOOR * sigma) ** 2))


def _distances(
    features: PlaneFeatures, fits: PlaneFits, world_from_scan: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Each observation's distance to its plane (O,), m, and its points' sum of squares along the normal (O,), m^2."""
    return kernel.distances(
        np.ascontiguousarray(world_from_scan),
        features.offsets,
        features.scan,
        features.clusters.arrays,
        fits.center,
        np.ascontiguousarray(fits.normal),
    )


def _within_scan_sigma(within: np.ndarray, count: np.ndarray) -> float:
    """Standard deviation of points about their own scan's mean, m: the weighted median over observations."""
    many = count >= 5
    if not many.any():
        many = count >= 2
    if not many.any():
        return 0.02
    variance = np.maximum(within[many], 0.0) / (count[many] - 1)
    return float(max(np.sqrt(weighted_quantile(variance, count[many], 0.5)), 1e-4))


def weighted_quantile(values: np.ndarray, weight: np.ndarray, part: float) -> float:
    """The value up to which a part of the weight lies.

    values, weight: (N,) float64, at least one; part: 0 to 1
    """
    order = np.argsort(values)
    mass = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(mass, part * mass[-1])])


_MEDIAN = 0.4549
"""Median of a chi-square of one degree of freedom."""


def _common_fraction(distance: np.ndarray, count: np.ndarray, own: np.ndarray) -> float:
    """The fraction of the variance of points that all of an observation share, by median of squares.

    Of squared distances over `_MEDIAN` own, half are below 1 / count + fraction, whatever their counts.
    """
    return float(max(np.median(distance**2 / (_MEDIAN * own) - 1.0 / count), 0.0))
