"""Log ratios of brightness, linear in the numbers of a radiometry: one pass over them where numpy takes fifty."""

from typing import NamedTuple

import numpy as np
from numba import prange

from lvba.kernels.compiled import kernel, parallel_kernel
from lvba.kernels.edge_sums import add_hats


class LightRatios(NamedTuple):
    """Log ratios of grey values of patches in pairs of images, all (N,) float64 but places.

    value: of the target over the reference; level: mean of both log grey values
    sign: 1 or -1, of the ratio in its pair; nearer: log of how many times nearer the patch is in the target
    reference, target: (N, 2) float64, where it is in either image, in half diagonals from the principal point
    """

    value: np.ndarray
    level: np.ndarray
    sign: np.ndarray
    nearer: np.ndarray
    reference: np.ndarray
    target: np.ndarray


@kernel
def falloff_at(place: np.ndarray, falloff: np.ndarray, sign: float, row: np.ndarray) -> float:
    """Log of the light at a place; adds its derivatives by the numbers, times `sign`, to `row`.

    place: (2,) float64; falloff: (5,) float64, coefficients of even powers and the center; row: (5,) float64, out
    """
    right, down = place[0] - falloff[3], place[1] - falloff[4]
    square = min(right * right + down * down, 1.0)
    row[0] += sign * square
    row[1] += sign * square * square
    row[2] += sign * square * square * square
    if square < 1.0:
        slope = falloff[0] + square * (2.0 * falloff[1] + square * 3.0 * falloff[2])
        row[3] -= sign * 2.0 * slope * right
        row[4] -= sign * 2.0 * slope * down
    return square * (falloff[0] + square * (falloff[1] + square * falloff[2]))


@kernel
def slope_at(log_grey: float, at_knots: np.ndarray, knots: np.ndarray) -> float:
    """Slope of log light over log grey value, linear in between knots.

    at_knots: (K,) float64, slopes less 1; knots: (K,) float64, ascending
    """
    last = len(knots) - 1
    if log_grey <= knots[0]:
        return 1.0 + at_knots[0]
    for knot in range(last):
        if log_grey < knots[knot + 1]:
            part = (log_grey - knots[knot]) / (knots[knot + 1] - knots[knot])
            return 1.0 + at_knots[knot] + part * (at_knots[knot + 1] - at_knots[knot])
    return 1.0 + at_knots[last]


@parallel_kernel
def linearize(
    ratios: LightRatios, common: np.ndarray, numbers: np.ndarray, knots: np.ndarray, steepest: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Derivatives (N, 6 + K) of the ratios by the numbers; values (N,) that the product of both explains, beside what is
    common to a pair; and what is left of these.

    common: (N,) float64, of each ratio's pair; numbers: (6 + K,) float64: those of the vignetting, what nearer views
    seem brighter by, slopes of the response less 1 at knots (K,)
    knots: (K,) float64, log grey values; steepest: most and one over least slope
    """
    count, at_knots, falloff = len(ratios.value), numbers[6:], numbers[:5]
    by_numbers = np.zeros((count, 6 + len(knots)))
    values, rest = np.empty(count), np.empty(count)
    for n in prange(count):
        row, sign = by_numbers[n], ratios.sign[n]
        fallen = falloff_at(ratios.target[n], falloff, sign, row) - falloff_at(
            ratios.reference[n], falloff, -sign, row
        )
        row[5] = sign * ratios.nearer[n]
        light = fallen + numbers[5] * ratios.nearer[n] + sign * common[n]
        level = ratios.level[n]
        half = 0.5 * light / min(max(slope_at(level, at_knots, knots), 1.0 / steepest), steepest)
        add_hats(level - half, knots, sign, row[6:])
        add_hats(level + half, knots, -sign, row[6:])
        # linear about the present center; in the other numbers it is linear anyway
        value, explained = sign * (ratios.value[n] - fallen), 0.0
        for k in range(5):
            value += row[k] * numbers[k]
        for k in range(len(numbers)):
            explained += row[k] * numbers[k]
        values[n], rest[n] = value, value - explained
    return by_numbers, values, rest
