"""What an image sees first in each of its cells, and whether that hides a point of the map.

Depths alone do not tell: the near part of a floor is far nearer than what its far part is. A surface hides a point if
the point is behind the surface and the surface in front of the point's own, both by more than they scatter.
"""

import numpy as np
from numba import njit, prange

from lvba.kernels.zbuffer import EMPTY, STEPS, nearest_entries

_DEPTH = 7


@njit(cache=True, nogil=True)
def _least(entries: np.ndarray, top: int, bottom: int, left: int, right: int) -> tuple[int, bool]:
    """The number of the cell of least entry from (top, left) to (bottom, right), and whether one there is empty."""
    rows, columns = entries.shape
    least, at, empty = EMPTY, 0, False
    for r in range(max(top, 0), min(bottom + 1, rows)):
        for c in range(max(left, 0), min(right + 1, columns)):
            empty |= entries[r, c] == EMPTY
            if entries[r, c] < least:
                least, at = entries[r, c], r * columns + c
    return at, empty


@njit(cache=True, nogil=True)
def _in_front(entries: np.ndarray, row: int, column: int, out: np.ndarray) -> None:
    """Writes the number of the cell that has the nearest point for each quarter of a cell, (2, 2), see `first_points`."""
    for a in range(2):
        for b in range(2):
            out[a, b], empty = _least(entries, row - 1 + a, row + a, column - 1 + b, column + b)
            if empty:
                out[a, b], _ = _least(entries, row - 1, row + 1, column - 1, column + 1)


@njit(cache=True, nogil=True, inline="always")
def tolerance_of(surface: np.ndarray, tolerance: np.ndarray) -> np.float32:
    """How far, m, points may be apart across a surface (8,) that are on it. tolerance: (2,) float32, in standard
    deviations, where the surface is known and where it is not."""
    known = surface[0] != 0 or surface[1] != 0 or surface[2] != 0
    return surface[6] * (tolerance[0] if known else tolerance[1])


@njit(cache=True, nogil=True)
def _describe(
    entry: np.int64,
    points: np.ndarray,
    surface: np.ndarray,
    tolerance: np.ndarray,
    pose: np.ndarray,
    out: np.ndarray,
) -> None:
    """Writes the point of an entry as `hides` wants it, (8,): position, normal towards the camera, tolerance, depth."""
    out[:] = 0.0
    out[_DEPTH] = np.inf
    if entry == EMPTY:
        return
    i = np.int32(entry & 0xFFFFFFFF)
    toward = np.float32(0.0)
    for a in range(3):
        out[a] = points[a, i]
        toward += surface[i, a] * (pose[a, 3] - points[a, i])
    for a in range(3):
        out[3 + a] = surface[i, a] if toward > 0 else -surface[i, a]
    out[6] = tolerance_of(surface[i], tolerance)
    out[_DEPTH] = np.float32(entry >> 32) / STEPS


@njit(cache=True, nogil=True, parallel=True, error_model="numpy")
def first_points(
    points: np.ndarray,
    surface: np.ndarray,
    tolerance: np.ndarray,
    start: np.ndarray,
    spheres: np.ndarray,
    poses: np.ndarray,
    intrinsics: np.ndarray,
    cell: int,
    height: int,
    width: int,
) -> tuple[np.ndarray, np.ndarray]:
    """The nearest point in each cell of `cell` pixels, (B, h, w, 8) float32, and whose counts for each quarter of a cell,
    (B, h, w, 2, 2) int32: row * w + column of the cell; upper before lower, left before right.

    A point is position (3,), m, world; unit normal (3,), towards the camera, zero where unknown; tolerance, m; and depth,
    m, inf where there is none. For a quarter the nearest of the four cells at its corner counts, so that edges are kept
    clear of by as much on all sides; of all nine about the cell where one of the four is empty: such a map is sparser
    than cells, and what is nearer shows in some of them only.
    points: (3, M) float32, in blocks; surface: (M, 8) float32, see `facing.surfaces`;
    tolerance: (2,), see `tolerance_of`; poses: (B, 3, 4) float32. Of points in the same step of depth the one with the
    lower index counts.
    """
    rows, columns = (height + cell - 1) // cell, (width + cell - 1) // cell
    out = np.empty((poses.shape[0], rows, columns, 8), np.float32)
    front = np.empty((poses.shape[0], rows, columns, 2, 2), np.int32)
    for image in prange(poses.shape[0]):
        nearest = nearest_entries(points, start, spheres, poses[image], intrinsics, cell, height, width)
        for row in range(rows):
            for column in range(columns):
                entry, description = nearest[row, column], out[image, row, column]
                _describe(entry, points, surface, tolerance, poses[image], description)
                _in_front(nearest, row, column, front[image, row, column])
    return out, front


@njit(cache=True, nogil=True, inline="always")
def hides(
    front: np.ndarray,
    x: np.floating,
    y: np.floating,
    z: np.floating,
    depth: np.floating,
    normal_x: np.floating,
    normal_y: np.floating,
    normal_z: np.floating,
    tolerance: np.floating,
    slack: np.floating,
) -> bool:
    """Whether a point of `first_points` (8,) hides the point (x, y, z), m, at a depth (m) in the same image.

    normal: unit, towards the camera, zero where unknown; tolerance: m; slack: m, how much nearer another point of
    the same surface may be, where one of the two surfaces is unknown
    """
    behind = depth - front[7]
    if not behind > 0:
        return False
    dx, dy, dz = x - front[0], y - front[1], z - front[2]
    known = front[3] != 0 or front[4] != 0 or front[5] != 0
    below = -(front[3] * dx + front[4] * dy + front[5] * dz) if known else behind - slack
    if not below > front[6]:
        return False
    known = normal_x != 0 or normal_y != 0 or normal_z != 0
    above = -(normal_x * dx + normal_y * dy + normal_z * dz) if known else behind - slack
    return above > tolerance
