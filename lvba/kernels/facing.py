"""The surface round each point of a map: which way it faces, how far its points scatter, how well its normal is known."""

import numpy as np
from numba import prange

from lvba.kernels.compiled import kernel, parallel_kernel
from lvba.kernels.point_cluster import POINTS, add_point, cluster_of_sums, eigen3

NORMAL, TO_LIDAR, SCATTER, LEAST_COSINE = 0, 3, 6, 7
"""Columns of a surface, (8,) float32, of `surfaces`, of vectors the first of three; LEAST_COSINE holds its square."""
_OCTANTS = 8
_COARSE = 8 * _OCTANTS
"""Neighborhoods of a block: its eight eighths, and after them the whole of it, each apart by octant."""
_FEWEST = 5
_FLAT = 0.1
"""Most variance across a surface, as part of that along it where it is narrower ..."""
_HALVED = 2.0
"""An eighth may hold one half of a surface's noise, which scatters 1.7 times less than both. So the whole block's plane
counts where it scatters less than this many times as much."""
_WIDE = 0.03
"""... and least variance there, as part of that where it is wider: a line of points has no normal."""
_NEAR = 3.0
"""A point is on a plane that it is this many of the plane's standard deviations away from, or less."""
_TRUSTED = 50.0
"""A normal is never trusted better than one of this many independent points: surfaces have edges and bumps."""
_D, _SIGMA, _TILT = 3, 4, 5
"""Of a plane, (6,): its unit normal n (zero: no surface), offset n'x, scatter across it in m (-1: too few points), and
standard deviation of its normal in rad."""


@kernel
def _fit(
    sums: np.ndarray,
    mean: np.ndarray,
    scatter: np.ndarray,
    values: np.ndarray,
    rows: np.ndarray,
    plane: np.ndarray,
) -> bool:
    """Writes the plane (6,) of the points of the sums (10,) and says whether they are on one."""
    plane[:] = 0.0
    plane[_SIGMA] = -1.0
    if sums[POINTS] < _FEWEST:
        return False
    cluster_of_sums(sums, mean, scatter)
    eigen3(scatter, values, rows)
    across = max(values[0], 0.0)
    plane[_SIGMA] = np.sqrt(across / (sums[POINTS] - 3.0))
    if across > _FLAT * values[1] or values[1] < _WIDE * values[2]:
        return False
    plane[:3] = rows[0]
    plane[_D] = rows[0, 0] * mean[0] + rows[0, 1] * mean[1] + rows[0, 2] * mean[2]
    plane[_TILT] = np.sqrt(across / (values[1] * min(sums[POINTS], _TRUSTED)))
    return True


@kernel(inline=True)
def _off(plane: np.ndarray, x: float, y: float, z: float) -> float:
    """How far a point is from a plane, in the plane's standard deviations."""
    distance = plane[0] * x + plane[1] * y + plane[2] * z - plane[_D]
    return abs(distance) / (plane[_SIGMA] + 1e-6)


@kernel(inline=True)
def _is_flat(plane: np.ndarray) -> bool:
    return plane[0] != 0.0 or plane[1] != 0.0 or plane[2] != 0.0


@kernel
def _plane_of(
    planes: np.ndarray, flat: np.ndarray, surfaces: int, own: int, x: float, y: float, z: float
) -> int:
    """The number of the plane that a point is on: its neighborhood's, or the nearest of the block; -1: on none."""
    whole = _COARSE + own % _OCTANTS
    best, least = -1, _NEAR
    halved = planes[whole, _SIGMA] < _HALVED * planes[own, _SIGMA]
    for chosen in (whole if halved else own, own if halved else whole):
        if _is_flat(planes[chosen]) and _off(planes[chosen], x, y, z) <= _NEAR:
            return chosen
    for k in range(surfaces):
        off = _off(planes[flat[k]], x, y, z)
        if off < least:
            best, least = flat[k], off
    return best


@parallel_kernel
def surfaces(
    points: np.ndarray, start: np.ndarray, scan: np.ndarray, sensor_world: np.ndarray, max_angle: float
) -> np.ndarray:
    """The surface at each point, (M, 8) float32:

    NORMAL: unit normal towards the LiDAR, zero where the neighborhood is not flat
    TO_LIDAR: unit vector to the LiDAR over its cosine to the normal
    SCATTER: m, of points across the surface; where none is flat, the least of any direction; -1: points are too few
    LEAST_COSINE: square of the least cosine between normal and view, for views at most `max_angle` (rad) off the normal:
        two of its standard deviations are added, but nothing is seen from behind

    points: (3, M) float32, m, world, in blocks that begin at start (B + 1,); scan: (M,) int32, who measured each;
    sensor_world: (S, 3) float32, m, where from. A neighborhood is an eighth of the block's box, or the whole where that
    is not flat, and holds only points seen from the same octant of directions: so both sides of a thin wall are apart.
    Planes are fitted again without what is off them. A point in no flat neighborhood, as where two surfaces meet, is on
    the plane of another one of the block if it is near that.
    start: (B + 1,) int64
    """
    out = np.zeros((points.shape[1], 8), np.float32)
    for b in prange(start.shape[0] - 1):
        total, planes = np.zeros((_COARSE + _OCTANTS, 10)), np.zeros((_COARSE + _OCTANTS, 6))
        mean, scatter, values, rows = np.empty(3), np.empty(6), np.empty(3), np.empty((3, 3))
        low, high = np.full(3, np.inf, np.float32), np.full(3, -np.inf, np.float32)
        for i in range(start[b], start[b + 1]):
            for a in range(3):
                low[a], high[a] = min(low[a], points[a, i]), max(high[a], points[a, i])
        own = np.empty(start[b + 1] - start[b], np.int64)
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
            _fit(total[n], mean, scatter, values, rows, planes[n])
        again = np.zeros_like(total)
        for i in range(start[b], start[b + 1]):
            x, y, z = points[0, i] - low[0], points[1, i] - low[1], points[2, i] - low[2]
            for n in (own[i - start[b]], _COARSE + own[i - start[b]] % _OCTANTS):
                if _is_flat(planes[n]) and _off(planes[n], x, y, z) <= _NEAR:
                    add_point(again[n], x, y, z)
        flat, count = np.empty(len(planes), np.int64), 0
        for n in range(_COARSE + _OCTANTS):
            if _is_flat(planes[n]):
                if again[n, POINTS] < total[n, POINTS] and not _fit(
                    again[n], mean, scatter, values, rows, planes[n]
                ):
                    _fit(total[n], mean, scatter, values, rows, planes[n])
                flat[count] = n
                count += 1
        for i in range(start[b], start[b + 1]):
            x, y, z = points[0, i] - low[0], points[1, i] - low[1], points[2, i] - low[2]
            neighborhood = own[i - start[b]]
            chosen = _plane_of(planes, flat, count, neighborhood, x, y, z)
            if chosen < 0:
                whole = _COARSE + neighborhood % _OCTANTS
                few = planes[neighborhood, _SIGMA] < 0.0
                out[i, SCATTER] = planes[whole if few else neighborhood, _SIGMA]
                continue
            plane, along = planes[chosen], 0.0
            for a in range(3):
                along += plane[a] * (sensor_world[scan[i], a] - points[a, i])
            for a in range(3):
                out[i, NORMAL + a] = plane[a] if along > 0 else -plane[a]
                out[i, TO_LIDAR + a] = (sensor_world[scan[i], a] - points[a, i]) / abs(along)
            out[i, SCATTER] = plane[_SIGMA]
            out[i, LEAST_COSINE] = np.cos(min(max_angle + 2.0 * plane[_TILT], 0.5 * np.pi)) ** 2
    return out
