"""What the LiDAR saw nearest in every part of an image, and whether it hides a patch."""

import math

import numba
import numpy as np

_jit = numba.njit(cache=True, nogil=True)


@numba.njit(parallel=True, cache=True, nogil=True)
def nearest_points(
    points: np.ndarray,
    ranges: np.ndarray,
    poses: np.ndarray,
    intrinsics: np.ndarray,
    width: int,
    height: int,
    cell: float,
    nearest: float,
) -> np.ndarray:
    """The nearest point of every cell of every image, (I, rows, columns) int32, -1 where none; of equals the first.

    points: (M, 3) float32, world; ranges: (I, 3): first point, end and step of each image; poses: (I, 4, 4)
    intrinsics: fx, fy, cx, cy; cell: edge of a square cell, px; nearest: smallest depth, m
    """
    rows, columns = math.ceil(height / cell), math.ceil(width / cell)
    found = np.full((len(ranges), rows, columns), -1, np.int32)
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    for i in numba.prange(len(ranges)):
        r = poses[i]
        depth = np.full((rows, columns), np.inf)
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
            if z < depth[row, column]:
                depth[row, column] = z
                found[i, row, column] = m
    return found


@_jit
def is_hidden(
    nearest: np.ndarray,
    points: np.ndarray,
    pose: np.ndarray,
    cell: float,
    x: float,
    y: float,
    z: float,
    position: np.ndarray,
    normal: np.ndarray,
    tolerance: float,
) -> bool:
    """Whether the LiDAR saw something in front of a point of a plane: nearer, and not on the plane itself.

    nearest: (rows, columns) of the image; cell: px; x, y, z: the point's pixel and depth; position, normal: the plane
    tolerance: m; 2 % of the depth are added
    """
    row, column = int((y + 0.5) / cell), int((x + 0.5) / cell)
    if row < 0 or column < 0 or row >= nearest.shape[0] or column >= nearest.shape[1]:
        return False
    m = nearest[row, column]
    if m < 0:
        return False
    depth, off = 0.0, 0.0
    for a in range(3):
        depth += pose[a, 2] * (points[m, a] - pose[a, 3])
        off += normal[a] * (points[m, a] - position[a])
    return depth < z - tolerance - 0.02 * z and abs(off) > 0.5 * tolerance + 0.004 * z


@_jit
def patch_hidden(
    nearest: np.ndarray,
    points: np.ndarray,
    pose: np.ndarray,
    cell: float,
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

    h: pixels of the reference to those of the image, third component depth over depth in the reference; depth: of the
    plane at (u, v) in the reference's image (its change over the patch is neglected)
    """
    for k in range(5):
        j = 0 if k == 4 else (2 * (k % 2) - 1) * half
        i = 0 if k == 4 else (2 * (k // 2) - 1) * half
        w = h[2, 0] * (u + j) + h[2, 1] * (v + i) + h[2, 2]
        x = (h[0, 0] * (u + j) + h[0, 1] * (v + i) + h[0, 2]) / w
        y = (h[1, 0] * (u + j) + h[1, 1] * (v + i) + h[1, 2]) / w
        if is_hidden(nearest, points, pose, cell, x, y, w * depth, position, normal, tolerance):
            return True
    return False
