"""Scene points of one pyramid level: LiDAR points seen by an image, gated, scored, the best of every grid cell.

Lengths in metres, world frame; pixels (column, row) of the level's images. One image is one unit of parallel work.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import prange

from lvba.kernels.compiled import kernel, parallel_kernel
from lvba.kernels.patches_support import (
    Bins,
    PlanePoints,
    Projected,
    Reach,
    bin_points,
    hidden_points,
    project_near,
    support,
    thinned,
    usual_gap,
)
from lvba.kernels.scene import Intrinsics


class PointGates(NamedTuple):
    """What a LiDAR point must pass to become a scene point.

    half: px, of the patch; tries: candidates per cell
    min_normal_cosine: of the view and the plane's normal; min_depth: m
    dark, bright: grey values up to the one and from the other on are masked; min_usable: least part of the patch that is
    not; min_score: least |DoG|
    max_off_plane: largest part of the LiDAR points within twice the patch that are off the plane; min_support: least
    number that are on it; bin: px, edge of the bins that these are looked up in; enough: most points of a bin that are;
    extent_spacings: how far the support is looked for, in mean spacings of LiDAR points; max_extent: px, how far at most
    where they are sparse in one direction
    min_buffer: px, least cell of the z-buffer; buffer_spacings: its cell in mean spacings; hiding: m, see
    `visibility_depth.hiding_depth`
    """

    half: int
    tries: int
    min_normal_cosine: float
    min_depth: float
    dark: float
    bright: float
    min_usable: float
    min_score: float
    max_off_plane: float
    min_support: float
    bin: float
    enough: int
    extent_spacings: float
    max_extent: float
    min_buffer: float
    buffer_spacings: float
    hiding: float


class Met(NamedTuple):
    """Where a ray meets a plane: m, world; depth, m, -1: never; |cosine| of ray and normal."""

    x: float
    y: float
    z: float
    depth: float
    cosine: float


@kernel
def reach_of(shown: Projected, bins: Bins, width: int, height: int, gates: PointGates) -> Reach:
    """How far from a pixel its support is looked for: some mean spacings of the points, further in the direction in which
    they are sparse, as across the rings of a spinning LiDAR."""
    patch = gates.half + 0.5
    spacing = math.sqrt(width * height / max(len(shown.uvz), 1))
    even = min(max(2.0, gates.extent_spacings * spacing / patch), 4.0) * patch
    across, down = 2.0 * usual_gap(bins, False), 2.0 * usual_gap(bins, True)
    return Reach(max(even, min(across, gates.max_extent)), max(even, min(down, gates.max_extent)))


@kernel
def usable_part(image: np.ndarray, column: int, row: int, half: int, dark: float, bright: float) -> float:
    """The part of the pixels round (column, row) whose channels all lie strictly between `dark` and `bright`.

    image: (H, W, C) uint8 or float32
    """
    good = 0
    for i in range(row - half, row + half + 1):
        for j in range(column - half, column + half + 1):
            fine = True
            for channel in range(image.shape[2]):
                value = image[i, j, channel]
                fine = fine and dark < value < bright
            good += fine
    return good / float((2 * half + 1) ** 2)


@kernel
def meet(
    column: int,
    row: int,
    world_from_camera: np.ndarray,
    intrinsics: Intrinsics,
    center: np.ndarray,
    normal: np.ndarray,
) -> Met:
    """Where the ray of a pixel meets a plane.

    world_from_camera: (4, 4) float64; center: (3,) float64, m, world; normal: (3,) float64, unit, world
    """
    x = (column - intrinsics.cx) / intrinsics.fx
    y = (row - intrinsics.cy) / intrinsics.fy
    r = world_from_camera
    ray = np.empty(3)
    along, offset = 0.0, 0.0
    for a in range(3):
        ray[a] = r[a, 0] * x + r[a, 1] * y + r[a, 2]
        along += normal[a] * ray[a]
        offset += normal[a] * (center[a] - r[a, 3])
    cosine = abs(along) / math.sqrt(x * x + y * y + 1)
    if along == 0 or offset / along <= 0:
        return Met(0.0, 0.0, 0.0, -1.0, cosine)
    depth = offset / along
    return Met(r[0, 3] + depth * ray[0], r[1, 3] + depth * ray[1], r[2, 3] + depth * ray[2], depth, cosine)


@kernel
def passes(
    k: int,
    shown: Projected,
    lidar: PlanePoints,
    bins: Bins,
    wide: Reach,
    image: np.ndarray,
    world_from_camera: np.ndarray,
    intrinsics: Intrinsics,
    gates: PointGates,
) -> bool:
    """Whether projected point k makes a scene point. image: (H, W, C) uint8; world_from_camera: (4, 4) float64"""
    half, depth, own = gates.half, shown.uvz[k, 2], lidar.plane[shown.point[k]]
    column, row = math.floor(shown.uvz[k, 0] + 0.5), math.floor(shown.uvz[k, 1] + 0.5)
    met = meet(column, row, world_from_camera, intrinsics, lidar.center[own], lidar.normal[own])
    if met.cosine < gates.min_normal_cosine or met.depth < gates.min_depth:
        return False
    if abs(met.depth - depth) > 0.05 * depth + 0.1:
        return False
    if usable_part(image, column, row, half, gates.dark, gates.bright) < gates.min_usable:
        return False
    points_found = support(column, row, own, 2.0 * (half + 0.5), wide, shown, lidar, bins)
    if points_found.on < gates.min_support or points_found.off > gates.max_off_plane * (
        points_found.on + points_found.off
    ):
        return False
    return min(min(points_found.left, points_found.right), min(points_found.top, points_found.bottom)) >= half


@kernel
def select_image(
    lidar: PlanePoints,
    points: np.ndarray,
    image: np.ndarray,
    score: np.ndarray,
    world_from_camera: np.ndarray,
    intrinsics: Intrinsics,
    cell: int,
    gates: PointGates,
    pixel: np.ndarray,
    own: np.ndarray,
) -> int:
    """Fill pixel (C, 2) and own (C,) of one image, row by row of cells; the number of LiDAR points in the image.

    points: (3,) int64, first, end and step; image: (H, W, C), score: (H, W), the others as in `select_points`
    world_from_camera: (4, 4) float64; pixel: (C, 2) int32, out; own: (C,) int32, out, -1: none
    """
    height, width = image.shape[0], image.shape[1]
    uvz, index = project_near(
        lidar.position, points[0], points[1], points[2], world_from_camera, intrinsics, width, height, gates.min_depth
    )  # fmt: skip
    # cells so large that few are empty, or what lies behind shows through
    spacing = math.sqrt(width * height / max(len(uvz), 1))
    buffer = max(gates.min_buffer, min(gates.buffer_spacings * spacing, 2.0 * gates.half + 1))
    shown = Projected(uvz, index, hidden_points(uvz, index, lidar, width, height, buffer, gates.hiding))
    bins = thinned(bin_points(uvz, width, height, gates.bin), gates.enough)
    wide = reach_of(shown, bins, width, height, gates)
    cells = bin_points(uvz, width, height, float(cell))
    value = np.zeros(len(uvz), np.float32)
    margin = gates.half + 1
    for k in range(len(uvz)):
        column, row = math.floor(uvz[k, 0] + 0.5), math.floor(uvz[k, 1] + 0.5)
        inside = margin <= column < width - margin and margin <= row < height - margin
        if (
            inside
            and lidar.plane[index[k]] >= 0
            and shown.hidden[k] == 0
            and score[row, column] >= gates.min_score
        ):
            value[k] = score[row, column]
    for c in range(len(own)):
        for _ in range(gates.tries):
            best = -1
            for o in range(cells.offsets[c], cells.offsets[c + 1]):
                k = cells.order[o]
                if value[k] > 0 and (best < 0 or value[k] > value[best]):
                    best = k
            if best < 0:
                break
            if passes(best, shown, lidar, bins, wide, image, world_from_camera, intrinsics, gates):
                pixel[c, 0] = math.floor(uvz[best, 0] + 0.5)
                pixel[c, 1] = math.floor(uvz[best, 1] + 0.5)
                own[c] = lidar.plane[index[best]]
                break
            value[best] = 0
    return len(uvz)


@parallel_kernel
def select_points(
    lidar: PlanePoints,
    ranges: np.ndarray,
    images: np.ndarray,
    scores: np.ndarray,
    world_from_camera: np.ndarray,
    intrinsics: Intrinsics,
    cell: int,
    gates: PointGates,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The best point of every cell of every image: pixel (I, C, 2) int32, plane (I, C) int32 (-1: none), seen (I,) int64,
    LiDAR points inside the image, hidden ones included.

    ranges: (I, 3) int64: first point, end, step of the points of the scans near each image
    images: (I, H, W, C) uint8 or float32; scores: (I, H, W) float32, |DoG|; world_from_camera: (I, 4, 4) float64
    cell: px
    """
    count, height, width, _ = images.shape
    cells = math.ceil(width / cell) * math.ceil(height / cell)
    pixel = np.zeros((count, cells, 2), np.int32)
    own = np.full((count, cells), -1, np.int32)
    seen = np.zeros(count, np.int64)
    for i in prange(count):
        seen[i] = select_image(
            lidar, ranges[i], images[i], scores[i], world_from_camera[i], intrinsics, cell, gates, pixel[i], own[i]
        )  # fmt: skip
    return pixel, own, seen
