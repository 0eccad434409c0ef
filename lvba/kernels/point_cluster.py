"""Sums over points: clusters (count, mean, scatter about the mean) and their smallest eigenvalues.

A scatter is the sum of (p - mean)(p - mean)', kept as its 6 numbers xx xy xz yy yz zz, m^2. Centred sums keep their
digits however far the points are from the origin.
"""

from typing import NamedTuple

import numpy as np
from numba import prange

from lvba.kernels.compiled import kernel, parallel_kernel

_SWEEPS = 12
POINTS = 0
"""Where sums of points (10,) hold their number; after it their sums x y z and sums of products xx xy xz yy yz zz."""


class Clusters(NamedTuple):
    """K clusters.

    total: (K,) float64, number of points, or sum of their weights; mean: (K, 3) float64, m; scatter: (K, 6) float64, m^2
    """

    total: np.ndarray
    mean: np.ndarray
    scatter: np.ndarray


@kernel(inline=True)
def add_cluster(
    count: np.ndarray,
    mean: np.ndarray,
    scatter: np.ndarray,
    other_count: float,
    other_mean: np.ndarray,
    other_scatter: np.ndarray,
) -> None:
    """Add a cluster to (count (1,), mean (3,), scatter (6,)) in place (Chan et al. 1979, pairwise update).

    count: (1,) float64; mean, other_mean: (3,) float64, m; scatter, other_scatter: (6,) float64, m^2; in one frame
    """
    total = count[0] + other_count
    if other_count <= 0.0:
        return
    fraction = other_count / total
    lever = count[0] * fraction
    dx = other_mean[0] - mean[0]
    dy = other_mean[1] - mean[1]
    dz = other_mean[2] - mean[2]
    scatter[0] += other_scatter[0] + lever * dx * dx
    scatter[1] += other_scatter[1] + lever * dx * dy
    scatter[2] += other_scatter[2] + lever * dx * dz
    scatter[3] += other_scatter[3] + lever * dy * dy
    scatter[4] += other_scatter[4] + lever * dy * dz
    scatter[5] += other_scatter[5] + lever * dz * dz
    mean[0] += fraction * dx
    mean[1] += fraction * dy
    mean[2] += fraction * dz
    count[0] = total


@kernel(inline=True)
def add_point(sums: np.ndarray, x: float, y: float, z: float) -> None:
    """Add a point to the sums (10,) float64, see POINTS; take it from near by, to keep digits."""
    sums[POINTS] += 1.0
    sums[1] += x
    sums[2] += y
    sums[3] += z
    sums[4] += x * x
    sums[5] += x * y
    sums[6] += x * z
    sums[7] += y * y
    sums[8] += y * z
    sums[9] += z * z


@kernel(inline=True)
def add_squares(scatter: np.ndarray, x: float, y: float, z: float) -> None:
    """Adds what a point that is so far from the mean, m, adds to a scatter.

    scatter: (6,) float64, m^2, in and out
    """
    scatter[0] += x * x
    scatter[1] += x * y
    scatter[2] += x * z
    scatter[3] += y * y
    scatter[4] += y * z
    scatter[5] += z * z


@kernel(inline=True)
def cluster_of_sums(sums: np.ndarray, mean: np.ndarray, scatter: np.ndarray) -> None:
    """Write mean (3,) and scatter (6,) of the points of the sums (10,) of `add_point`, all float64."""
    inverse = 1.0 / max(sums[POINTS], 1.0)
    mean[0], mean[1], mean[2] = sums[1] * inverse, sums[2] * inverse, sums[3] * inverse
    scatter[0] = sums[4] - sums[1] * mean[0]
    scatter[1] = sums[5] - sums[1] * mean[1]
    scatter[2] = sums[6] - sums[1] * mean[2]
    scatter[3] = sums[7] - sums[2] * mean[1]
    scatter[4] = sums[8] - sums[2] * mean[2]
    scatter[5] = sums[9] - sums[3] * mean[2]


@kernel(inline=True)
def fill_cross(vector: np.ndarray, out: np.ndarray) -> None:
    """out (3, 3) becomes the matrix whose product with any b is the cross product of the vector (3,) and b; its diagonal
    stays. vector: (3,) float64; out: (3, 3) float64
    """
    out[0, 1], out[0, 2] = -vector[2], vector[1]
    out[1, 0], out[1, 2] = vector[2], -vector[0]
    out[2, 0], out[2, 1] = -vector[1], vector[0]


@kernel
def rotate_scatter(rotation: np.ndarray, scatter: np.ndarray, out: np.ndarray) -> None:
    """out (6,) = R S R' for the rotation (3, 3), or that of a pose (4, 4), and the scatter (6,), S; all float64.

    rotation: (3, 3) or (4, 4) float64; scatter: (6,) float64; out: (6,) float64
    """
    r = rotation
    a0, a1, a2, a3, a4, a5 = scatter[0], scatter[1], scatter[2], scatter[3], scatter[4], scatter[5]
    x0 = r[0, 0] * a0 + r[0, 1] * a1 + r[0, 2] * a2
    x1 = r[0, 0] * a1 + r[0, 1] * a3 + r[0, 2] * a4
    x2 = r[0, 0] * a2 + r[0, 1] * a4 + r[0, 2] * a5
    y0 = r[1, 0] * a0 + r[1, 1] * a1 + r[1, 2] * a2
    y1 = r[1, 0] * a1 + r[1, 1] * a3 + r[1, 2] * a4
    y2 = r[1, 0] * a2 + r[1, 1] * a4 + r[1, 2] * a5
    z0 = r[2, 0] * a0 + r[2, 1] * a1 + r[2, 2] * a2
    z1 = r[2, 0] * a1 + r[2, 1] * a3 + r[2, 2] * a4
    z2 = r[2, 0] * a2 + r[2, 1] * a4 + r[2, 2] * a5
    out[0] = x0 * r[0, 0] + x1 * r[0, 1] + x2 * r[0, 2]
    out[1] = x0 * r[1, 0] + x1 * r[1, 1] + x2 * r[1, 2]
    out[2] = x0 * r[2, 0] + x1 * r[2, 1] + x2 * r[2, 2]
    out[3] = y0 * r[1, 0] + y1 * r[1, 1] + y2 * r[1, 2]
    out[4] = y0 * r[2, 0] + y1 * r[2, 1] + y2 * r[2, 2]
    out[5] = z0 * r[2, 0] + z1 * r[2, 1] + z2 * r[2, 2]


@kernel
def move_cluster(
    pose: np.ndarray, mean: np.ndarray, scatter: np.ndarray, out_mean: np.ndarray, out_scatter: np.ndarray
) -> None:
    """Writes a moved cluster.

    pose: (4, 4) float64, from the cluster's frame to another; mean: (3,) float64, m; scatter: (6,) float64, m^2
    out_mean: (3,) float64, m; out_scatter: (6,) float64, m^2
    """
    r = pose
    x, y, z = mean[0], mean[1], mean[2]
    out_mean[0] = r[0, 0] * x + r[0, 1] * y + r[0, 2] * z + r[0, 3]
    out_mean[1] = r[1, 0] * x + r[1, 1] * y + r[1, 2] * z + r[1, 3]
    out_mean[2] = r[2, 0] * x + r[2, 1] * y + r[2, 2] * z + r[2, 3]
    rotate_scatter(r, scatter, out_scatter)


@kernel
def eigen3(symmetric: np.ndarray, values: np.ndarray, vectors: np.ndarray) -> None:
    """Writes eigenvalues, values (3,) ascending, and eigenvectors, vectors (3, 3) as rows; float64.

    symmetric: (6,) float64, a symmetric matrix, as scatters are kept

    Cyclic Jacobi rotations: unlike the closed form they keep the digits of a small eigenvalue beside large ones
    (Golub and Van Loan, section 8.5).
    values: (3,) float64, out; vectors: (3, 3) float64, out
    """
    a = np.empty((3, 3))
    a[0, 0], a[0, 1], a[0, 2] = symmetric[0], symmetric[1], symmetric[2]
    a[1, 0], a[1, 1], a[1, 2] = symmetric[1], symmetric[3], symmetric[4]
    a[2, 0], a[2, 1], a[2, 2] = symmetric[2], symmetric[4], symmetric[5]
    v = np.zeros((3, 3))
    v[0, 0] = v[1, 1] = v[2, 2] = 1.0
    for _ in range(_SWEEPS):
        off = abs(a[0, 1]) + abs(a[0, 2]) + abs(a[1, 2])
        if off <= 1e-18 * (abs(a[0, 0]) + abs(a[1, 1]) + abs(a[2, 2])):
            break
        for p in range(2):
            for q in range(p + 1, 3):
                if a[p, q] == 0.0:
                    continue
                theta = (a[q, q] - a[p, p]) / (2.0 * a[p, q])
                t = 1.0 / (abs(theta) + np.sqrt(theta * theta + 1.0))
                if theta < 0.0:
                    t = -t
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                apq = a[p, q]
                a[p, p] -= t * apq
                a[q, q] += t * apq
                a[p, q] = a[q, p] = 0.0
                k = 3 - p - q
                akp, akq = a[k, p], a[k, q]
                a[k, p] = a[p, k] = c * akp - s * akq
                a[k, q] = a[q, k] = s * akp + c * akq
                for i in range(3):
                    vp, vq = v[i, p], v[i, q]
                    v[i, p] = c * vp - s * vq
                    v[i, q] = s * vp + c * vq
    i0, i1, i2 = 0, 1, 2
    if a[i1, i1] < a[i0, i0]:
        i0, i1 = i1, i0
    if a[i2, i2] < a[i0, i0]:
        i0, i2 = i2, i0
    if a[i2, i2] < a[i1, i1]:
        i1, i2 = i2, i1
    values[0], values[1], values[2] = a[i0, i0], a[i1, i1], a[i2, i2]
    for i in range(3):
        vectors[0, i], vectors[1, i], vectors[2, i] = v[i, i0], v[i, i1], v[i, i2]


@parallel_kernel
def transform(poses: np.ndarray, pose: np.ndarray, clusters: Clusters) -> tuple[np.ndarray, np.ndarray]:
    """Means (K, 3) and scatters (K, 6) of clusters moved by poses; cluster k by poses[pose[k]].

    poses: (S, 4, 4) float64, from each scan's frame to another; pose: (K,) int32
    """
    out_mean = np.empty_like(clusters.mean)
    out_scatter = np.empty_like(clusters.scatter)
    for k in prange(len(pose)):
        move_cluster(poses[pose[k]], clusters.mean[k], clusters.scatter[k], out_mean[k], out_scatter[k])
    return out_mean, out_scatter
