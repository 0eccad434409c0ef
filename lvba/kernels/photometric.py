"""Sums of the photometric cost over warped patches: the inner loop of the visual bundle adjustment.

A scene point is a plane patch tied to whole pixels of its reference image. Its warp into a target image is the plane
homography (`lvba.kernels.homography`). The residual of a pixel pair is
`rho = (eps_r I_t - eps_t I_r) / sqrt(eps_r^2 + eps_t^2)`.

Per observation only sums over its pixels leave the inner loop; the 2 x 12 Jacobian of the patch centre is applied
to them once, in `assemble`. Every loop over threads owns its outputs: the bytes do not depend on the thread count.
"""

from typing import NamedTuple

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import prange, types
from numba.extending import intrinsic

from lvba.kernels.compiled import kernel, parallel_kernel
from lvba.kernels.homography import (
    center_jacobian,
    patch_warp,
    plane_in_reference,
    relative_pose,
    shift_warp,
    warp_bounds,
)
from lvba.kernels.scene import Intrinsics, PlanePatches

XX, XY, YY, XQ, YQ, QQ, XR, YR, QR, COST, COUNT, SQUARE, WEIGHTS = range(13)
"""Columns of the sums of an observation: products of x, y (weighted image gradient), q (derivative by log exposure) and r
(residual); then robust cost, valid samples, sum of r^2, sum of robust weights."""
SUMS = 13
"""How many columns there are."""
OFFSET = 14
"""Column of the plane's offset among the 15 unknowns of an observation: rotation, translation and log exposure of its
reference (0 to 6), the same of its target (7 to 13), offset of its point's plane along the normal."""


class Intensities(NamedTuple):
    """Which pixels count, and how much. float32.

    least, greatest: usable intensity; growth: of the noise variance per intensity, 0: constant
    """

    least: np.float32
    greatest: np.float32
    growth: np.float32


class ImagePairs(NamedTuple):
    """Observations by pair of images: pair m owns order[starts[m]] to order[starts[m + 1]].

    order: (O,) int64, observations; starts: (M + 1,) int64; reference, target: (M,) int32, images
    """

    order: np.ndarray
    starts: np.ndarray
    reference: np.ndarray
    target: np.ndarray


class _Pixels(NamedTuple):
    """All images. data: (N,) uint8, C-contiguous; row_bytes, channels: bytes of a row and of a pixel"""

    data: np.ndarray
    row_bytes: int
    channels: int


class _Room(NamedTuple):
    """Where the reference patch of each of C channels is put.

    patch: (C, N) float32, gray values; lane: (C, N) float32, 1 for usable pixels, 0 for others
    """

    patch: np.ndarray
    lane: np.ndarray


class _Grid(NamedTuple):
    """Pixels of a patch, padded with zeros to whole vectors. i, j: (N,) float32, offsets to the right and down"""

    i: np.ndarray
    j: np.ndarray


class _Mix(NamedTuple):
    """Exposure of reference and target over `sqrt(eps_r^2 + eps_t^2)`, float32."""

    reference: np.float32
    target: np.float32


_CHUNK = 32
_LANES = 16

# Sums of 49 to 121 float32 terms: reassociation lets LLVM keep 16 partial sums and vectorize, which is 5 times as
# fast and, with pairwise partial sums, at least as accurate. The order is fixed at compile time, whatever the threads.
_VECTOR = {"reassoc", "contract", "nsz", "arcp"}


@intrinsic
def _load_word(typingctx, array, offset):  # type: ignore[no-untyped-def]
    """Four bytes of a contiguous uint8 array from a byte offset, as uint32, little-endian.

    One gather instead of two: both horizontal neighbours of a bilinear sample come in one word.
    """

    def codegen(context, builder, signature, args):  # type: ignore[no-untyped-def]
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        pointer = builder.gep(builder.bitcast(data, ir.IntType(8).as_pointer()), [args[1]])
        return builder.load(builder.bitcast(pointer, ir.IntType(32).as_pointer()), align=1)

    return types.uint32(array, offset), codegen


@kernel
def samples_inside(bounds: tuple[float, float, float, float], width: int, height: int) -> bool:
    """Whether all samples of a patch can be read: four pixels each, two at a time by `_load_word`, which reads up to
    three bytes beyond them. Hence the margin on the right.

    bounds: least and greatest column and row of `warp_bounds`; NaN is outside
    """
    low_x, high_x, low_y, high_y = bounds
    return low_x >= 0.0 and low_y >= 0.0 and high_x < width - 4 and high_y < height - 2


@kernel(fastmath=_VECTOR)
def _patch_sums(
    pixels: _Pixels,
    base: int,
    warp: np.ndarray,
    grid: _Grid,
    patch: np.ndarray,
    lane: np.ndarray,
    mix: _Mix,
    huber: np.float32,
    usable: Intensities,
    sums: np.ndarray,
) -> None:
    """Adds the sums over one patch and channel to `sums`; the loop that takes the time.

    warp: (8,) float32, relative to the pixel at byte `base`, so that all coordinates are positive and small;
    all of the patch is inside the image (`samples_inside`). patch, lane: of `_load_patch`
    """
    image, i, j = pixels.data, grid.i, grid.j
    low, high, growth = usable.least, usable.greatest, usable.growth
    w0, w1, w2, w3, w4, w5, w6, w7 = warp[0], warp[1], warp[2], warp[3], warp[4], warp[5], warp[6], warp[7]
    one, half, zero = np.float32(1), np.float32(0.5), np.float32(0)
    byte, shift = np.uint32(255), np.uint32(8 * pixels.channels)
    stride, width = np.int32(pixels.row_bytes), np.int32(pixels.channels)
    c, s = mix.reference, mix.target
    cs = c * s
    xx = xy = yy = xq = yq = qq = xr = yr = qr = cost = count = square = weights = zero
    for n in range(i.size):
        scale = one / (one + w6 * i[n] + w7 * j[n])
        x = (w0 * i[n] + w1 * j[n] + w2) * scale
        y = (w3 * i[n] + w4 * j[n] + w5) * scale
        column, row = np.int32(x), np.int32(y)
        ax, ay = x - np.float32(column), y - np.float32(row)
        at = base + np.int64(row * stride + column * width)
        upper: np.uint32 = _load_word(image, at)  # type: ignore[call-arg]
        lower: np.uint32 = _load_word(image, at + pixels.row_bytes)
        i00 = np.float32(np.int32(upper & byte))
        i10 = np.float32(np.int32((upper >> shift) & byte))
        i01 = np.float32(np.int32(lower & byte))
        i11 = np.float32(np.int32((lower >> shift) & byte))
        top_slope, bottom_slope = i10 - i00, i11 - i01
        top, bottom = i00 + ax * top_slope, i01 + ax * bottom_slope
        seen = top + ay * (bottom - top)
        wanted = patch[n]
        inside = max(max(i00, i10), max(i01, i11)) <= high and min(min(i00, i10), min(i01, i11)) >= low
        valid = lane[n] if inside else zero
        noise = one
        if growth > zero:
            noise = one / np.sqrt(one + growth * (c * c * seen + s * s * wanted))
        gx = noise * c * (top_slope + ay * (bottom_slope - top_slope))
        gy = noise * c * (bottom - top)
        r = noise * (c * seen - s * wanted)
        q = -noise * (s * seen + c * wanted) * cs
        size = abs(r)
        clipped = min(size, huber)
        weight = valid * (huber / max(size, huber))
        cost += valid * clipped * (size - half * clipped)
        count += valid
        square += valid * r * r
        weights += weight
        wx, wy, wq = weight * gx, weight * gy, weight * q
        xx += wx * gx
        xy += wx * gy
        yy += wy * gy
        xq += wx * q
        yq += wy * q
        qq += wq * q
        xr += wx * r
        yr += wy * r
        qr += wq * r
    for n, value in enumerate((xx, xy, yy, xq, yq, qq, xr, yr, qr, cost, count, square, weights)):
        sums[n] += value


@kernel
def _load_patch(
    pixels: _Pixels, base: int, radius: int, usable: Intensities, patch: np.ndarray, lane: np.ndarray
) -> None:
    """Fills the reference patch as float32, and in `lane` 1 for its usable pixels; the padding stays 0."""
    n = 0
    for j in range(-radius, radius + 1):
        for i in range(-radius, radius + 1):
            value = np.float32(pixels.data[base + j * pixels.row_bytes + i * pixels.channels])
            patch[n] = value
            lane[n] = np.float32(1) if usable.least <= value <= usable.greatest else np.float32(0)
            n += 1


@kernel
def _grid(radius: int) -> _Grid:
    """The pixels of a patch."""
    side = 2 * radius + 1
    padded = -(-side * side // _LANES) * _LANES
    i, j = np.zeros(padded, np.float32), np.zeros(padded, np.float32)
    for n in range(side * side):
        i[n], j[n] = n % side - radius, n // side - radius
    return _Grid(i, j)


@kernel
def _move_warp(warp: np.ndarray, left: float, top: float, local: np.ndarray) -> None:
    """Fills local (8,) float32: the warp with its target pixels counted from (left, top)."""
    for n in range(8):
        local[n] = warp[n]
    local[0], local[1], local[2] = warp[0] - left * warp[6], warp[1] - left * warp[7], warp[2] - left
    local[3], local[4], local[5] = warp[3] - top * warp[6], warp[4] - top * warp[7], warp[5] - top


@kernel
def _point_sums(
    point: int,
    images: np.ndarray,
    poses: np.ndarray,
    exposure: np.ndarray,
    intrinsics: Intrinsics,
    patches: PlanePatches,
    first: int,
    target: np.ndarray,
    radius: int,
    huber: np.ndarray,
    usable: Intensities,
    grid: _Grid,
    shift: np.ndarray,
    room: _Room,
    sums: np.ndarray,
) -> None:
    """Fills the sums of all observations of one scene point: number `first` and those after it, of images `target`.

    shift: of all observations, see `evaluate`; room: for the reference patch of each channel
    """
    height, width, channels = images.shape[1], images.shape[2], images.shape[3]
    row_bytes = width * channels
    pixels = _Pixels(images.reshape(-1), row_bytes, channels)
    relative, offset, plane, ray = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    warp, local = np.empty(8), np.empty(8, np.float32)
    r, u, v = patches.reference[point], patches.pixel[point, 0], patches.pixel[point, 1]
    if u < radius or v < radius or u + radius >= width or v + radius >= height:
        return
    for channel in range(channels):
        base = np.int64(r) * height * row_bytes + v * row_bytes + u * channels + channel
        _load_patch(pixels, base, radius, usable, room.patch[channel], room.lane[channel])
    plane_in_reference(poses[r], patches.position[point], patches.normal[point], plane)
    ray[0], ray[1], ray[2] = (u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy, 1.0
    for n in range(len(target)):
        o, t = first + n, target[n]
        relative_pose(poses, r, t, relative, offset)
        if not patch_warp(relative, offset, plane, ray, intrinsics, warp) > 0.0:
            continue
        if len(shift):
            shift_warp(warp, shift[o])
        bounds = warp_bounds(warp, radius)
        if not samples_inside(bounds, width, height):
            continue
        left, top = np.floor(bounds[0]), np.floor(bounds[2])
        _move_warp(warp, left, top, local)
        norm = np.sqrt(exposure[r] ** 2 + exposure[t] ** 2)
        mix = _Mix(np.float32(exposure[r] / norm), np.float32(exposure[t] / norm))
        limit = np.float32(huber[o])
        for channel in range(channels):
            base = (
                np.int64(t) * height * row_bytes
                + np.int64(top) * row_bytes
                + np.int64(left) * channels
                + channel
            )
            _patch_sums(
                pixels,
                base,
                local,
                grid,
                room.patch[channel],
                room.lane[channel],
                mix,
                limit,
                usable,
                sums[o],
            )


@parallel_kernel
def evaluate(
    images: np.ndarray,
    poses: np.ndarray,
    exposure: np.ndarray,
    intrinsics: Intrinsics,
    patches: PlanePatches,
    starts: np.ndarray,
    target: np.ndarray,
    radius: int,
    huber: np.ndarray,
    usable: Intensities,
    shift: np.ndarray,
) -> np.ndarray:
    """The sums of every observation, (O, SUMS) float64; zeros where the warped patch leaves the target image.

    images: (I, H, W, C) uint8, contiguous, one pyramid level
    poses: (I, 4, 4) float64, world_from_camera; exposure: (I,) float64, eps; intrinsics: of the level
    starts: (P + 1,) int64, point p owns observations starts[p] to starts[p + 1]; target: (O,) int32, images
    radius: patch side is 2 radius + 1, px
    huber: (O,) float64, intensity, residuals beyond it count linearly
    shift: (O, 2) float64, px, what is added to the target pixels of each patch; (0, 2): nothing
    """
    points = len(patches.reference)
    sums = np.zeros((len(target), SUMS))
    chunks = -(-points // _CHUNK)
    for chunk in prange(chunks):
        grid = _grid(radius)
        room = _Room(
            np.zeros((images.shape[3], grid.i.size), np.float32),
            np.zeros((images.shape[3], grid.i.size), np.float32),
        )
        for point in range(chunk * _CHUNK, min(points, (chunk + 1) * _CHUNK)):
            first = starts[point]
            _point_sums(
                point, images, poses, exposure, intrinsics, patches, first,
                target[first : starts[point + 1]], radius, huber, usable, grid, shift, room, sums,
            )  # fmt: skip
    return sums


@kernel
def observation_jacobian(
    pose: np.ndarray,
    intrinsics: Intrinsics,
    patches: PlanePatches,
    point: int,
    relative: np.ndarray,
    offset: np.ndarray,
    jacobian: np.ndarray,
) -> None:
    """Fills (3, 15): target pixel (x, y) and log exposure difference by the 7 unknowns of reference and target, and
    by the offset of the plane.

    pose: (4, 4) float64, world_from_camera of the reference; point: number of the patch; relative: (3, 3) float64 and
    offset: (3,) float64 of `relative_pose`; jacobian: (3, 15) float64, out
    """
    plane, ray, by_poses = np.empty(3), np.empty(3), np.empty((2, 13))
    distance = plane_in_reference(pose, patches.position[point], patches.normal[point], plane)
    u, v = patches.pixel[point, 0], patches.pixel[point, 1]
    ray[0], ray[1], ray[2] = (u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy, 1.0
    center_jacobian(relative, offset, plane, distance, ray, intrinsics, by_poses)
    for axis in range(2):
        for n in range(6):
            jacobian[axis, n] = by_poses[axis, n]
            jacobian[axis, 7 + n] = by_poses[axis, 6 + n]
        jacobian[axis, 6] = jacobian[axis, 13] = 0.0
        jacobian[axis, OFFSET] = by_poses[axis, 12]
    for n in range(15):
        jacobian[2, n] = 0.0
    jacobian[2, 6], jacobian[2, 13] = -1.0, 1.0


@parallel_kernel
def assemble(
    sums: np.ndarray,
    weights: np.ndarray,
    image_pairs: ImagePairs,
    point: np.ndarray,
    poses: np.ndarray,
    intrinsics: Intrinsics,
    patches: PlanePatches,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Normal-equation blocks (M, 14, 14) and gradient (M, 14) of every image pair, and of every observation its
    gradient (O, 15) and the Hessian's row (O, 15) of the plane's offset.

    The 15 unknowns are `[rotation | translation | log exposure]` of the reference, then of the target, then the offset
    of the point's plane along its normal.

    sums: (O, SUMS) float64 of `evaluate`; weights: (O,) float64, one factor per observation
    point: (O,) int32, of each observation; poses: (I, 4, 4) float64, world_from_camera
    """
    pairs = len(image_pairs.reference)
    hessian, gradient = np.zeros((pairs, 14, 14)), np.zeros((pairs, 14))
    single, coupling = np.zeros((len(point), 15)), np.zeros((len(point), 15))
    for m in prange(pairs):
        relative, offset = np.empty((3, 3)), np.empty(3)
        jacobian, weighted = np.empty((3, 15)), np.empty((3, 15))
        r, t = image_pairs.reference[m], image_pairs.target[m]
        relative_pose(poses, r, t, relative, offset)
        for n in range(image_pairs.starts[m], image_pairs.starts[m + 1]):
            o = image_pairs.order[n]
            if sums[o, COUNT] == 0.0:
                continue
            observation_jacobian(poses[r], intrinsics, patches, point[o], relative, offset, jacobian)
            w = weights[o]
            xx, xy, yy = w * sums[o, XX], w * sums[o, XY], w * sums[o, YY]
            xq, yq, qq = w * sums[o, XQ], w * sums[o, YQ], w * sums[o, QQ]
            xr, yr, qr = w * sums[o, XR], w * sums[o, YR], w * sums[o, QR]
            for k in range(15):
                jx, jy, jq = jacobian[0, k], jacobian[1, k], jacobian[2, k]
                weighted[0, k] = xx * jx + xy * jy + xq * jq
                weighted[1, k] = xy * jx + yy * jy + yq * jq
                weighted[2, k] = xq * jx + yq * jy + qq * jq
                single[o, k] = xr * jx + yr * jy + qr * jq
            ox, oy = jacobian[0, OFFSET], jacobian[1, OFFSET]
            for k in range(15):
                coupling[o, k] = ox * weighted[0, k] + oy * weighted[1, k]
            for k in range(14):
                jx, jy, jq = jacobian[0, k], jacobian[1, k], jacobian[2, k]
                gradient[m, k] += single[o, k]
                for c in range(14):
                    hessian[m, k, c] += jx * weighted[0, c] + jy * weighted[1, c] + jq * weighted[2, c]
    return hessian, gradient, single, coupling
