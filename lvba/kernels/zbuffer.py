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
SAME_SURFACE = np.float32(0.05)
"""Points of a surface are deeper by less than this part of their depth from one pixel to the next."""
EIGHTHS = np.float32(8.0)
_MIDDLE = np.float32(3.5)
"""Where a point is in a pixel is known to an eighth of it; in its middle in so many."""
_COARSE = np.float32(16384.0)
"""Steps of depth per m that points in a pixel are compared by."""
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


class OwnPoints(NamedTuple):
    """The own point of each pixel.

    entry: (H, W) int64, EMPTY where there is none; depth: (H, W) float32, m, inf where there is none
    right, down: (H, W) float32, px, from the middle of the pixel
    """

    entry: np.ndarray
    depth: np.ndarray
    right: np.ndarray
    down: np.ndarray


@kernel(inline=True)
def _farther(right: np.int64, down: np.int64) -> np.float32:
    """How many times as deep a point counts. right, down: where it is in its pixel, in EIGHTHS of one from the corner"""
    aside = abs(np.float32(right) - _MIDDLE) + abs(np.float32(down) - _MIDDLE)
    return np.float32(1.0) + SAME_SURFACE / EIGHTHS * aside


@kernel
def splat(
    cloud: BlockPoints,
    source: np.ndarray,
    pose: np.ndarray,
    intrinsics: Intrinsics,
    image: int,
    guard: int,
    radius: int,
    height: int,
    width: int,
) -> np.ndarray:
    """What each pixel of one image sees, of all points and of those of other images: entries (2, H, W) int64.

    Of points in one pixel the one in its middle, for the nearest one is at the edge where a slanted surface comes closer,
    and all that is seen would be moved there. So depths count as larger by SAME_SURFACE of themselves for each pixel that
    they are from the middle, along rows and along columns: a slope that is less than that moves nothing.
    source: (M,) int32, image that colored the point; pose: (4, 4) float32, world_from_camera; intrinsics: float32
    guard: points whose source is within `guard` of the image are left out of variant 1; radius: half a splat, px.
    Entry: depth in 2^-20 m << 32 | index of the point; EMPTY where there is none.
    """
    # both variants side by side: they nearly always touch the same line of memory
    nearest = np.full((height, width, 2), EMPTY, np.int64)
    slopes = view_slopes(intrinsics, width, height)
    half = np.float32(0.5)
    buffers = view_buffers()
    u, v, depth, which = buffers.u, buffers.v, buffers.depth, buffers.which
    points, start = cloud.position, cloud.start
    for b in range(start.shape[0] - 1):
        if not sphere_in_view(cloud.spheres[b], pose, slopes):
            continue
        for first in range(start[b], start[b + 1], RUN):
            seen = in_view(points, first, start[b + 1], pose, intrinsics, width, height, buffers)
            for k in which[:seen]:
                x, y = np.int64((u[k] + half) * EIGHTHS), np.int64((v[k] + half) * EIGHTHS)
                row, column, right, down = y >> 3, x >> 3, x & 7, y & 7
                counted = np.int64(min(depth[k] * _farther(right, down), FAR_M) * _COARSE)
                entry = (counted << 38) | (right << 35) | (down << 32) | (first + k)
                # stores without branches: which point is nearer cannot be predicted
                other = entry if abs(source[first + k] - image) > guard else EMPTY
                nearest[row, column, 0] = min(nearest[row, column, 0], entry)
                nearest[row, column, 1] = min(nearest[row, column, 1], other)
    out = np.empty((2, height, width), np.int64)
    for variant in range(2):
        _spread(_own_points(nearest[:, :, variant]), radius, out[variant])
    return out


@kernel
def _own_points(nearest: np.ndarray) -> OwnPoints:
    """What is known of the points of entries (H, W) int64 as `splat` compares them."""
    height, width = nearest.shape
    entries = np.empty((height, width), np.int64)
    places = np.empty((3, height, width), np.float32)
    for row in range(height):
        for column in range(width):
            entry = nearest[row, column]
            right, down = (entry >> 35) & 7, (entry >> 32) & 7
            depth = np.float32(entry >> 38) / (_COARSE * _farther(right, down))
            empty = entry == EMPTY
            places[0, row, column] = np.float32(np.inf) if empty else depth
            places[1, row, column] = (np.float32(right) - _MIDDLE) / EIGHTHS
            places[2, row, column] = (np.float32(down) - _MIDDLE) / EIGHTHS
            entries[row, column] = EMPTY if empty else (np.int64(depth * STEPS) << 32) | (entry & 0xFFFFFFFF)
    return OwnPoints(entries, places[0], places[1], places[2])


@kernel
def _spread(own: OwnPoints, radius: int, out: np.ndarray) -> None:
    """Every pixel takes its own point. Where it has none, or one behind those of the pixels within `radius` (a square),
    it takes of what is in front the point that is nearest to its middle.

    Points within SAME_SURFACE of the depth of the nearest of them are in front.
    out: (H, W) int64, entries
    """
    height, width = own.entry.shape
    front = np.empty((height, width), np.float32)
    _least_around(own.depth, radius, front)
    side = 2 * radius + 1
    limit, least, choice = np.empty(width, np.float32), np.empty(width, np.float32), np.empty(width, np.int32)
    for row in range(height):
        lacking = 0
        for column in range(width):
            limit[column] = front[row, column] * (np.float32(1.0) + SAME_SURFACE)
            kept = own.depth[row, column] <= limit[column]
            # of an own point that is kept, none is nearer
            least[column], choice[column] = (
                np.float32(-1.0 if kept else np.inf),
                np.int32(side * radius + radius),
            )
            lacking += not kept
            out[row, column] = own.entry[row, column]
        if not lacking:
            continue
        for other in range(max(0, row - radius), min(height, row + radius + 1)):
            for shift in range(-radius, radius + 1):
                number = np.int32((other - row + radius) * side + shift + radius)
                _choose(own, row, other, shift, number, limit, least, choice)
        for column in range(width):
            if least[column] >= 0 and least[column] < np.inf:
                other, beside = choice[column] // side, choice[column] % side
                out[row, column] = own.entry[row + other - radius, column + beside - radius]


@kernel
def _choose(
    own: OwnPoints,
    row: int,
    other: int,
    shift: int,
    number: np.int32,
    limit: np.ndarray,
    least: np.ndarray,
    choice: np.ndarray,
) -> None:
    """Points of the row `other`, `shift` pixels on, for the pixels of a row: without branches, so that many are compared
    at a time.

    limit: (W,) float32, m, of what is in front; least: (W,) float32, squared distance (px) of the nearest point, and
    choice: (W,) int32, its number: in and out
    """
    width, beside = len(limit), np.float32(shift)
    first, stop = max(0, -shift), min(width, width - shift)
    below = np.float32(other - row)
    depth = own.depth[other, first + shift : stop + shift]
    right, down = (
        own.right[other, first + shift : stop + shift],
        own.down[other, first + shift : stop + shift],
    )
    limit, least, choice = limit[first:stop], least[first:stop], choice[first:stop]
    for k in range(stop - first):
        x, y = right[k] + beside, down[k] + below
        square = x * x + y * y
        better = (depth[k] <= limit[k]) & (square < least[k])
        least[k] = square if better else least[k]
        choice[k] = number if better else choice[k]


@kernel
def _least_around(values: np.ndarray, radius: int, out: np.ndarray) -> None:
    """The least of the values (H, W) float32 within `radius` of each (a square)."""
    height, width = values.shape
    across = np.empty((height, width), np.float32)
    line = np.full(width + 2 * radius, np.float32(np.inf))
    for row in range(height):
        for column in range(width):
            line[column + radius] = values[row, column]
        for column in range(width):
            across[row, column] = line[column]
        for shift in range(1, 2 * radius + 1):
            for column in range(width):
                across[row, column] = min(across[row, column], line[column + shift])
    for row in range(height):
        for column in range(width):
            out[row, column] = across[row, column]
        for other in range(max(0, row - radius), min(height, row + radius + 1)):
            for column in range(width):
                out[row, column] = min(out[row, column], across[other, column])


@kernel
def fill(entries: np.ndarray, radius: int) -> np.ndarray:
    """The entries (2, H, W), where empty those of the nearest pixel within `radius` of what is in front there.

    entries: (2, H, W) int64
    """
    height, width = entries.shape[1:]
    out = np.empty_like(entries)
    places = np.zeros((3, height, width), np.float32)
    for variant in range(2):
        for row in range(height):
            for column in range(width):
                entry = entries[variant, row, column]
                places[0, row, column] = np.inf if entry == EMPTY else np.float32(entry >> 32) / STEPS
        own = OwnPoints(entries[variant], places[0], places[1], places[2])
        _spread(own, radius, out[variant])
        for row in range(height):
            for column in range(width):
                if entries[variant, row, column] != EMPTY:
                    out[variant, row, column] = entries[variant, row, column]
    return out


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
def take_out_hidden(entries: np.ndarray, cell: int, part: float, tolerance: float) -> None:
    """Empties the pixels of the second variant that show, through gaps of the first, what lies behind it; in place.

    entries: (2, H, W) int64, of `splat`; cell: px, edge of the cells of `seen_depths`
    part: of the depth, and tolerance, m: what is deeper than the first variant in that cell by more than both is behind
    """
    height, width = entries.shape[1:]
    nearest = np.full(((height + cell - 1) // cell, (width + cell - 1) // cell), EMPTY, np.int64)
    for row in range(height):
        for column in range(width):
            at = row // cell, column // cell
            nearest[at] = min(nearest[at], entries[0, row, column])
    limit = _cell_depths(nearest) * np.float32(1 + part) + np.float32(tolerance)
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


@kernel
def shade(
    entries: np.ndarray,
    gray: np.ndarray,
    source: np.ndarray,
    ratio: np.ndarray,
    light: np.ndarray,
    first: int,
    color: np.ndarray,
    covered: np.ndarray,
) -> None:
    """Writes the colors (2, H, W, 3) float32, 0..255, and whether anything is seen (2, H, W) bool.

    entries: (2, H, W) int64; gray: (M, 3) float32, gray values in the source image; source: (M,) int32; ratio: (I,)
    float32, relative exposure of this image over that of each source. Clipped at 255, as the sensor does. light: (H, W)
    float32, part of it that arrives at each pixel. first: 1 if the first picture's colors are not wanted, and are not
    written; else 0
    color: (2, H, W, 3) float32, out; covered: (2, H, W) bool, out
    """
    for row in range(entries.shape[1]):
        for column in range(entries.shape[2]):
            for variant in range(2):
                entry = entries[variant, row, column]
                covered[variant, row, column] = entry != EMPTY
                if variant < first:
                    continue
                if entry == EMPTY:
                    for c in range(3):
                        color[variant, row, column, c] = 0.0
                elif variant > first and entry == entries[0, row, column]:
                    for c in range(3):
                        color[1, row, column, c] = color[0, row, column, c]
                else:
                    i = np.int32(entry & 0xFFFFFFFF)
                    gain = ratio[source[i]] * light[row, column]
                    for c in range(3):
                        color[variant, row, column, c] = min(gray[i, c] * gain, np.float32(255.0))
