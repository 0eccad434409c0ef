"""Sums and medians over the values of each edge, a pair of images: one pass each where numpy takes many."""

import numpy as np
from numba import prange

from lvba.kernels.compiled import kernel, parallel_kernel


@parallel_kernel
def medians(group: np.ndarray, value: np.ndarray, groups: int) -> np.ndarray:
    """(groups,) float64: the median of the values of every group, of two middle ones their mean; 0 without values.

    group: (N,) int64, which one a value belongs to; value: (N,) float64, all finite
    """
    start = np.zeros(groups + 1, np.int64)
    for n in range(len(group)):
        start[group[n] + 1] += 1
    for g in range(groups):
        start[g + 1] += start[g]
    place, grouped = start[:groups].copy(), np.empty(len(value))
    for n in range(len(group)):
        g = group[n]
        grouped[place[g]] = value[n]
        place[g] += 1
    middle = np.zeros(groups)
    for g in prange(groups):
        count = start[g + 1] - start[g]
        if count:
            ordered = np.sort(grouped[start[g] : start[g + 1]])
            middle[g] = (ordered[(count - 1) // 2] + ordered[count // 2]) / 2
    return middle


@kernel
def normal_sums(
    edge: np.ndarray,
    block: np.ndarray,
    value: np.ndarray,
    weight: np.ndarray,
    by_numbers: np.ndarray,
    edges: int,
    blocks: int,
) -> np.ndarray:
    """Normal equations of K numbers by block, (blocks, K, K + 1) float64: information, and the gradient as last column.

    Of values and derivatives less their weighted means over an edge: what all values of it have in common is left open.
    edge, block: (N,) int64, of each value; value, weight: (N,) float64; by_numbers: (N, K) float64, derivatives of the
    values by the numbers
    """
    count = by_numbers.shape[1]
    mean, total = np.zeros((edges, count + 1)), np.zeros(edges)
    for n in range(len(edge)):
        e = edge[n]
        total[e] += weight[n]
        for k in range(count):
            mean[e, k] += weight[n] * by_numbers[n, k]
        mean[e, count] += weight[n] * value[n]
    for e in range(edges):
        mean[e] /= max(total[e], 1e-300)
    table, inside = np.zeros((blocks, count, count + 1)), np.empty(count + 1)
    for n in range(len(edge)):
        own, sums = mean[edge[n]], table[block[n]]
        for k in range(count):
            inside[k] = by_numbers[n, k] - own[k]
        inside[count] = value[n] - own[count]
        for row in range(count):
            weighted = weight[n] * inside[row]
            for column in range(row, count + 1):
                sums[row, column] += weighted * inside[column]
    for row in range(count):
        for column in range(row):
            table[:, row, column] = table[:, column, row]
    return table


@kernel
def add_hats(log_grey: float, knots: np.ndarray, sign: float, row: np.ndarray) -> None:
    """Add `sign` times one row of `hat_integrals`. knots: (K,) float64; row: (K,) float64, out"""
    last = len(knots) - 1
    for knot in range(last):
        low, high = knots[knot], knots[knot + 1]
        inside = min(max(log_grey, low), high) - low
        rising = inside * inside / (2.0 * (high - low))
        row[knot] += sign * (inside - rising)
        row[knot + 1] += sign * rising
    row[0] += sign * min(log_grey - knots[0], 0.0)
    row[last] += sign * max(log_grey - knots[last], 0.0)


@kernel
def hat_integrals(place: np.ndarray, knots: np.ndarray) -> np.ndarray:
    """(N, K) float64: integrals from the first knot to each place of the K functions that are 1 at one knot and 0 at the
    others, linear in between and constant beyond the outermost.

    place: (N,) float64; knots: (K,) float64, ascending
    """
    table = np.zeros((len(place), len(knots)))
    for n in range(len(place)):
        add_hats(place[n], knots, 1.0, table[n])
    return table
