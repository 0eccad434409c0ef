"""Neighborhood covariances of a point map: mean map entropy and plane thickness."""

import numpy as np
from numba import njit, prange

_LOG_2PIE = np.log(2.0 * np.pi * np.e)


@njit(cache=True, nogil=True)
def _log_determinant(s: np.ndarray, count: int) -> float:
    """Natural log of the determinant of the sample covariance; s: sums of x y z xx xy xz yy yz zz; nan if singular."""
    x, y, z = s[0] / count, s[1] / count, s[2] / count
    n = count - 1
    a, b, c = (s[3] - count * x * x) / n, (s[4] - count * x * y) / n, (s[5] - count * x * z) / n
    d, e, f = (s[6] - count * y * y) / n, (s[7] - count * y * z) / n, (s[8] - count * z * z) / n
    determinant = a * (d * f - e * e) - b * (b * f - e * c) + c * (b * e - d * c)
    if not determinant > 1e-24:
        return np.nan
    return np.log(determinant)


@njit(cache=True, nogil=True, parallel=True)
def entropies(
    points: np.ndarray,
    order: np.ndarray,
    start: np.ndarray,
    keys: np.ndarray,
    radius: float,
    min_neighbors: int,
    span: int,
) -> np.ndarray:
    """Differential entropy (N,) float64, nats, of the Gaussian through the points within `radius` of each point.

    points: (N, 3) float64; order, start, keys: points sorted into cubes of edge `radius`, keys ascending, each
    (x * span + y) * span + z with a margin of one cube; NaN where there are fewer than `min_neighbors`, itself counted.
    """
    out = np.full(points.shape[0], np.nan)
    square = radius * radius
    for cell in prange(len(keys)):
        first = np.empty(9, np.int64)
        last = np.empty(9, np.int64)
        for column in range(9):
            key = keys[cell] + ((column // 3 - 1) * span + (column % 3 - 1)) * span
            first[column], last[column] = _run(keys, start, key)
        sums = np.empty(9)
        for k in range(start[cell], start[cell + 1]):
            p = order[k]
            sums[:] = 0.0
            count = 0
            for column in range(9):
                for j in range(first[column], last[column]):
                    q = order[j]
                    x, y, z = (
                        points[q, 0] - points[p, 0],
                        points[q, 1] - points[p, 1],
                        points[q, 2] - points[p, 2],
                    )
                    if x * x + y * y + z * z <= square:
                        count += 1
                        sums[0] += x
                        sums[1] += y
                        sums[2] += z
                        sums[3] += x * x
                        sums[4] += x * y
                        sums[5] += x * z
                        sums[6] += y * y
                        sums[7] += y * z
                        sums[8] += z * z
            if count >= min_neighbors:
                out[p] = 0.5 * (3.0 * _LOG_2PIE + _log_determinant(sums, count))
    return out


@njit(cache=True, nogil=True)
def _run(keys: np.ndarray, start: np.ndarray, key: int) -> tuple[int, int]:
    """The slice of sorted points in the cubes key - 1, key, key + 1, which are neighbors in memory as in z."""
    low, high = 0, len(keys)
    while low < high:
        middle = (low + high) // 2
        if keys[middle] < key - 1:
            low = middle + 1
        else:
            high = middle
    last = low
    while last < len(keys) and keys[last] <= key + 1:
        last += 1
    return start[low], start[last]


@njit(cache=True, nogil=True, parallel=True)
def cell_covariances(points: np.ndarray, order: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Covariances (K, 3, 3) float64 of the points of each cell, divided by their number.

    points: (N, 3) float32; order, start: points sorted into cells, as from a stable sort by key
    """
    out = np.empty((len(start) - 1, 3, 3))
    for cell in prange(len(start) - 1):
        first = order[start[cell]]
        mean, outer = np.zeros(3), np.zeros((3, 3))
        for k in range(start[cell], start[cell + 1]):
            for a in range(3):
                # from the first point on: far from the origin, squares would eat the digits
                x = np.float64(points[order[k], a]) - np.float64(points[first, a])
                mean[a] += x
                for b in range(a + 1):
                    outer[a, b] += x * (np.float64(points[order[k], b]) - np.float64(points[first, b]))
        count = start[cell + 1] - start[cell]
        for a in range(3):
            for b in range(a + 1):
                out[cell, a, b] = outer[a, b] / count - mean[a] * mean[b] / count / count
                out[cell, b, a] = out[cell, a, b]
    return out
