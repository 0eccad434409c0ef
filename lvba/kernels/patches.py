"""Scene points of one pyramid level: LiDAR points seen by an image, gated, scored, the best of every grid cell.

Lengths in metres, world frame; pixels (column, row) of the level's images. One image is one unit of parallel work.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import prange

from lvba.kernels.compiled import kernel, parallel_kernel
from lvba.kernels.scene import Intrinsics
from lvba.kernels.visibility_depth import hiding_depth

_SLANT = 0.004
"""Part of the depth that a point may be off its plane whatever the plane's tolerance."""


class PlanePoints(NamedTuple):
    """LiDAR points and the planes that they are on.

    position: (M, 3) float32, m, world; plane: (M,) int32, -1: on none
    center: (K, 3) float64, m, world; normal: (K, 3) float64, unit, world
    tolerance: (K,) float64, m, distance from which a point is off the plane
    """

    position: np.ndarray
    plane: np.ndarray
    center: np.ndarray
    normal: np.ndarray
    tolerance: np.ndarray


class PointGates(NamedTuple):
    """What a LiDAR point must pass to become a scene point.

    half: px, of the patch; tries: candidates per cell
    min_normal_cosine: of the view and the plane's normal; min_depth: m
    dark, bright: grey values up to the one and from the other on are masked; min_usable: least part of the patch that is
    not; min_score: least |DoG|
    max_off_plane: largest part of the LiDAR points within twice the patch that are off the plane; min_support: least
    number that are on it; bin: px, edge of the bins that these are looked up in; extent_spacings: how far the support is
    looked for, in mean spacings of LiDAR points; max_extent: px, how far at most where they are sparse in one direction
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
    extent_spacings: float
    max_extent: float
    min_buffer: float
    buffer_spacings: float
    hiding: float


class Projected(NamedTuple):
    """The LiDAR points that project into an image.

    uvz: (N, 3) float32, px and depth in m; point: (N,) int64, which they are; hidden: (N,) uint8 of `hidden_points`
    """

    uvz: np.ndarray
    point: np.ndarray
    hidden: np.ndarray


class Bins(NamedTuple):
    """Projected points by square bins of `size` px, rows of bins after each other.

    offsets: (rows columns + 1,) int64: bin b owns order[offsets[b]] to order[offsets[b + 1]]; order: (N,) int64
    """

    offsets: np.ndarray
    order: np.ndarray
    size: float
    columns: int
    rows: int


class Reach(NamedTuple):
    """px, how far from a pixel its support is looked for: across and down the image."""

    across: float
    down: float


class Support(NamedTuple):
    """LiDAR points about a pixel: how many are on its plane and how many off it; px, how far those on it reach."""

    on: float
    off: float
    left: float
    right: float
    top: float
    bottom: float


class Met(NamedTuple):
    """Where a ray meets a plane: m, world; depth, m, -1: never; |cosine| of ray and normal."""

    x: float
    y: float
    z: float
    depth: float
    cosine: float


@kernel
def project_near(
    points: np.ndarray,
    start: int,
    stop: int,
    step: int,
    world_from_camera: np.ndarray,
    intrinsics: Intrinsics,
    width: int,
    height: int,
    nearest: float,
) -> tuple[np.ndarray, np.ndarray]:
    """The points [start:stop:step] inside the image: uvz (N, 3) float32 and index (N,) int64.

    points: (M, 3) float32, m, world; world_from_camera: (4, 4) float64; nearest: m, smallest depth
    """
    r, fx, fy, cx, cy = world_from_camera, intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy
    uvz = np.empty((max((stop - start + step - 1) // step, 0), 3), np.float32)
    index = np.empty(len(uvz), np.int64)
    count = 0
    for m in range(start, stop, step):
        dx, dy, dz = points[m, 0] - r[0, 3], points[m, 1] - r[1, 3], points[m, 2] - r[2, 3]
        z = r[0, 2] * dx + r[1, 2] * dy + r[2, 2] * dz
        if not z > nearest:
            continue
        # rounded before the test: rounded after it, 639.4999999 would be 639.5 and lie in a cell that is none
        u = np.float32(fx * (r[0, 0] * dx + r[1, 0] * dy + r[2, 0] * dz) / z + cx)
        v = np.float32(fy * (r[0, 1] * dx + r[1, 1] * dy + r[2, 1] * dz) / z + cy)
        if u < -0.5 or v < -0.5 or u >= width - 0.5 or v >= height - 0.5:
            continue
        uvz[count, 0], uvz[count, 1], uvz[count, 2] = u, v, z
        index[count] = m
        count += 1
    return uvz[:count].copy(), index[:count].copy()


@kernel
def bin_points(uvz: np.ndarray, width: int, height: int, size: float) -> Bins:
    """The points by square bins, in input order. uvz: (N, 3) float32, see `Projected`; width, height, size: px"""
    columns, rows = math.ceil(width / size), math.ceil(height / size)
    offsets = np.zeros(columns * rows + 1, np.int64)
    which = np.empty(len(uvz), np.int64)
    for k in range(len(uvz)):
        which[k] = int((uvz[k, 1] + 0.5) / size) * columns + int((uvz[k, 0] + 0.5) / size)
        offsets[which[k] + 1] += 1
    for b in range(len(offsets) - 1):
        offsets[b + 1] += offsets[b]
    fill = offsets[:-1].copy()
    order = np.empty(len(uvz), np.int64)
    for k in range(len(uvz)):
        order[fill[which[k]]] = k
        fill[which[k]] += 1
    return Bins(offsets, order, size, columns, rows)


@kernel
def usual_gap(bins: Bins, down: bool) -> float:
    """px, median distance of bins that hold points to the next such of its column (`down`) or row; 0: none."""
    along, beside = (bins.rows, bins.columns) if down else (bins.columns, bins.rows)
    gaps, total = np.zeros(along + 1, np.int64), 0
    for b in range(beside):
        last = -1
        for a in range(along):
            one = a * bins.columns + b if down else b * bins.columns + a
            if bins.offsets[one + 1] == bins.offsets[one]:
                continue
            if last >= 0:
                gaps[a - last] += 1
                total += 1
            last = a
    below = 0
    for gap in range(along + 1):
        below += gaps[gap]
        if total > 0 and 2 * below >= total:
            return gap * bins.size
    return 0.0


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
def z_buffer(uvz: np.ndarray, width: int, height: int, size: float) -> np.ndarray:
    """The nearest point of every cell of `size` px, (rows, columns) int64, -1 where none; of equals the first.

    uvz: (N, 3) float32, see `Projected`
    """
    nearest = np.full((math.ceil(height / size), math.ceil(width / size)), -1, np.int64)
    for k in range(len(uvz)):
        row, column = int((uvz[k, 1] + 0.5) / size), int((uvz[k, 0] + 0.5) / size)
        best = nearest[row, column]
        if best < 0 or uvz[k, 2] < uvz[best, 2]:
            nearest[row, column] = k
    return nearest


@kernel
def off_plane(lidar: PlanePoints, plane: int, point: int) -> float:
    """How far a LiDAR point is from a plane, m, with its side."""
    off = 0.0
    for a in range(3):
        off += lidar.normal[plane, a] * (lidar.position[point, a] - lidar.center[plane, a])
    return off


@kernel
def is_behind(
    k: int, q: int, uvz: np.ndarray, index: np.ndarray, lidar: PlanePoints, tolerance: float
) -> bool:
    """Whether a nearer projected point q hides projected point k: it must lie off k's plane, which does not hide itself.

    uvz: (N, 3) float32, index: (N,) int64, see `Projected`; tolerance: m, of hiding where k is on no plane
    """
    z = uvz[k, 2]
    own = lidar.plane[index[k]]
    if own < 0:
        return uvz[q, 2] < z - 2 * tolerance - 0.1 * z
    return abs(off_plane(lidar, own, index[q])) > max(lidar.tolerance[own], _SLANT * z)


@kernel
def hidden_points(
    uvz: np.ndarray,
    index: np.ndarray,
    lidar: PlanePoints,
    width: int,
    height: int,
    size: float,
    tolerance: float,
) -> np.ndarray:
    """(N,) uint8: 0 seen; 1 something nearer in a neighbouring cell of the z-buffer; 2 covered: in the point's own cell,
    or in more than half of the cells round it that hold points (through a sparse surface what is behind shows).

    uvz: (N, 3) float32, index: (N,) int64, see `Projected`; size: px, of the z-buffer's cells; tolerance: m
    """
    nearest = z_buffer(uvz, width, height, size)
    rows, columns = nearest.shape
    hidden = np.zeros(len(uvz), np.uint8)
    for k in range(len(uvz)):
        row, column = int((uvz[k, 1] + 0.5) / size), int((uvz[k, 0] + 0.5) / size)
        held, hiding, own, limit = 0, 0, False, hiding_depth(uvz[k, 2], tolerance)
        for i in range(max(row - 1, 0), min(row + 2, rows)):
            for j in range(max(column - 1, 0), min(column + 2, columns)):
                q = nearest[i, j]
                if q < 0:
                    continue
                held += 1
                if uvz[q, 2] < limit and is_behind(k, q, uvz, index, lidar, tolerance):
                    hiding += 1
                    own = own or (i == row and j == column)
        if own or 2 * hiding > held:
            hidden[k] = 2
        elif hiding:
            hidden[k] = 1
    return hidden


@kernel
def support(
    column: int,
    row: int,
    own: int,
    reach: float,
    wide: Reach,
    shown: Projected,
    lidar: PlanePoints,
    bins: Bins,
) -> Support:
    """Do the LiDAR points round a pixel lie on plane `own`?

    Points on the plane and points off it within `reach` px (square), then how far points on the plane extend to the
    left, right, top and bottom of the pixel, px, as far as `wide`. Covered points do not count.
    """
    on, off, left, right, top, bottom = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    uvz, size, columns = shown.uvz, bins.size, bins.columns
    first_row, last_row = int((row - wide.down + 0.5) / size), int((row + wide.down + 0.5) / size)
    for i in range(max(first_row, 0), min(last_row, bins.rows - 1) + 1):
        first = max(int((column - wide.across + 0.5) / size), 0)
        last = min(int((column + wide.across + 0.5) / size), columns - 1)
        for o in range(bins.offsets[i * columns + first], bins.offsets[i * columns + last + 1]):
            k = bins.order[o]
            du, dv = uvz[k, 0] - column, uvz[k, 1] - row
            if abs(du) > wide.across or abs(dv) > wide.down or shown.hidden[k] == 2:
                continue
            distance = off_plane(lidar, own, shown.point[k])
            inside = abs(du) <= reach and abs(dv) <= reach
            if abs(distance) <= max(lidar.tolerance[own], _SLANT * uvz[k, 2]):
                on += inside
                left, right = max(left, -du), max(right, du)
                top, bottom = max(top, -dv), max(bottom, dv)
            elif inside:
                off += 1
    return Support(on, off, left, right, top, bottom)


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
    bins = bin_points(uvz, width, height, gates.bin)
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
