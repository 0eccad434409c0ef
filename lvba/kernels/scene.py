"""What kernels are handed in one layout: poses, intrinsics, plane patches. Stated here, and nowhere else.

A pose is `a_from_b`, a C-contiguous (4, 4) rigid transform, as everywhere in lvba: rotation `[:3, :3]`, the origin of b
in frame a `[:3, 3]`. Kernels take `world_from_camera` (I, 4, 4) and `world_from_scan` (S, 4, 4): float64, and float32
where a map of float32 points is projected. The inverse rotation is read with its indices swapped, never stored.
"""

from typing import NamedTuple

import numpy as np


class Intrinsics(NamedTuple):
    """A pinhole camera, px: focal lengths and principal point; float64, or float32 beside float32 poses."""

    fx: float | np.float32
    fy: float | np.float32
    cx: float | np.float32
    cy: float | np.float32


class PlanePatches(NamedTuple):
    """P patches of planes, each tied to a whole pixel of its reference image.

    position: (P, 3) float64, m, world; normal: (P, 3) float64, unit, world
    reference: (P,) int32, image; pixel: (P, 2) int32, (column, row) in it
    """

    position: np.ndarray
    normal: np.ndarray
    reference: np.ndarray
    pixel: np.ndarray


class NearestPoints(NamedTuple):
    """The nearest LiDAR point in every cell of every image.

    nearest: (I, rows, columns) int32 into points, -1: none; (0, 0, 0): nothing is known to hide anything
    points: (M, 3) float32, m, world; cell: px, edge of a cell
    """

    nearest: np.ndarray
    points: np.ndarray
    cell: float


class BlockPoints(NamedTuple):
    """Points sorted into blocks, so that an image only meets the blocks in front of it.

    position: (3, M) float32, m, world, by axis; start: (B + 1,) int64, block b owns points start[b] to start[b + 1]
    spheres: (B, 4) float32, m, world, center and radius of a sphere about each block
    """

    position: np.ndarray
    start: np.ndarray
    spheres: np.ndarray
