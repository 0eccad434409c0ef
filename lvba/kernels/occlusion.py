"""What an image sees first in each of its cells, and whether that hides a point of the map.

Depths alone do not tell: the near part of a floor is far nearer than what its far part is. A surface hides a point if
the point is behind the surface and the surface in front of the point's own, both by more than they scatter.
"""

from typing import NamedTuple

import numpy as np
from numba import prange

from lvba.kernels.compiled import kernel, parallel_kernel
from lvba.kernels.facing import NORMAL, SCATTER
from lvba.kernels.scene import BlockPoints, Intrinsics
from lvba.kernels.zbuffer import EMPTY, STEPS, nearest_entries

FIRST_POSITION, FIRST_NORMAL, FIRST_TOLERANCE, FIRST_DEPTH = 0, 3, 6, 7
"""Columns of what a cell sees first, (8,) float32: m, world; unit, towards the camera, zero where unknown; m; and m, inf
where there is nothing."""


class Tolerance(NamedTuple):
    """How far apart points of one surface may be across it, in its standard deviations: where known, where not."""

    known: np.float32
    unknown: np.float32


class FirstPoints(NamedTuple):
    """What B images see first in their cells, of `cell` px.

    point: (B, h, w, 8) float32, FIRST_POSITION to FIRST_DEPTH; front: (B, h, w, 2, 2) int32: for each quarter of a cell,
    upper before lower, left before right, row * w + column of the cell whose point counts there
    """

    point: np.ndarray
    front: np.ndarray
    cell: int


@kernel
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


@kernel
def _in_front(entries: np.ndarray, row: int, column: int, out: np.ndarray) -> None:
    """Writes the number of the cell that has the nearest point for each quarter of a cell, (2, 2), see `first_points`."""
    for a in range(2):
        for b in range(2):
            out[a, b], empty = _least(entries, row - 1 + a, row + a, column - 1 + b, column + b)
            if empty:
                out[a, b], _ = _least(entries, row - 1, row + 1, column - 1, column + 1)


@kernel(inline=True)
def tolerance_of(surface: np.ndarray, tolerance: Tolerance) -> np.float32:
    """How far, m, points may be apart across a surface that are on it. surface: (8,) float32 of `facing.surfaces`"""
    known = surface[NORMAL] != 0 or surface[NORMAL + 1] != 0 or surface[NORMAL + 2] != 0
    return surface[SCATTER] * (tolerance.known if known else tolerance.unknown)


@kernel
def _describe(
    entry: np.int64,
    points: np.ndarray,
    surface: np.ndarray,
    tolerance: Tolerance,
    pose: np.ndarray,
    out: np.ndarray,
) -> None:
    """Writes the point of an entry as `hides` wants it, (8,)."""
    out[:] = 0.0
    out[FIRST_DEPTH] = np.inf
    if entry == EMPTY:
        return
    i = np.int32(entry & 0xFFFFFFFF)
    toward = np.float32(0.0)
    for a in range(3):
        out[FIRST_POSITION + a] = points[a, i]
        toward += surface[i, NORMAL + a] * (pose[a, 3] - points[a, i])
    for a in range(3):
        out[FIRST_NORMAL + a] = surface[i, NORMAL + a] if toward > 0 else -surface[i, NORMAL + a]
    out[FIRST_TOLERANCE] = tolerance_of(surface[i], tolerance)
    out[FIRST_DEPTH] = np.float32(entry >> 32) / STEPS


@parallel_kernel
def first_points(
    cloud: BlockPoints,
    surface: np.ndarray,
    tolerance: Tolerance,
    poses: np.ndarray,
    intrinsics: Intrinsics,
    cell: int,
    height: int,
    width: int,
) -> FirstPoints:
    """The nearest point in each cell of `cell` pixels of B images, and whose counts for each quarter of a cell.

    For a quarter the nearest of the four cells at its corner counts, so that edges are kept clear of by as much on all
    sides; of all nine about the cell where one of the four is empty: such a map is sparser than cells, and what is nearer
    shows in some of them only. Of points in the same step of depth the one with the lower index counts.
    surface: (M, 8) float32, see `facing.surfaces`; poses: (B, 4, 4) float32, world_from_camera; intrinsics: float32
    """
    rows, columns = (height + cell - 1) // cell, (width + cell - 1) // cell
    out = np.empty((poses.shape[0], rows, columns, 8), np.float32)
    front = np.empty((poses.shape[0], rows, columns, 2, 2), np.int32)
    for image in prange(poses.shape[0]):
        nearest = nearest_entries(cloud, poses[image], intrinsics, cell, height, width)
        for row in range(rows):
            for column in range(columns):
                entry, description = nearest[row, column], out[image, row, column]
                _describe(entry, cloud.position, surface, tolerance, poses[image], description)
                _in_front(nearest, row, column, front[image, row, column])
    return FirstPoints(out, front, cell)


@kernel(inline=True)
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
    """Whether a point of `first_points` hides the point (x, y, z), m, world, at a depth, m, in the same image.

    front: (8,) float32, FIRST_POSITION to FIRST_DEPTH; normal: unit, towards the camera, zero where unknown; tolerance:
    m; slack: m, how much nearer another point of the same surface may be, where one of the two surfaces is unknown
    """
    behind = depth - front[FIRST_DEPTH]
    if not behind > 0:
        return False
    dx, dy, dz = x - front[FIRST_POSITION], y - front[FIRST_POSITION + 1], z - front[FIRST_POSITION + 2]
    nx, ny, nz = front[FIRST_NORMAL], front[FIRST_NORMAL + 1], front[FIRST_NORMAL + 2]
    known = nx != 0 or ny != 0 or nz != 0
    below = -(nx * dx + ny * dy + nz * dz) if known else behind - slack
    if not below > front[FIRST_TOLERANCE]:
        return False
    known = normal_x != 0 or normal_y != 0 or normal_z != 0
    above = -(normal_x * dx + normal_y * dy + normal_z * dz) if known else behind - slack
    return above > tolerance
