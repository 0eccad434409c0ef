"""Z-buffers of a point cloud sorted into blocks: which point every pixel sees.

Points are stored by axis, (3, M), and projected in runs without branches, so that the compiler works on many at a
time. A pixel's entry is one integer: depth in steps of 2^-20 m above, index of the point below. The least entry is the
nearest point, and of points in the same step the one with the lower index, whatever the order they come in.
"""

import numpy as np
from numba import njit, prange

NEAR_M = np.float32(0.05)
EMPTY = np.int64(0x7FFFFFFF_FFFFFFFF)
FAR_M = np.float32(2047.0)
STEPS = np.float32(1048576.0)
RUN = 512
"""Points projected at a time: what is known about them stays in the nearest cache."""


@njit(cache=True, nogil=True, error_model="numpy")
def sphere_in_view(sphere: np.ndarray, pose: np.ndarray, slopes: np.ndarray) -> bool:
    """Whether a bounding sphere can touch the view. slopes: left, right, top, bottom plane as x/z or y/z."""
    dx, dy, dz = sphere[0] - pose[0, 3], sphere[1] - pose[1, 3], sphere[2] - pose[2, 3]
    x = pose[0, 0] * dx + pose[0, 1] * dy + pose[0, 2] * dz
    y = pose[1, 0] * dx + pose[1, 1] * dy + pose[1, 2] * dz
    z = pose[2, 0] * dx + pose[2, 1] * dy + pose[2, 2] * dz
    r = sphere[3]
    if z < -r:
        return False
    if (slopes[0] * z - x) > r * np.sqrt(1 + slopes[0] * slopes[0]):
        return False
    if (x - slopes[1] * z) > r * np.sqrt(1 + slopes[1] * slopes[1]):
        return False
    if (slopes[2] * z - y) > r * np.sqrt(1 + slopes[2] * slopes[2]):
        return False
    return (y - slopes[3] * z) <= r * np.sqrt(1 + slopes[3] * slopes[3])


@njit(cache=True, nogil=True)
def view_slopes(intrinsics: np.ndarray, width: int, height: int) -> np.ndarray:
    """The four side planes of the view, one pixel wider than the image. intrinsics: fx, fy, cx, cy."""
    slopes = np.empty(4, np.float32)
    slopes[0] = (-1.5 - intrinsics[2]) / intrinsics[0]
    slopes[1] = (width + 0.5 - intrinsics[2]) / intrinsics[0]
    slopes[2] = (-1.5 - intrinsics[3]) / intrinsics[1]
    slopes[3] = (height + 0.5 - intrinsics[3]) / intrinsics[1]
    return slopes


@njit(cache=True, nogil=True, error_model="numpy")
def _project(
    points: np.ndarray,
    first: int,
    pose: np.ndarray,
    intrinsics: np.ndarray,
    width: int,
    height: int,
    u: np.ndarray,
    v: np.ndarray,
    depth: np.ndarray,
) -> None:
    """Writes where points from `first` on are in the image, without branches; depth -1: not in it. See `in_view`."""
    one, half, out = np.float32(1.0), np.float32(0.5), np.float32(-1.0)
    right, bottom = np.float32(width) - half, np.float32(height) - half
    r00, r01, r02 = pose[0, 0], pose[0, 1], pose[0, 2]
    r10, r11, r12 = pose[1, 0], pose[1, 1], pose[1, 2]
    r20, r21, r22 = pose[2, 0], pose[2, 1], pose[2, 2]
    tx, ty, tz = pose[0, 3], pose[1, 3], pose[2, 3]
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
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


@njit(cache=True, nogil=True)
def view_buffers() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Room for what `in_view` writes about one run of points: u, v, depth float32 and which int64, (RUN,) each."""
    floats = np.empty((3, RUN), np.float32)
    return floats[0], floats[1], floats[2], np.empty(RUN, np.int64)


@njit(cache=True, nogil=True)
def in_view(
    points: np.ndarray,
    first: int,
    stop: int,
    pose: np.ndarray,
    intrinsics: np.ndarray,
    width: int,
    height: int,
    u: np.ndarray,
    v: np.ndarray,
    depth: np.ndarray,
    which: np.ndarray,
) -> int:
    """How many of the points [first : stop], RUN at most, the image shows; `which` starts with them, in order.

    points: (3, M) float32, world; pose: (3, 4) float32, rows of camera_from_world's rotation and the camera center;
    u, v, depth: float32, px and m, of all points of the run, and which: int64, counted from `first`, out
    """
    count = min(RUN, stop - first)
    _project(points, first, pose, intrinsics, width, height, u[:count], v[:count], depth[:count])
    seen = 0
    for k in range(count):
        which[seen] = k
        seen += depth[k] >= 0
    return seen


@njit(cache=True, nogil=True, error_model="numpy")
def splat(
    points: np.ndarray,
    source: np.ndarray,
    start: np.ndarray,
    spheres: np.ndarray,
    pose: np.ndarray,
    intrinsics: np.ndarray,
    image: int,
    guard: int,
    radius: int,
    height: int,
    width: int,
) -> np.ndarray:
    """What each pixel of one image sees, of all points and of those of other images: entries (2, H, W) int64.

    points: (3, M) float32, m, world; source: (M,) int32, image that colored the point; start, spheres: blocks;
    pose: (3, 4) float32, rows of camera_from_world's rotation and the camera center; intrinsics: fx, fy, cx, cy
    float32; guard: points whose source is within `guard` of the image are left out of variant 1; radius: half a
    splat, px. Entry: depth in 2^-20 m << 32 | index of the point; EMPTY where there is none.
    """
    # both variants side by side: they nearly always touch the same line of memory
    nearest = np.full((height, width, 2), EMPTY, np.int64)
    slopes = view_slopes(intrinsics, width, height)
    half = np.float32(0.5)
    u, v, depth, which = view_buffers()
    for b in range(start.shape[0] - 1):
        if not sphere_in_view(spheres[b], pose, slopes):
            continue
        for first in range(start[b], start[b + 1], RUN):
            seen = in_view(points, first, start[b + 1], pose, intrinsics, width, height, u, v, depth, which)
            for k in which[:seen]:
                column, row = int(u[k] + half), int(v[k] + half)
                entry = (np.int64(min(depth[k], FAR_M) * STEPS) << 32) | (first + k)
                # stores without branches: which point is nearer cannot be predicted
                other = entry if abs(source[first + k] - image) > guard else EMPTY
                nearest[row, column, 0] = min(nearest[row, column, 0], entry)
                nearest[row, column, 1] = min(nearest[row, column, 1], other)
    out = np.empty((2, height, width), np.int64)
    for variant in range(2):
        _spread(nearest[:, :, variant], radius, out[variant])
    return out


@njit(cache=True, nogil=True)
def _spread(entries: np.ndarray, radius: int, out: np.ndarray) -> None:
    """Every pixel takes the least entry within `radius` pixels (a square), as if each point were that large."""
    height, width = entries.shape
    across = np.empty((height, width), np.int64)
    line = np.full(width + 2 * radius, EMPTY, np.int64)
    for row in range(height):
        for column in range(width):
            line[column + radius] = entries[row, column]
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


@njit(cache=True, nogil=True)
def fill(entries: np.ndarray, radius: int) -> np.ndarray:
    """The entries (2, H, W), where empty those of the nearest point (in depth) within `radius` pixels."""
    out = np.empty_like(entries)
    for variant in range(2):
        _spread(entries[variant], radius, out[variant])
        for row in range(entries.shape[1]):
            for column in range(entries.shape[2]):
                if entries[variant, row, column] != EMPTY:
                    out[variant, row, column] = entries[variant, row, column]
    return out


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
def nearest_entries(
    points: np.ndarray,
    start: np.ndarray,
    spheres: np.ndarray,
    pose: np.ndarray,
    intrinsics: np.ndarray,
    cell: int,
    height: int,
    width: int,
) -> np.ndarray:
    """The nearest point in each cell of `cell` pixels of one image, (h, w) int64; EMPTY where there is none.

    An entry is the depth in steps, shifted left by 32 bits, and the index: of points in the same step the one with the
    lower index counts.
    points: (3, M) float32, world, in blocks; start, spheres: the blocks; pose: (3, 4) float32
    """
    nearest = np.full(((height + cell - 1) // cell, (width + cell - 1) // cell), EMPTY, np.int64)
    slopes = view_slopes(intrinsics, width, height)
    half = np.float32(0.5)
    cell_of = np.arange(max(height, width)) // cell
    u, v, depth, which = view_buffers()
    for b in range(start.shape[0] - 1):
        if not sphere_in_view(spheres[b], pose, slopes):
            continue
        for first in range(start[b], start[b + 1], RUN):
            seen = in_view(points, first, start[b + 1], pose, intrinsics, width, height, u, v, depth, which)
            for k in which[:seen]:
                row, column = cell_of[int(v[k] + half)], cell_of[int(u[k] + half)]
                entry = (np.int64(min(depth[k], FAR_M) * STEPS) << 32) | (first + k)
                nearest[row, column] = min(nearest[row, column], entry)
    return nearest


@njit(cache=True, nogil=True, parallel=True, error_model="numpy")
def seen_depths(
    points: np.ndarray,
    start: np.ndarray,
    spheres: np.ndarray,
    poses: np.ndarray,
    intrinsics: np.ndarray,
    cell: int,
    height: int,
    width: int,
) -> np.ndarray:
    """How deep each image sees in each cell of `cell` pixels: depth (B, h, w) float32, m, inf where nothing is near.

    That is the depth of the cell's nearest point, plus what a surface that runs on through the cells on both sides
    gains within this one; or the depth of a neighbor where that stands in front of this cell without such a surface:
    colors next to the edge of something nearer are not to be trusted.
    """
    rows, columns = (height + cell - 1) // cell, (width + cell - 1) // cell
    out = np.empty((poses.shape[0], rows, columns), np.float32)
    for image in prange(poses.shape[0]):
        nearest = nearest_entries(points, start, spheres, poses[image], intrinsics, cell, height, width)
        inverse = np.zeros((rows + 2, columns + 2), np.float32)
        for row in range(rows):
            for column in range(columns):
                if nearest[row, column] != EMPTY:
                    inverse[row + 1, column + 1] = STEPS / np.float32(nearest[row, column] >> 32)
        for row in range(rows):
            for column in range(columns):
                out[image, row, column] = _seen_depth(inverse, row + 1, column + 1)
    return out


@njit(cache=True, nogil=True)
def shade(
    entries: np.ndarray,
    gray: np.ndarray,
    source: np.ndarray,
    ratio: np.ndarray,
    first: int,
    color: np.ndarray,
    covered: np.ndarray,
) -> None:
    """Writes the colors (2, H, W, 3) float32, 0..255, and whether anything is seen (2, H, W) bool.

    entries: (2, H, W) int64; gray: (M, 3) float32, gray values in the source image; source: (M,) int32; ratio: (I,)
    float32, relative exposure of this image over that of each source. Clipped at 255, as the sensor does. first: 1 if the
    first picture's colors are not wanted, and are not written; else 0
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
                    for c in range(3):
                        color[variant, row, column, c] = min(gray[i, c] * ratio[source[i]], np.float32(255.0))
