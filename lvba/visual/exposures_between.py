"""Exposures of images between keyframes, and how far they may be off.

Between keyframes an exposure is interpolated, and it is not known what the camera did there. How far each keyframe is
off the line through its neighbors says how much exposures change: as those of a random walk, of which an image between
two known ones is off by the variance of a Brownian bridge.

Of a keyframe that little tells of, and that would leave this walk, the line is a better guess than its own few patches:
images before which people stood were 8, 40 and 64 % off by these.
"""

import numpy as np

from lvba.arrays import Indices, Times
from lvba.trajectory import nearest_in_time

_FEWEST = 3
"""Keyframes from which on some have neighbors on both sides."""
_UNCERTAIN = 3.0
"""Times the usual standard deviation from which on little tells of a keyframe."""
_ALONE = 2
"""Most successive keyframes of these that are taken from their neighbors: more tell of each other."""
_CONTRADICTS = 3.0
"""Standard deviations from the line beyond which they are."""


def of_all(
    times: Times, keyframes: Indices, log_exposure: np.ndarray, sigma: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Log exposures (I,) float64 of all images, that of the first zero, and their standard deviations (I,) float64.

    times: (I,) s, ascending; keyframes: (K,), ascending
    log_exposure, sigma: (K,) float64, of these; inf: nothing tells, and that stays so
    """
    sampled, alone = times[keyframes], _alone(sigma)
    known = np.isfinite(sigma) & ~alone
    rate = change_rate(sampled[known], log_exposure[known])
    used = ~alone
    if alone.any():
        off = log_exposure - np.interp(sampled, sampled[~alone], log_exposure[~alone])
        expected = np.hypot(sigma, _of_walk(rate, sampled[~alone], sampled))
        used |= np.isfinite(sigma) & (np.abs(off) <= _CONTRADICTS * expected)
    everywhere = np.interp(times, sampled[used], log_exposure[used])
    nearest = sigma[used][nearest_in_time(sampled[used], times)]
    spread = np.hypot(nearest, _of_walk(rate, sampled[used], times))
    unknown = ~np.isfinite(sigma[nearest_in_time(sampled, times)])
    return everywhere - everywhere[0], np.where(unknown, np.inf, spread)


def _alone(sigma: np.ndarray) -> np.ndarray:
    """(K,) bool: keyframes that little tells of, where more tells of their neighbors."""
    if not np.isfinite(sigma).any():
        return np.zeros(len(sigma), bool)
    little = uncertain(sigma)
    label = np.cumsum(np.r_[True, np.diff(little)])
    return np.asarray(little & (np.bincount(label)[label] <= _ALONE))


def uncertain(sigma: np.ndarray, factor: float = _UNCERTAIN) -> np.ndarray:
    """(K,) bool: standard deviations that are more than a factor times the median of those known, or infinite.

    sigma: (K,) float64
    """
    known = sigma[np.isfinite(sigma)]
    return np.asarray(sigma > factor * (float(np.median(known)) if len(known) else 0.0))


def change_rate(times: Times, log_exposure: np.ndarray) -> float:
    """1/s, variance by which exposures at times (K,), s, change in a second; 0 where nothing tells.

    log_exposure: (K,) float64
    """
    if len(times) < _FEWEST:
        steps = np.maximum(np.diff(times), 1e-9)
        return float(np.mean(np.diff(log_exposure) ** 2 / steps)) if len(steps) else 0.0
    before, after = times[1:-1] - times[:-2], times[2:] - times[1:-1]
    span = np.maximum(before + after, 1e-9)
    along, bridge = before / span, before * after / span
    line = (1 - along) * log_exposure[:-2] + along * log_exposure[2:]
    return float(np.mean((log_exposure[1:-1] - line) ** 2) / max(np.mean(bridge), 1e-9))


def off_line(sampled: Times, log_exposure: np.ndarray, times: Times) -> np.ndarray:
    """(I,) float64: how far exposures at times (I,) s may be off the line through known ones at (K,) s, ascending.

    log_exposure: (K,) float64, of the known ones
    """
    return _of_walk(change_rate(sampled, log_exposure), sampled, times)


def _of_walk(rate: float, sampled: Times, times: Times) -> np.ndarray:
    """(I,) float64: standard deviation of a random walk, as of `_bridge`. rate: 1/s, as of `change_rate`"""
    return np.asarray(np.sqrt(rate * _bridge(sampled, times)))


def _bridge(sampled: Times, times: Times) -> np.ndarray:
    """(I,) s: variance of a random walk, of unit rate, at times (I,) between those it is known at (K,); outside, of one
    that begins there."""
    after = np.clip(np.searchsorted(sampled, times), 1, max(len(sampled) - 1, 1))
    first, last = sampled[after - 1], sampled[np.minimum(after, len(sampled) - 1)]
    inside = (times - first) * (last - times) / np.maximum(last - first, 1e-9)
    outside = np.maximum(sampled[0] - times, times - sampled[-1])
    return np.asarray(np.where(outside > 0, outside, np.maximum(inside, 0.0)))
