"""Voxel means and neighborhood covariances of a point map: mean map entropy and plane thickness."""

import numpy as np
from numba import prange

from lvba.kernels.compiled import kernel, parallel_kernel
from lvba.kernels.hash_table import FREE, doubled, place_of

_LOG_2PIE = np.log(2.0 * np.pi * np.e)


@kernel
def _grow(table: np.ndarray, sums: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    wider, went = doubled(table)
    moved = np.zeros((len(wider), 4))
    for old in range(len(table)):
        if table[old] != FREE:
            moved[went[old]] = sums[old]
    return wider, moved


@kernel
def bounds(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least and greatest coordinates (3,) float32 of the points: (N, 3) float32, m, N > 0."""
    low, high = points[0].copy(), points[0].copy()
    for i in range(len(points)):
        for a in range(3):
            low[a], high[a] = min(low[a], points[i, a]), max(high[a], points[i, a])
    return low, high


@kernel
def voxel_sums(
    points: np.ndarray, voxel: float, first: np.ndarray, span: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Keys (V,) int64 of the voxels that hold points, in no order, and their sums of x, y, z and 1, (V, 4) float64.

    points: (N, 3) float32, m; voxel: m, edge; first: (3,) int64, the least voxel number in each direction; span: (3,)
    int64, how many there are. Key: (x span[1] + y) span[2] + z, numbers counted from `first`. Points of a voxel are
    added in their order.
    """
    table, sums = np.full(1 << 16, FREE), np.zeros((1 << 16, 4))
    used = 0
    for i in range(len(points)):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        a = np.int64(np.floor(x / voxel)) - first[0]
        b = np.int64(np.floor(y / voxel)) - first[1]
        c = np.int64(np.floor(z / voxel)) - first[2]
        key = (a * span[1] + b) * span[2] + c
        place = place_of(table, key)
        if table[place] == FREE:
            table[place] = key
            used += 1
        sums[place, 0] += x
        sums[place, 1] += y
        sums[place, 2] += z
        sums[place, 3] += 1.0
        if 2 * used > len(table):
            table, sums = _grow(table, sums)
    held = np.flatnonzero(table != FREE)
    return table[held], sums[held]


@kernel
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


# reassociation lets the compiler keep several partial sums and vectorize; the order is fixed at compile time
@kernel(fastmath={"reassoc", "contract", "nsz"})
def _add_near(points: np.ndarray, p: int, first: int, last: int, square: float, sums: np.ndarray) -> int:
    """Adds those of the points [first:last] that are near point p to its sums; returns their number.

    Without branches, and with terms that may be added in any order, the compiler takes many points at a time.
    """
    px, py, pz = points[0, p], points[1, p], points[2, p]
    xs, ys, zs = points[0, first:last], points[1, first:last], points[2, first:last]
    number = sx = sy = sz = xx = xy = xz = yy = yz = zz = 0.0
    for q in range(len(xs)):
        x, y, z = xs[q] - px, ys[q] - py, zs[q] - pz
        near = 1.0 if x * x + y * y + z * z <= square else 0.0
        x, y, z = x * near, y * near, z * near
        number += near
        sx += x
        sy += y
        sz += z
        xx += x * x
        xy += x * y
        xz += x * z
        yy += y * y
        yz += y * z
        zz += z * z
    for k, value in enumerate((sx, sy, sz, xx, xy, xz, yy, yz, zz)):
        sums[k] += value
    return int(number)


@parallel_kernel
def entropies(
    points: np.ndarray, start: np.ndarray, keys: np.ndarray, radius: float, min_neighbors: int, span: int
) -> np.ndarray:
    """Differential entropy (N,) float64, nats, of the Gaussian through the points within `radius` (m) of each.

    points: (3, N) float64, m, by axis, sorted into cubes of edge `radius`; start, keys: of the cubes, keys ascending,
    each (x * span + y) * span + z with a margin of one cube; NaN where there are fewer than `min_neighbors`, itself
    counted.
    start: (K + 1,) int64; keys: (K,) int64
    """
    out = np.full(points.shape[1], np.nan)
    square = radius * radius
    for cell in prange(len(keys)):
        first = np.empty(9, np.int64)
        last = np.empty(9, np.int64)
        for column in range(9):
            key = keys[cell] + ((column // 3 - 1) * span + (column % 3 - 1)) * span
            first[column], last[column] = _run(keys, start, key)
        for p in range(start[cell], start[cell + 1]):
            sums, count = np.zeros(9), 0
            for column in range(9):
                count += _add_near(points, p, first[column], last[column], square, sums)
            if count >= min_neighbors:
                out[p] = 0.5 * (3.0 * _LOG_2PIE + _log_determinant(sums, count))
    return out


@kernel
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


@parallel_kernel
def cell_covariances(points: np.ndarray, order: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Covariances (K, 3, 3) float64 of the points of each cell, divided by their number.

    points: (N, 3) float32, m; order, start: points sorted into cells, as from a stable sort by key
    order: (N,) int64; start: (K + 1,) int64
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
