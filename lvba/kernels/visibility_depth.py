"""What the LiDAR saw nearest in every part of an image, and whether it hides a patch."""

import math

import numpy as np
from numba import prange

from lvba.kernels.compiled import kernel, parallel_kernel
from lvba.kernels.depth_cells import is_alone, keep_two
from lvba.kernels.scene import Intrinsics, NearestPoints

HIDING_PART = 0.02
"""Part of the depth that is added to the tolerance of hiding: what slant and noise of far points come to."""


@parallel_kernel
def nearest_points(
    points: np.ndarray,
    ranges: np.ndarray,
    poses: np.ndarray,
    intrinsics: Intrinsics,
    width: int,
    height: int,
    cell: float,
    nearest: float,
) -> np.ndarray:
    """The nearest point of every cell of every image, (I, rows, columns) int32, -1 where none; of equals the first.

    In place of a point that is alone (`depth_cells`), the next one of its cell.
    points: (M, 3) float32, m, world; ranges: (I, 3) int64: first point, end and step of each image
    poses: (I, 4, 4) float64, world_from_camera
    cell: edge of a square cell, px; nearest: smallest depth, m
    """
    rows, columns = math.ceil(height / cell), math.ceil(width / cell)
    closest = np.full((len(ranges), rows, columns), -1, np.int32)
    fx, fy, cx, cy = intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy
    for i in prange(len(ranges)):
        r = poses[i]
        depth = np.full((rows, columns, 2), np.inf)
        index = np.full((rows, columns, 2), -1, np.int32)
        for m in range(ranges[i, 0], ranges[i, 1], ranges[i, 2]):
            dx, dy, dz = points[m, 0] - r[0, 3], points[m, 1] - r[1, 3], points[m, 2] - r[2, 3]
            z = r[0, 2] * dx + r[1, 2] * dy + r[2, 2] * dz
            if not z > nearest:
                continue
            u = fx * (r[0, 0] * dx + r[1, 0] * dy + r[2, 0] * dz) / z + cx + 0.5
            v = fy * (r[0, 1] * dx + r[1, 1] * dy + r[2, 1] * dz) / z + cy + 0.5
            if u < 0 or v < 0 or u >= width or v >= height:
                continue
            row, column = int(v / cell), int(u / cell)
            keep_two(depth[row, column], index[row, column], z, m)
        for row in range(rows):
            for column in range(columns):
                if index[row, column, 0] >= 0:
                    closest[i, row, column] = index[row, column, 1 if is_alone(depth, row, column) else 0]
    return closest


@kernel
def hiding_depth(z: float, tolerance: float) -> float:
    """What lies nearer than this, m, may hide a point at depth z. tolerance: m, beside HIDING_PART of the depth"""
    return z - tolerance - HIDING_PART * z


@kernel
def is_hidden(
    nearest: NearestPoints,
    image: int,
    pose: np.ndarray,
    x: float,
    y: float,
    z: float,
    position: np.ndarray,
    normal: np.ndarray,
    tolerance: float,
) -> bool:
    """Whether the LiDAR saw something in front of a point of a plane: nearer, and not on the plane itself.

    pose: (4, 4) float64, world_from_camera of the image; x, y, z: the point's pixel and depth, m; position: (3,)
    float64, m, and normal: (3,) float64, world, of the plane; tolerance: m, of `hiding_depth`
    """
    row, column = int((y + 0.5) / nearest.cell), int((x + 0.5) / nearest.cell)
    if row < 0 or column < 0 or row >= nearest.nearest.shape[1] or column >= nearest.nearest.shape[2]:
        return False
    m = nearest.nearest[image, row, column]
    if m < 0:
        return False
    depth, off = 0.0, 0.0
    for a in range(3):
        depth += pose[a, 2] * (nearest.points[m, a] - pose[a, 3])
        off += normal[a] * (nearest.points[m, a] - position[a])
    return depth < hiding_depth(z, tolerance) and abs(off) > 0.5 * tolerance + 0.004 * z


@kernel
def patch_hidden(
    nearest: NearestPoints,
    image: int,
    pose: np.ndarray,
    h: np.ndarray,
    u: int,
    v: int,
    half: int,
    depth: float,
    position: np.ndarray,
    normal: np.ndarray,
    tolerance: float,
) -> bool:
    """Whether the centre of a warped patch or one of its corners is hidden.

    h: (3, 3) of `homography.plane_homography`; depth: m, of the plane at (u, v) in the reference's image (its change over
    the patch is neglected); half: px, of the patch; the others as of `is_hidden`
    pose, position, normal, tolerance: as in `is_hidden`
    """
    for k in range(5):
        j = 0 if k == 4 else (2 * (k % 2) - 1) * half
        i = 0 if k == 4 else (2 * (k // 2) - 1) * half
        w = h[2, 0] * (u + j) + h[2, 1] * (v + i) + h[2, 2]
        x = (h[0, 0] * (u + j) + h[0, 1] * (v + i) + h[0, 2]) / w
        y = (h[1, 0] * (u + j) + h[1, 1] * (v + i) + h[1, 2]) / w
        if is_hidden(nearest, image, pose, x, y, w * depth, position, normal, tolerance):
            return True
    return False
