"""LiDAR points in an image: where they project, what hides them, and how they lie about a pixel.

Lengths in metres, world frame; pixels (column, row) of the image.
"""

import math
from typing import NamedTuple

import numpy as np

from lvba.kernels.compiled import kernel
from lvba.kernels.depth_cells import is_alone, keep_two
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
def thinned(bins: Bins, most: int) -> Bins:
    """The bins with at most so many points each: of more every n-th."""
    offsets, order, kept = np.zeros_like(bins.offsets), np.empty_like(bins.order), 0
    for b in range(len(offsets) - 1):
        first, count = bins.offsets[b], bins.offsets[b + 1] - bins.offsets[b]
        taken = min(count, most)
        for i in range(taken):
            order[kept + i] = bins.order[first + i * count // taken]
        kept += taken
        offsets[b + 1] = kept
    return Bins(offsets, order[:kept].copy(), bins.size, bins.columns, bins.rows)


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
def z_buffer(uvz: np.ndarray, width: int, height: int, size: float) -> tuple[np.ndarray, np.ndarray]:
    """The nearest point of every cell of `size` px, (rows, columns) int64, -1 where none, of equals the first; and which
    points are alone before the others (`depth_cells`), (N,) bool: instead of them, the next of their cells.

    uvz: (N, 3) float32, see `Projected`
    """
    rows, columns = math.ceil(height / size), math.ceil(width / size)
    depth = np.full((rows, columns, 2), np.inf)
    index = np.full((rows, columns, 2), -1, np.int64)
    for k in range(len(uvz)):
        row, column = int((uvz[k, 1] + 0.5) / size), int((uvz[k, 0] + 0.5) / size)
        keep_two(depth[row, column], index[row, column], uvz[k, 2], k)
    nearest, alone = index[:, :, 0].copy(), np.zeros(len(uvz), np.bool_)
    for row in range(rows):
        for column in range(columns):
            if nearest[row, column] >= 0 and is_alone(depth, row, column):
                alone[nearest[row, column]] = True
                nearest[row, column] = index[row, column, 1]
    return nearest, alone


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
    or in more than half of the cells round it that hold points (through a sparse surface what is behind shows); and what
    is alone, as if it was not there.

    uvz: (N, 3) float32, index: (N,) int64, see `Projected`; size: px, of the z-buffer's cells; tolerance: m
    """
    nearest, alone = z_buffer(uvz, width, height, size)
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
        if own or 2 * hiding > held or alone[k]:
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
