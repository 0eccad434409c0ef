"""Z-buffers of a point cloud sorted into blocks: which point every pixel sees.

Points are stored by axis, (3, M), and projected in runs without branches, so that the compiler works on many at a
time. A pixel's entry is one integer: depth in steps of 2^-20 m above, index of the point below. The least entry is the
nearest point, and of points in the same step the one with the lower index, whatever the order they come in.
"""

from typing import NamedTuple

import numpy as np
from numba import prange

from lvba.kernels.compiled import kernel, parallel_kernel
from lvba.kernels.scene import BlockPoints, Intrinsics

NEAR_M = np.float32(0.05)
EMPTY = np.int64(0x7FFFFFFF_FFFFFFFF)
FAR_M = np.float32(2047.0)
STEPS = np.float32(1048576.0)
_STRAY = 0.15
"""Part of what shows in a cell that stray points may cover: of what moved, or of the vehicle that carries the sensors,
there are some before every image of a drive. Where each hid what lies behind it, 14 % of the pixels were left to judge
by."""
RUN = 512
"""Points projected at a time: what is known about them stays in the nearest cache."""


class ViewSlopes(NamedTuple):
    """Side planes of a view, float32: x / z of the left and the right one, y / z of the upper and the lower one."""

    left: np.float32
    right: np.float32
    top: np.float32
    bottom: np.float32


class ViewBuffers(NamedTuple):
    """Room for what `in_view` writes about one run of points.

    u, v: (RUN,) float32, px; depth: (RUN,) float32, m, -1: not in the image; which: (RUN,) int64, those that are
    """

    u: np.ndarray
    v: np.ndarray
    depth: np.ndarray
    which: np.ndarray


@kernel
def sphere_in_view(sphere: np.ndarray, pose: np.ndarray, slopes: ViewSlopes) -> bool:
    """Whether a bounding sphere, (4,) float32, can touch the view. pose: (4, 4) float32, world_from_camera

    sphere: (4,) float32, m, center and radius
    """
    dx, dy, dz = sphere[0] - pose[0, 3], sphere[1] - pose[1, 3], sphere[2] - pose[2, 3]
    x = pose[0, 0] * dx + pose[1, 0] * dy + pose[2, 0] * dz
    y = pose[0, 1] * dx + pose[1, 1] * dy + pose[2, 1] * dz
    z = pose[0, 2] * dx + pose[1, 2] * dy + pose[2, 2] * dz
    r = sphere[3]
    if z < -r:
        return False
    if (slopes.left * z - x) > r * np.sqrt(1 + slopes.left * slopes.left):
        return False
    if (x - slopes.right * z) > r * np.sqrt(1 + slopes.right * slopes.right):
        return False
    if (slopes.top * z - y) > r * np.sqrt(1 + slopes.top * slopes.top):
        return False
    return (y - slopes.bottom * z) <= r * np.sqrt(1 + slopes.bottom * slopes.bottom)


@kernel
def view_slopes(intrinsics: Intrinsics, width: int, height: int) -> ViewSlopes:
    """The four side planes of the view, one pixel wider than the image."""
    return ViewSlopes(
        np.float32((-1.5 - intrinsics.cx) / intrinsics.fx),
        np.float32((width + 0.5 - intrinsics.cx) / intrinsics.fx),
        np.float32((-1.5 - intrinsics.cy) / intrinsics.fy),
        np.float32((height + 0.5 - intrinsics.cy) / intrinsics.fy),
    )


@kernel
def _project(
    points: np.ndarray,
    first: int,
    pose: np.ndarray,
    intrinsics: Intrinsics,
    width: int,
    height: int,
    u: np.ndarray,
    v: np.ndarray,
    depth: np.ndarray,
) -> None:
    """Writes where points from `first` on are in the image, without branches; depth -1: not in it. See `in_view`."""
    one, half, out = np.float32(1.0), np.float32(0.5), np.float32(-1.0)
    right, bottom = np.float32(width) - half, np.float32(height) - half
    r00, r01, r02 = pose[0, 0], pose[1, 0], pose[2, 0]
    r10, r11, r12 = pose[0, 1], pose[1, 1], pose[2, 1]
    r20, r21, r22 = pose[0, 2], pose[1, 2], pose[2, 2]
    tx, ty, tz = pose[0, 3], pose[1, 3], pose[2, 3]
    fx, fy, cx, cy = intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy
    last = first + len(depth)
    xs, ys, zs = points[0, first:last], points[1, first:last], points[2, first:last]
    for k in range(len(depth)):
        dx, dy, dz = xs[k] - tx, ys[k] - ty, zs[k] - tz
        z = r20 * dx + r21 * dy + r22 * dz
        inverse = one / z
        column = fx * (r00 * dx + r01 * dy + r02 * dz) * inverse + cx
        row = fy * (r10 * dx + r11 * dy + r12 * dz) * inverse + cy
        inside = (z >= NEAR_M) & (column > -half) & (column < right) & (row > -half) & (row < bottom)
        u[k] = column
        v[k] = row
        depth[k] = z if inside else out


@kernel
def view_buffers() -> ViewBuffers:
    """Room for one run of points."""
    floats = np.empty((3, RUN), np.float32)
    return ViewBuffers(floats[0], floats[1], floats[2], np.empty(RUN, np.int64))


@kernel
def in_view(
    points: np.ndarray,
    first: int,
    stop: int,
    pose: np.ndarray,
    intrinsics: Intrinsics,
    width: int,
    height: int,
    buffers: ViewBuffers,
) -> int:
    """How many of the points [first : stop], RUN at most, the image shows; `which` starts with them, in order.

    points: (3, M) float32, m, world; pose: (4, 4) float32, world_from_camera; buffers: out, of all points of the run,
    counted from `first`
    """
    count, depth, which = min(RUN, stop - first), buffers.depth, buffers.which
    _project(
        points, first, pose, intrinsics, width, height, buffers.u[:count], buffers.v[:count], depth[:count]
    )
    seen = 0
    for k in range(count):
        which[seen] = k
        seen += depth[k] >= 0
    return seen


@kernel
def split(entries: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth float32, m, inf where empty, and index int32, -1 where empty, of entries (2, H, W) int64."""
    depth = np.full(entries.shape, np.inf, np.float32)
    index = np.full(entries.shape, -1, np.int32)
    for a in range(entries.shape[0]):
        for row in range(entries.shape[1]):
            for column in range(entries.shape[2]):
                entry = entries[a, row, column]
                if entry != EMPTY:
                    depth[a, row, column] = np.float32(entry >> 32) / STEPS
                    index[a, row, column] = np.int32(entry & 0xFFFFFFFF)
    return depth, index


@kernel
def _seen_depth(inverse: np.ndarray, row: int, column: int) -> np.float32:
    """How deep one cell sees. inverse: inverse depths with a margin of one cell, 0 where nothing is seen.

    On a plane, inverse depth is linear in the image. So a nearer neighbor belongs to the same surface if the cell on
    the opposite side recedes by at least part of what the neighbor comes closer, in inverse depth.
    """
    own = inverse[row, column]
    front, slope = own, np.float32(0.0)
    for step in range(9):
        down, right = step // 3 - 1, step % 3 - 1
        near, far = inverse[row + down, column + right], inverse[row - down, column - right]
        rise = near - own
        if rise <= 0:
            continue
        if own > 0 and far > 0 and own - far >= np.float32(0.4) * rise:
            slope = max(slope, min(own - far, rise))
        else:
            front = max(front, near)
    if front > own * np.float32(1.02):
        return np.float32(1.0) / front
    deepest = own - slope
    return np.float32(1.0) / deepest if deepest > 0 else np.float32(np.inf)


@kernel
def nearest_entries(
    cloud: BlockPoints,
    pose: np.ndarray,
    intrinsics: Intrinsics,
    cell: int,
    height: int,
    width: int,
) -> np.ndarray:
    """The nearest point in each cell of `cell` pixels of one image, (h, w) int64; EMPTY where there is none.

    An entry is the depth in steps, shifted left by 32 bits, and the index: of points in the same step the one with the
    lower index counts.
    pose: (4, 4) float32, world_from_camera; intrinsics: float32
    """
    nearest = np.full(((height + cell - 1) // cell, (width + cell - 1) // cell), EMPTY, np.int64)
    slopes = view_slopes(intrinsics, width, height)
    half = np.float32(0.5)
    cell_of = np.arange(max(height, width)) // cell
    buffers = view_buffers()
    u, v, depth, which = buffers.u, buffers.v, buffers.depth, buffers.which
    points, start = cloud.position, cloud.start
    for b in range(start.shape[0] - 1):
        if not sphere_in_view(cloud.spheres[b], pose, slopes):
            continue
        for first in range(start[b], start[b + 1], RUN):
            seen = in_view(points, first, start[b + 1], pose, intrinsics, width, height, buffers)
            for k in which[:seen]:
                row, column = cell_of[int(v[k] + half)], cell_of[int(u[k] + half)]
                entry = (np.int64(min(depth[k], FAR_M) * STEPS) << 32) | (first + k)
                nearest[row, column] = min(nearest[row, column], entry)
    return nearest


@kernel
def _cell_depths(nearest: np.ndarray) -> np.ndarray:
    """How deep an image sees in each cell, see `seen_depths`: (h, w) float32, m.

    nearest: (h, w) int64, entries
    """
    rows, columns = nearest.shape
    inverse = np.zeros((rows + 2, columns + 2), np.float32)
    for row in range(rows):
        for column in range(columns):
            if nearest[row, column] != EMPTY:
                inverse[row + 1, column + 1] = STEPS / np.float32(nearest[row, column] >> 32)
    out = np.empty((rows, columns), np.float32)
    for row in range(rows):
        for column in range(columns):
            out[row, column] = _seen_depth(inverse, row + 1, column + 1)
    return out


@kernel
def _surfaces_in_front(entries: np.ndarray, cell: int) -> np.ndarray:
    """The entry (h, w) int64 of the nearest surface in each cell of `cell` pixels; EMPTY where there is none.

    Surfaces cover more than a few pixels: `_STRAY` of those that show anything may be nearer. entries: (H, W) int64
    """
    height, width = entries.shape
    out = np.full(((height + cell - 1) // cell, (width + cell - 1) // cell), EMPTY, np.int64)
    shown = np.empty(cell * cell, np.int64)
    for top in range(0, height, cell):
        for left in range(0, width, cell):
            count = 0
            for row in range(top, min(top + cell, height)):
                for column in range(left, min(left + cell, width)):
                    shown[count] = entries[row, column]
                    count += entries[row, column] != EMPTY
            if count:
                shown[:count].sort()
                out[top // cell, left // cell] = shown[int(_STRAY * count)]
    return out


@kernel
def take_out_hidden(entries: np.ndarray, cell: int, part: float, tolerance: float) -> None:
    """Empties the pixels of the second variant that show, through gaps of the first, what lies behind it; in place.

    entries: (2, H, W) int64, of `splat`; cell: px, edge of the cells of `seen_depths`
    part: of the depth, and tolerance, m: what is deeper than the first variant in that cell by more than both is behind
    """
    height, width = entries.shape[1:]
    limit = _cell_depths(_surfaces_in_front(entries[0], cell))
    limit = limit * np.float32(1 + part) + np.float32(tolerance)
    for row in range(height):
        for column in range(width):
            entry = entries[1, row, column]
            if entry != EMPTY and np.float32(entry >> 32) / STEPS > limit[row // cell, column // cell]:
                entries[1, row, column] = EMPTY


@parallel_kernel
def seen_depths(
    cloud: BlockPoints,
    poses: np.ndarray,
    intrinsics: Intrinsics,
    cell: int,
    height: int,
    width: int,
) -> np.ndarray:
    """How deep each image sees in each cell of `cell` pixels: depth (B, h, w) float32, m, inf where nothing is near.

    That is the depth of the cell's nearest point, plus what a surface that runs on through the cells on both sides
    gains within this one; or the depth of a neighbor where that stands in front of this cell without such a surface:
    colors next to the edge of something nearer are not to be trusted. poses: (B, 4, 4) float32, world_from_camera
    """
    rows, columns = (height + cell - 1) // cell, (width + cell - 1) // cell
    out = np.empty((poses.shape[0], rows, columns), np.float32)
    for image in prange(poses.shape[0]):
        out[image] = _cell_depths(nearest_entries(cloud, poses[image], intrinsics, cell, height, width))
    return out
