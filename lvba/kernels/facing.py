"""Which way the surface at each point of a map faces: normals of small neighborhoods, towards the LiDAR."""

import numpy as np
from numba import njit, prange

from lvba.kernels.parallel import parallel
from lvba.kernels.point_cluster import add_point, cluster_of_sums, eigen3

_OCTANTS = 8
_COARSE = 8 * _OCTANTS
"""Neighborhoods of a block: its eight eighths, and after them the whole of it, each apart by octant."""
_FEWEST = 5
_FLAT = 0.1
"""Most variance across a surface, as part of that along it where it is narrower ..."""
_WIDE = 0.15
"""... and least variance there, as part of that where it is wider: a line of points has no normal."""


@njit(cache=True, nogil=True)
def _normal(
    sums: np.ndarray,
    mean: np.ndarray,
    scatter: np.ndarray,
    values: np.ndarray,
    rows: np.ndarray,
    normal: np.ndarray,
) -> None:
    """Writes the normal (3,) of the points of the sums (10,); zero where they are too few or no surface."""
    normal[:] = 0.0
    if sums[0] < _FEWEST:
        return
    cluster_of_sums(sums, mean, scatter)
    eigen3(scatter, values, rows)
    if values[0] <= _FLAT * values[1] and values[1] >= _WIDE * values[2]:
        normal[:] = rows[0]


@parallel
def facing_normals(
    points: np.ndarray, start: np.ndarray, scan: np.ndarray, sensor_world: np.ndarray
) -> np.ndarray:
    """Normals (3, M) float32, unit, towards the LiDAR; zero where the neighborhood is not flat.

    points: (3, M) float32, m, world, in blocks that begin at start (B + 1,); scan: (M,) int32, who measured each;
    sensor_world: (S, 3) float32, where from. A neighborhood is an eighth of the block's box, or the whole where that is
    not flat, and holds only points seen from the same octant of directions: so both sides of a thin wall are apart.
    """
    normals = np.zeros_like(points)
    for b in prange(start.shape[0] - 1):
        total, normal = np.zeros((_COARSE + _OCTANTS, 10)), np.zeros((_COARSE + _OCTANTS, 3))
        mean, scatter, values, rows = np.empty(3), np.empty(6), np.empty(3), np.empty((3, 3))
        low, high = np.full(3, np.inf, np.float32), np.full(3, -np.inf, np.float32)
        for i in range(start[b], start[b + 1]):
            for a in range(3):
                low[a], high[a] = min(low[a], points[a, i]), max(high[a], points[a, i])
        own = np.empty(start[b + 1] - start[b], np.int32)
        for i in range(start[b], start[b + 1]):
            eighth, octant = 0, 0
            for a in range(3):
                eighth = 2 * eighth + (2 * (points[a, i] - low[a]) > high[a] - low[a])
                octant = 2 * octant + (sensor_world[scan[i], a] > points[a, i])
            own[i - start[b]] = eighth * _OCTANTS + octant
            x, y, z = points[0, i] - low[0], points[1, i] - low[1], points[2, i] - low[2]
            add_point(total[eighth * _OCTANTS + octant], x, y, z)
        for n in range(_COARSE):
            total[_COARSE + n % _OCTANTS] += total[n]
        for n in range(_COARSE + _OCTANTS):
            _normal(total[n], mean, scatter, values, rows, normal[n])
        for i in range(start[b], start[b + 1]):
            chosen = normal[own[i - start[b]]]
            if chosen[0] == 0.0 and chosen[1] == 0.0 and chosen[2] == 0.0:
                chosen = normal[_COARSE + own[i - start[b]] % _OCTANTS]
            along = 0.0
            for a in range(3):
                along += chosen[a] * (sensor_world[scan[i], a] - points[a, i])
            for a in range(3):
                normals[a, i] = chosen[a] if along > 0 else -chosen[a]
    return normals
