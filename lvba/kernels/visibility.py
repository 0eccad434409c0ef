"""Which cameras see a patch: the gates of eq. (3) on warped patches, and the voxel map of who saw what."""

import math
from typing import NamedTuple

import numpy as np
from numba import prange

from lvba.kernels.compiled import kernel, parallel_kernel
from lvba.kernels.homography import plane_homography
from lvba.kernels.scene import Intrinsics, NearestPoints, PlanePatches
from lvba.kernels.visibility_depth import patch_hidden

PASSED, BEHIND, OUTSIDE, SLANTED, SCALED, HIDDEN, MASKED, UNLIKE = 0, 1, 2, 3, 4, 5, 6, 7
"""What became of a pair: passed, or the first gate that it failed."""


class PairGates(NamedTuple):
    """What a pair must pass, in this order; Li et al., eq. (3), and ours.

    min_view_cosine: of the target's axis and the direction to the point; min_normal_cosine: of either direction of view
    and the normal; min_scale, max_scale: target px per reference px
    dark, bright: grey values up to the one and from the other on are masked; min_usable: least part that is not
    contrast_floor: grey values^2, least variance of a patch; noise: grey values^2, variance of the images' noise
    hiding: m, see `visibility_depth.hiding_depth`; half: px, of the patch
    """

    half: int
    min_view_cosine: float
    min_normal_cosine: float
    min_scale: float
    max_scale: float
    min_ncc: float
    contrast_floor: float
    dark: float
    bright: float
    min_usable: float
    hiding: float
    noise: float


@kernel
def warp(h: np.ndarray, u: float, v: float) -> tuple[float, float, float]:
    """Pixel (u, v) moved by h, and the third homogeneous component.

    h: (3, 3) float64, of `plane_homography`
    """
    w = h[2, 0] * u + h[2, 1] * v + h[2, 2]
    if w == 0:
        return 0.0, 0.0, 0.0
    return (h[0, 0] * u + h[0, 1] * v + h[0, 2]) / w, (h[1, 0] * u + h[1, 1] * v + h[1, 2]) / w, w


@kernel
def local_scale(h: np.ndarray, u: float, v: float) -> tuple[float, float]:
    """The singular values (small, large) of the warp's Jacobian at (u, v): target px per reference px.

    h: (3, 3) float64, of `plane_homography`
    """
    x, y, w = warp(h, u, v)
    a, b = (h[0, 0] - x * h[2, 0]) / w, (h[0, 1] - x * h[2, 1]) / w
    c, d = (h[1, 0] - y * h[2, 0]) / w, (h[1, 1] - y * h[2, 1]) / w
    total, area = a * a + b * b + c * c + d * d, abs(a * d - b * c)
    plus, minus = math.sqrt(total + 2 * area), math.sqrt(max(total - 2 * area, 0.0))
    return (plus - minus) / 2, (plus + minus) / 2


@kernel
def patch_inside(h: np.ndarray, u: int, v: int, half: int, width: int, height: int) -> int:
    """PASSED where all four corners of the patch land inside the image and in front; else BEHIND or OUTSIDE.

    h: (3, 3) float64, of `plane_homography`; width, height: px
    """
    for i in range(-1, 2, 2):
        for j in range(-1, 2, 2):
            x, y, w = warp(h, u + j * half, v + i * half)
            if w <= 0:
                return BEHIND
            if not (0 <= x <= width - 1.001 and 0 <= y <= height - 1.001):
                return OUTSIDE
    return PASSED


@kernel
def warp_row(h: np.ndarray, u: int, v: int, half: int, xs: np.ndarray, ys: np.ndarray) -> None:
    """Fill xs, ys (N,) with where the pixels (u - half ... u + half, v) land.

    h: (3, 3) float64, of `plane_homography`; xs: (N,) float64, px; ys: (N,) float64, px
    """
    x, y, w = h[0, 1] * v + h[0, 2], h[1, 1] * v + h[1, 2], h[2, 1] * v + h[2, 2]
    for j in range(2 * half + 1):
        column = u - half + j
        scale = 1.0 / (h[2, 0] * column + w)
        xs[j] = (h[0, 0] * column + x) * scale
        ys[j] = (h[1, 0] * column + y) * scale


@kernel
def correlation(
    reference: np.ndarray,
    target: np.ndarray,
    h: np.ndarray,
    u: int,
    v: int,
    gates: PairGates,
) -> tuple[float, float]:
    """(NCC, usable part of the patch): means removed per channel, channels stacked.

    What white noise of variance `gates.noise` adds to the variances is taken off, else faint texture could never agree
    with itself; they are not below `contrast_floor` then. The NCC of faint patches may pass 1.

    reference, target: (H, W, C) uint8; masked pixels are skipped, as is a target sample any of whose four neighbours is;
    h: (3, 3) float64, pixels of the one to those of the other; u, v: pixel of the reference
    """
    half, dark, bright = gates.half, gates.dark, gates.bright
    size, channels = 2 * half + 1, reference.shape[2]
    sums = np.zeros((channels, 5))
    count, kept = 0, 0.0
    values, xs, ys = np.empty((channels, 2)), np.empty(size), np.empty(size)
    for i in range(-half, half + 1):
        warp_row(h, u, v + i, half, xs, ys)
        for j in range(size):
            x0, y0 = int(xs[j]), int(ys[j])
            fx, fy = xs[j] - x0, ys[j] - y0
            good = True
            for c in range(channels):
                a = float(reference[v + i, u - half + j, c])
                p, q = float(target[y0, x0, c]), float(target[y0, x0 + 1, c])
                r, s = float(target[y0 + 1, x0, c]), float(target[y0 + 1, x0 + 1, c])
                low, high = min(min(p, q), min(r, s)), max(max(p, q), max(r, s))
                good = good and dark < min(a, low) and max(a, high) < bright
                top, bottom = p + fx * (q - p), r + fx * (s - r)
                values[c, 0] = a
                values[c, 1] = top + fy * (bottom - top)
            if not good:
                continue
            count += 1
            # a bilinear sample averages noise
            kept += ((1 - fx) ** 2 + fx**2) * ((1 - fy) ** 2 + fy**2)
            for c in range(channels):
                a, b = values[c, 0], values[c, 1]
                sums[c, 0] += a
                sums[c, 1] += b
                sums[c, 2] += a * a
                sums[c, 3] += b * b
                sums[c, 4] += a * b
    if count < 2:
        return 0.0, 0.0
    first, second, cross = 0.0, 0.0, 0.0
    for c in range(channels):
        first += (sums[c, 2] - sums[c, 0] * sums[c, 0] / count) / count
        second += (sums[c, 3] - sums[c, 1] * sums[c, 1] / count) / count
        cross += (sums[c, 4] - sums[c, 0] * sums[c, 1] / count) / count
    first = max(first - gates.noise * channels, gates.contrast_floor * channels)
    second = max(second - gates.noise * channels * kept / count, gates.contrast_floor * channels)
    ncc = cross / math.sqrt(first * second)
    return ncc, count / float(size**2)


@kernel
def view_cosines(pose: np.ndarray, position: np.ndarray, normal: np.ndarray) -> tuple[float, float]:
    """(d . z_C, -d . n) of a camera and a point: the second is negative from behind the plane.

    Eq. (3) has |d . n|; but a thin wall has two sides, and a camera in the next room sees the other one.
    pose: (4, 4) float64, world_from_camera; position: (3,) float64, m, and normal: (3,) float64, unit, world
    """
    along, slant, square = 0.0, 0.0, 0.0
    for a in range(3):
        d = position[a] - pose[a, 3]
        along += d * pose[a, 2]
        slant += d * normal[a]
        square += d * d
    length = math.sqrt(square)
    return along / length, -slant / length


@kernel
def judge(
    images: np.ndarray,
    poses: np.ndarray,
    intrinsics: Intrinsics,
    patches: PlanePatches,
    point: int,
    target: int,
    gates: PairGates,
    nearest: NearestPoints,
    shift: np.ndarray,
) -> tuple[int, float]:
    """The verdict on one pair and its NCC (0 where it came not that far); arguments as in `judge_pairs`.

    images, poses: as in `judge_pairs`; shift: (2,) float64, px, what is added to target pixels; (0,): nothing
    """
    height, width, half = images.shape[1], images.shape[2], gates.half
    position, normal, reference = patches.position[point], patches.normal[point], patches.reference[point]
    u, v = patches.pixel[point, 0], patches.pixel[point, 1]
    along, slant = view_cosines(poses[target], position, normal)
    if not along > gates.min_view_cosine:
        return BEHIND, 0.0
    own_slant = view_cosines(poses[reference], position, normal)[1]
    if not (slant > gates.min_normal_cosine and own_slant > gates.min_normal_cosine):
        return SLANTED, 0.0
    h = plane_homography(poses, reference, target, position, normal, intrinsics)
    if len(shift):
        for column in range(3):
            h[0, column] += shift[0] * h[2, column]
            h[1, column] += shift[1] * h[2, column]
    inside = patch_inside(h, u, v, half, width, height)
    if inside != PASSED:
        return inside, 0.0
    small, large = local_scale(h, float(u), float(v))
    if small < gates.min_scale or large > gates.max_scale:
        return SCALED, 0.0
    if len(nearest.nearest):
        depth = 0.0
        for a in range(3):
            depth += poses[reference, a, 2] * (position[a] - poses[reference, a, 3])
        if patch_hidden(nearest, target, poses[target], h, u, v, half, depth, position, normal, gates.hiding):
            return HIDDEN, 0.0
    ncc, usable = correlation(images[reference], images[target], h, u, v, gates)
    if usable < gates.min_usable:
        return MASKED, ncc
    return (PASSED if ncc > gates.min_ncc else UNLIKE), ncc


@parallel_kernel
def judge_pairs(
    images: np.ndarray,
    poses: np.ndarray,
    intrinsics: Intrinsics,
    patches: PlanePatches,
    point: np.ndarray,
    target: np.ndarray,
    gates: PairGates,
    nearest: NearestPoints,
    shift: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Which pairs of a scene point and a target pass eq. (3): verdict (O,) uint8 and NCC (O,) float32.

    images: (I, H, W, C) uint8; poses: (I, 4, 4) float64, world_from_camera; point: (O,) int32, of the patches;
    target: (O,) int32, image; nearest: (0, 0, 0) cells skip that gate
    shift: (O, 2) float64, px, what is added to the target pixels of each pair; (0, 2): nothing
    """
    nothing = np.empty(0, np.float64)
    verdict = np.empty(len(point), np.uint8)
    ncc = np.empty(len(point), np.float32)
    for o in prange(len(point)):
        own = shift[o] if len(shift) else nothing
        verdict[o], ncc[o] = judge(
            images, poses, intrinsics, patches, point[o], target[o], gates, nearest, own
        )
    return verdict, ncc


@kernel
def voxel_key(x: float, y: float, z: float, size: float) -> int:
    """One int64 for the voxel of a point: 21 bits a coordinate, good for a million voxels either way."""
    i, j, k = math.floor(x / size), math.floor(y / size), math.floor(z / size)
    return ((i + 1048576) << 42) | ((j + 1048576) << 21) | (k + 1048576)


@parallel_kernel
def voxel_keys(points: np.ndarray, size: float) -> np.ndarray:
    """`voxel_key` of (N, 3) points, (N,) int64.

    points: (N, 3) float64, m; size: m, edge of a voxel
    """
    keys = np.empty(len(points), np.int64)
    for m in prange(len(points)):
        keys[m] = voxel_key(points[m, 0], points[m, 1], points[m, 2], size)
    return keys


@parallel_kernel
def scan_voxels(points: np.ndarray, offsets: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
    """The voxels of each scan, each once and ascending: keys (M,) int64 (only the first ones of a scan's range hold) and
    their number (S,) int64.

    points: (M, 3) float32, m; offsets: (S + 1,) int64, scan s owns points offsets[s] to offsets[s + 1]
    """
    keys = np.empty(len(points), np.int64)
    count = np.zeros(len(offsets) - 1, np.int64)
    for s in prange(len(offsets) - 1):
        start, stop = offsets[s], offsets[s]
        for m in range(start, offsets[s + 1]):
            key = voxel_key(points[m, 0], points[m, 1], points[m, 2], size)
            # neighbors in a scan often share their voxel: that leaves less to be sorted
            if stop == start or key != keys[stop - 1]:
                keys[stop] = key
                stop += 1
        keys[start:stop].sort()
        kept = 0
        for m in range(start, stop):
            if kept == 0 or keys[m] != keys[start + kept - 1]:
                keys[start + kept] = keys[m]
                kept += 1
        count[s] = kept
    return keys, count


@kernel
def cameras_of_voxel(
    scans: np.ndarray, scan_offsets: np.ndarray, scan_cameras: np.ndarray, marked: np.ndarray, out: np.ndarray
) -> int:
    """Collect into `out` the cameras of these scans, each once and ascending; their number. `marked` comes back zero.

    scans: (n,) int64; scan_offsets: (S + 1,) int64; scan_cameras: (C,) int32, cameras of every scan
    marked: (I,) bool, all False; out: (I,) int32
    """
    count = 0
    for s in scans:
        for o in range(scan_offsets[s], scan_offsets[s + 1]):
            camera = scan_cameras[o]
            if not marked[camera]:
                marked[camera] = True
                out[count] = camera
                count += 1
    for k in range(count):
        marked[out[k]] = False
    out[:count].sort()
    return count


@parallel_kernel
def voxel_cameras(
    offsets: np.ndarray, scans: np.ndarray, scan_offsets: np.ndarray, scan_cameras: np.ndarray, cameras: int
) -> tuple[np.ndarray, np.ndarray]:
    """The cameras of every voxel as compressed rows: offsets (V + 1,) int64, cameras int32, ascending in a row.

    offsets (V + 1,), scans: the scans of every voxel; scan_offsets (S + 1,), scan_cameras: the cameras of every scan
    scans: (n,) int64; scan_offsets: (S + 1,) int64; scan_cameras: (C,) int32
    """
    block = 256
    blocks = (len(offsets) - 1 + block - 1) // block
    row = np.zeros(len(offsets), np.int64)
    for b in prange(blocks):
        marked, out = np.zeros(cameras, np.bool_), np.empty(cameras, np.int32)
        for v in range(b * block, min((b + 1) * block, len(offsets) - 1)):
            row[v + 1] = cameras_of_voxel(
                scans[offsets[v] : offsets[v + 1]], scan_offsets, scan_cameras, marked, out
            )
    for v in range(len(offsets) - 1):
        row[v + 1] += row[v]
    seeing = np.empty(row[-1], np.int32)
    for b in prange(blocks):
        marked, out = np.zeros(cameras, np.bool_), np.empty(cameras, np.int32)
        for v in range(b * block, min((b + 1) * block, len(offsets) - 1)):
            count = cameras_of_voxel(
                scans[offsets[v] : offsets[v + 1]], scan_offsets, scan_cameras, marked, out
            )
            seeing[row[v] : row[v] + count] = out[:count]
    return row, seeing


@kernel
def keep_spread(group: np.ndarray, limit: int) -> np.ndarray:
    """(O,) bool: of every run of equal values in `group` (sorted), at most `limit`, evenly spread over the run.

    group: (O,) int32, ascending
    """
    keep = np.zeros(len(group), np.bool_)
    start = 0
    while start < len(group):
        stop = start
        while stop < len(group) and group[stop] == group[start]:
            stop += 1
        count = stop - start
        if count <= limit:
            keep[start:stop] = True
        else:
            for k in range(limit):
                keep[start + ((2 * k + 1) * count) // (2 * limit)] = True
        start = stop
    return keep
