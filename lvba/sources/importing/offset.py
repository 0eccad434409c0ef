"""An offset in time that no convention explains: where scores of pairs are least, and how uncertain that is."""

from collections.abc import Callable

import numpy as np

from lvba.arrays import Indices

_STEPS = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
_ROUNDS = 4
_FEWEST = 4
_SIGMAS = 4.0
"""By how much an offset is off another that is contradicted by it."""
NEAR_SIGMAS = 2.0
"""By how much one that is not the usual answer may be off what is measured: with the usual one contradicted, what happens
to lie nearest is no convention for that."""


def away(values: dict[str, float], place: float, sigma: float, least: float) -> list[str]:
    """Names of values (s) that an offset measured at `place` (s), with its standard deviation, speaks against.

    least: s, what may be common to all pairs of a recording
    """
    far = max(_SIGMAS * sigma, least)
    return [name for name, value in values.items() if abs(value - place) > far]


def measure(
    scores_at: Callable[[float], np.ndarray], step: float, power: int, segment: Indices | None = None
) -> tuple[float, float]:
    """s: where scores are least, near zero, and the standard deviation of that, by leaving out pairs in turn.

    scores_at: scores (P,) of pairs at an offset (s); step: s, between offsets that a parabola is laid through; power: of
        scores, that it is laid through
    segment: (P,) int64, of each pair: those of one err together, so that segments are left out in turn, too, and the
        larger deviation counts; None: pairs are independent
    An infinite standard deviation: there is no such place.
    """
    center = 0.0
    for _ in range(_ROUNDS):
        offsets = center + step * _STEPS
        rows = np.array([scores_at(float(offset)) for offset in offsets])
        count = rows.shape[1]
        if count < _FEWEST:
            return 0.0, float("inf")
        place = _vertex(offsets, rows.mean(axis=1) ** power)
        if abs(place - center) <= step:
            break
        center = float(np.clip(place, offsets[0], offsets[-1]))
    else:
        return 0.0, float("inf")
    groups = [np.arange(count)] if segment is None else [np.arange(count), segment]
    return place, max(_deviation(offsets, rows, power, group) for group in groups)


def _deviation(offsets: np.ndarray, rows: np.ndarray, power: int, group: np.ndarray) -> float:
    """s: of the place where the mean of scores (K, P) at offsets (K,), s, is least, leaving out groups of pairs (P,)."""
    left_out = np.unique(group)
    if len(left_out) < 2:
        return 0.0
    each = np.array([_vertex(offsets, rows[:, group != one].mean(axis=1) ** power) for one in left_out])
    return float(np.sqrt((len(each) - 1) / len(each) * np.sum((each - each.mean()) ** 2)))


def _vertex(offsets: np.ndarray, values: np.ndarray) -> float:
    """Where the parabola through values (K,) at offsets (K,), s, is least; where it has no least place, the lower end."""
    middle = offsets[len(offsets) // 2]
    bend, slope, _ = np.polyfit(offsets - middle, values, 2)
    if bend > 0:
        return float(middle - slope / (2 * bend))
    return float(offsets[0] if values[0] < values[-1] else offsets[-1])
