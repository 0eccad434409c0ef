"""How far points lie from the plane through their neighbors, and which way such planes face."""

import numpy as np
from numba import prange

from lvba.kernels.compiled import parallel_kernel
from lvba.kernels.point_cluster import add_squares, eigen3

FEWEST = 12
"""Points that a plane is read off."""
FLAT = 0.15
"""Largest ratio of the least to the middle eigenvalue of a plane."""
WIDE = 0.02
"""Least ratio of the middle to the greatest: points along a line have no plane."""

_LEAST_SPREAD, _LEAST_COSINE = 1e-12, 1e-6
"""m^2, and a squared cosine: nothing is divided by less."""


@parallel_kernel
def plane_error(position: np.ndarray, starts: np.ndarray, scale: float) -> np.ndarray:
    """Signed distance (N,) float32, m, of each point from the plane that fits its cell; NaN where that is no plane.

    position: (N, 3) int32, steps of `scale` m, cell c owns position[starts[c]:starts[c + 1]]; starts: (C + 1,) int64.
    The normal points along its largest component.
    """
    out = np.full(len(position), np.nan, np.float32)
    for c in prange(len(starts) - 1):
        first, end = starts[c], starts[c + 1]
        if end - first < FEWEST:
            continue
        mean, sums, values, vectors = np.zeros(3), np.zeros(6), np.empty(3), np.empty((3, 3))
        for i in range(first, end):
            for a in range(3):
                mean[a] += np.float64(position[i, a] - position[first, a])
        for a in range(3):
            mean[a] = mean[a] / (end - first) + position[first, a]
        for i in range(first, end):
            x, y, z = position[i, 0] - mean[0], position[i, 1] - mean[1], position[i, 2] - mean[2]
            add_squares(sums, x, y, z)
        eigen3(sums, values, vectors)
        if values[0] > FLAT * values[1] or values[1] < WIDE * values[2] or values[1] <= 0.0:
            continue
        n, largest = vectors[0], 0
        for a in range(1, 3):
            if abs(n[a]) > abs(n[largest]):
                largest = a
        sign = scale if n[largest] > 0.0 else -scale
        for i in range(first, end):
            away = 0.0
            for a in range(3):
                away += n[a] * (position[i, a] - mean[a])
            out[i] = sign * away
    return out


@parallel_kernel
def flattest(
    points: np.ndarray, near: np.ndarray, beam: np.ndarray, normal: np.ndarray, flatness: np.ndarray
) -> None:
    """Replaces normals by those of other neighborhoods, in place, where these are flatter along the beam.

    points: (N, 3) float64, m; near: (M, K) int64, K > 3, the neighbors of M places; beam: (M, 3) float64, unit
    normal: (M, 3) float64; flatness: (M,) float64, 0: a plane; least variance of points along the beam, over their middle
        one across. The plane lies nearest to its own points: few of them, which three fix, seem flatter than they are
    """
    unbiased = near.shape[1] / (near.shape[1] - 3)
    for m in prange(len(near)):
        mean, sums, values, vectors = np.zeros(3), np.zeros(6), np.empty(3), np.empty((3, 3))
        for k in range(near.shape[1]):
            for a in range(3):
                mean[a] += points[near[m, k], a] / near.shape[1]
        for k in range(near.shape[1]):
            at = near[m, k]
            x, y, z = points[at, 0] - mean[0], points[at, 1] - mean[1], points[at, 2] - mean[2]
            add_squares(sums, x, y, z)
        eigen3(sums, values, vectors)
        along = vectors[0, 0] * beam[m, 0] + vectors[0, 1] * beam[m, 1] + vectors[0, 2] * beam[m, 2]
        flat = unbiased * values[0] / max(values[1], _LEAST_SPREAD) / max(along * along, _LEAST_COSINE)
        if flat < flatness[m]:
            flatness[m] = flat
            for a in range(3):
                normal[m, a] = vectors[0, a]
