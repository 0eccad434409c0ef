"""Sums of the photometric cost over warped patches: the inner loop of the visual bundle adjustment.

A scene point is a plane patch tied to whole pixels of its reference image. Its warp into a target image is the plane
homography (Li et al., eq. 7) divided by `n^T (p - t_r)`; with `rays m = K^-1 u`, `k = R_r^T n / (n^T (p - t_r))`,
`R = R_t^T R_r`, `a = R_t^T (t_r - t_t)`: `y = (R + a k^T) m`, and the third component of y is `z_t / z_r`.
The residual of a pixel pair is `rho = (eps_r I_t - eps_t I_r) / sqrt(eps_r^2 + eps_t^2)`.

Per observation only sums over its pixels leave the inner loop; the 2 x 12 Jacobian of the patch centre is applied
to them once, in `assemble`. Every loop over threads owns its outputs: the bytes do not depend on the thread count.
"""

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import njit, prange, types
from numba.extending import intrinsic

from lvba.kernels.homography import (
    center_jacobian,
    patch_warp,
    plane_in_reference,
    relative_pose,
    warp_bounds,
)

SUMS = 13
"""Columns of the sums of an observation, in this order (x, y: weighted image gradient; q: derivative by log exposure;
r: residual): xx xy yy xq yq qq xr yr qr, robust cost, valid samples, sum of r^2, sum of robust weights."""

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


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_VECTOR)
def _patch_sums(
    image: np.ndarray,
    base: int,
    row_bytes: int,
    channels: int,
    warp: np.ndarray,
    i: np.ndarray,
    j: np.ndarray,
    patch: np.ndarray,
    lane: np.ndarray,
    mix: np.ndarray,
    huber: float,
    low: float,
    high: float,
    growth: float,
    sums: np.ndarray,
) -> None:
    """Adds the sums over one patch and channel to `sums`; the loop that takes the time.

    warp: (8,) float32, relative to the pixel at byte `base`, so that all coordinates are positive and small
    mix: (2,) float32, eps_r / s and eps_t / s with s = sqrt(eps_r^2 + eps_t^2)
    """
    w0, w1, w2, w3, w4, w5, w6, w7 = warp[0], warp[1], warp[2], warp[3], warp[4], warp[5], warp[6], warp[7]
    one, half, zero = np.float32(1), np.float32(0.5), np.float32(0)
    byte, shift = np.uint32(255), np.uint32(8 * channels)
    stride, width = np.int32(row_bytes), np.int32(channels)
    c, s = mix[0], mix[1]
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
        lower: np.uint32 = _load_word(image, at + row_bytes)
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


@njit(cache=True, nogil=True)
def _load_patch(
    image: np.ndarray,
    base: int,
    row_bytes: int,
    channels: int,
    radius: int,
    low: float,
    high: float,
    patch: np.ndarray,
    lane: np.ndarray,
) -> None:
    """Fills the reference patch as float32, and in `lane` 1 for its usable pixels; the padding stays 0."""
    n = 0
    for j in range(-radius, radius + 1):
        for i in range(-radius, radius + 1):
            value = np.float32(image[base + j * row_bytes + i * channels])
            patch[n] = value
            lane[n] = np.float32(1) if low <= value <= high else np.float32(0)
            n += 1


@njit(cache=True, nogil=True)
def _offsets(radius: int) -> tuple[np.ndarray, np.ndarray]:
    """Pixel offsets (i, j) of a patch, padded with zeros to whole vectors."""
    side = 2 * radius + 1
    padded = -(-side * side // _LANES) * _LANES
    i, j = np.zeros(padded, np.float32), np.zeros(padded, np.float32)
    for n in range(side * side):
        i[n], j[n] = n % side - radius, n // side - radius
    return i, j


@njit(cache=True, nogil=True, error_model="numpy")
def _point_sums(
    point: int,
    images: np.ndarray,
    rotation: np.ndarray,
    translation: np.ndarray,
    exposure: np.ndarray,
    intrinsics: np.ndarray,
    position: np.ndarray,
    normal: np.ndarray,
    reference: np.ndarray,
    pixel: np.ndarray,
    starts: np.ndarray,
    target: np.ndarray,
    radius: int,
    huber: np.ndarray,
    limits: np.ndarray,
    i: np.ndarray,
    j: np.ndarray,
    patches: np.ndarray,
    lanes: np.ndarray,
    sums: np.ndarray,
) -> None:
    """Fills the sums of all observations of one scene point."""
    height, width, channels = images.shape[1], images.shape[2], images.shape[3]
    row_bytes = width * channels
    flat = images.reshape(-1)
    low, high, growth = limits[0], limits[1], limits[2]
    relative, offset, plane, ray = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    warp, local, mix = np.empty(8), np.empty(8, np.float32), np.empty(2, np.float32)
    r, u, v = reference[point], pixel[point, 0], pixel[point, 1]
    if u < radius or v < radius or u + radius >= width or v + radius >= height:
        return
    for channel in range(channels):
        base = np.int64(r) * height * row_bytes + v * row_bytes + u * channels + channel
        _load_patch(flat, base, row_bytes, channels, radius, low, high, patches[channel], lanes[channel])
    plane_in_reference(rotation, translation, r, position[point], normal[point], plane)
    ray[0], ray[1], ray[2] = (u - intrinsics[2]) / intrinsics[0], (v - intrinsics[3]) / intrinsics[1], 1.0
    for o in range(starts[point], starts[point + 1]):
        t = target[o]
        relative_pose(rotation, translation, r, t, relative, offset)
        if not patch_warp(relative, offset, plane, ray, intrinsics, warp) > 0.0:
            continue
        low_x, high_x, low_y, high_y = warp_bounds(warp, radius)
        # three bytes more than the sample needs are read with it, hence the margin on the right
        if not (low_x >= 0.0 and low_y >= 0.0 and high_x < width - 4 and high_y < height - 2):
            continue
        left, top = np.floor(low_x), np.floor(low_y)
        for n in range(8):
            local[n] = warp[n]
        local[0], local[1], local[2] = warp[0] - left * warp[6], warp[1] - left * warp[7], warp[2] - left
        local[3], local[4], local[5] = warp[3] - top * warp[6], warp[4] - top * warp[7], warp[5] - top
        norm = np.sqrt(exposure[r] ** 2 + exposure[t] ** 2)
        mix[0], mix[1] = exposure[r] / norm, exposure[t] / norm
        limit: float = np.float32(huber[o])
        for channel in range(channels):
            base = (
                np.int64(t) * height * row_bytes
                + np.int64(top) * row_bytes
                + np.int64(left) * channels
                + channel
            )
            _patch_sums(
                flat, base, row_bytes, channels, local, i, j, patches[channel], lanes[channel],
                mix, limit, low, high, growth, sums[o],
            )  # fmt: skip


@njit(cache=True, nogil=True, parallel=True)
def evaluate(
    images: np.ndarray,
    rotation: np.ndarray,
    translation: np.ndarray,
    exposure: np.ndarray,
    intrinsics: np.ndarray,
    position: np.ndarray,
    normal: np.ndarray,
    reference: np.ndarray,
    pixel: np.ndarray,
    starts: np.ndarray,
    target: np.ndarray,
    radius: int,
    huber: np.ndarray,
    limits: np.ndarray,
) -> np.ndarray:
    """The sums of every observation, (O, SUMS) float64; zeros where the warped patch leaves the target image.

    images: (I, H, W, C) uint8, contiguous, one pyramid level
    rotation, translation, exposure: (I, 3, 3), (I, 3), (I,) float64 of world_from_camera, and eps
    intrinsics: (4,) float64, fx fy cx cy of the level
    position, normal: (P, 3) float64, world; reference: (P,) int32; pixel: (P, 2) int32
    starts: (P + 1,) int64, point p owns observations starts[p] to starts[p + 1]; target: (O,) int32
    radius: patch side is 2 radius + 1
    huber: (O,) float64, residuals beyond it count linearly
    limits: (3,) float32: least and greatest usable intensity, growth of the noise variance per intensity (0: constant)
    """
    points = len(reference)
    sums = np.zeros((len(target), SUMS))
    chunks = -(-points // _CHUNK)
    for chunk in prange(chunks):
        i, j = _offsets(radius)
        patches = np.zeros((images.shape[3], i.size), np.float32)
        lanes = np.zeros((images.shape[3], i.size), np.float32)
        for point in range(chunk * _CHUNK, min(points, (chunk + 1) * _CHUNK)):
            _point_sums(
                point, images, rotation, translation, exposure, intrinsics, position, normal, reference, pixel,
                starts, target, radius, huber, limits, i, j, patches, lanes, sums,
            )  # fmt: skip
    return sums


@njit(cache=True, nogil=True, error_model="numpy")
def _observation_jacobian(
    rotation: np.ndarray,
    translation: np.ndarray,
    intrinsics: np.ndarray,
    position: np.ndarray,
    normal: np.ndarray,
    pixel: np.ndarray,
    r: int,
    relative: np.ndarray,
    offset: np.ndarray,
    jacobian: np.ndarray,
) -> None:
    """Fills (3, 15): target pixel (x, y) and log exposure difference by the 7 unknowns of reference and target, and
    by the offset of the plane."""
    plane, ray, poses = np.empty(3), np.empty(3), np.empty((2, 13))
    distance = plane_in_reference(rotation, translation, r, position, normal, plane)
    ray[0], ray[1] = (pixel[0] - intrinsics[2]) / intrinsics[0], (pixel[1] - intrinsics[3]) / intrinsics[1]
    ray[2] = 1.0
    center_jacobian(relative, offset, plane, distance, ray, intrinsics, poses)
    for axis in range(2):
        for n in range(6):
            jacobian[axis, n] = poses[axis, n]
            jacobian[axis, 7 + n] = poses[axis, 6 + n]
        jacobian[axis, 6] = jacobian[axis, 13] = 0.0
        jacobian[axis, 14] = poses[axis, 12]
    for n in range(15):
        jacobian[2, n] = 0.0
    jacobian[2, 6], jacobian[2, 13] = -1.0, 1.0


@njit(cache=True, nogil=True, parallel=True)
def assemble(
    sums: np.ndarray,
    weights: np.ndarray,
    order: np.ndarray,
    pair_starts: np.ndarray,
    pair_reference: np.ndarray,
    pair_target: np.ndarray,
    point: np.ndarray,
    rotation: np.ndarray,
    translation: np.ndarray,
    intrinsics: np.ndarray,
    position: np.ndarray,
    normal: np.ndarray,
    pixel: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Normal-equation blocks (M, 14, 14) and gradient (M, 14) of every image pair, and of every observation its
    gradient (O, 15) and the Hessian's row (O, 15) of the plane's offset.

    The 15 unknowns are `[rotation | translation | log exposure]` of the reference, then of the target, then the offset
    of the point's plane along its normal.

    sums: (O, SUMS) float64 of `evaluate`; weights: (O,) float64, one factor per observation
    order: (O,) int64, observations sorted by pair; pair m owns order[pair_starts[m]] to order[pair_starts[m + 1]]
    pair_reference, pair_target: (M,) int32; point: (O,) int32
    """
    pairs = len(pair_reference)
    hessian, gradient = np.zeros((pairs, 14, 14)), np.zeros((pairs, 14))
    single, coupling = np.zeros((len(point), 15)), np.zeros((len(point), 15))
    for m in prange(pairs):
        relative, offset = np.empty((3, 3)), np.empty(3)
        jacobian, weighted = np.empty((3, 15)), np.empty((3, 15))
        r, t = pair_reference[m], pair_target[m]
        relative_pose(rotation, translation, r, t, relative, offset)
        for n in range(pair_starts[m], pair_starts[m + 1]):
            o = order[n]
            if sums[o, 10] == 0.0:
                continue
            p = point[o]
            _observation_jacobian(
                rotation,
                translation,
                intrinsics,
                position[p],
                normal[p],
                pixel[p],
                r,
                relative,
                offset,
                jacobian,
            )
            w = weights[o]
            xx, xy, yy = w * sums[o, 0], w * sums[o, 1], w * sums[o, 2]
            xq, yq, qq = w * sums[o, 3], w * sums[o, 4], w * sums[o, 5]
            xr, yr, qr = w * sums[o, 6], w * sums[o, 7], w * sums[o, 8]
            for k in range(15):
                jx, jy, jq = jacobian[0, k], jacobian[1, k], jacobian[2, k]
                weighted[0, k] = xx * jx + xy * jy + xq * jq
                weighted[1, k] = xy * jx + yy * jy + yq * jq
                weighted[2, k] = xq * jx + yq * jy + qq * jq
                single[o, k] = xr * jx + yr * jy + qr * jq
            ox, oy = jacobian[0, 14], jacobian[1, 14]
            for k in range(15):
                coupling[o, k] = ox * weighted[0, k] + oy * weighted[1, k]
            for k in range(14):
                jx, jy, jq = jacobian[0, k], jacobian[1, k], jacobian[2, k]
                gradient[m, k] += single[o, k]
                for c in range(14):
                    hessian[m, k, c] += jx * weighted[0, c] + jy * weighted[1, c] + jq * weighted[2, c]
    return hessian, gradient, single, coupling


@njit(cache=True, nogil=True, error_model="numpy")
def shared_information(
    sums: np.ndarray,
    weights: np.ndarray,
    share: np.ndarray,
    shares: int,
    reference: np.ndarray,
    target: np.ndarray,
    point: np.ndarray,
    rotation: np.ndarray,
    translation: np.ndarray,
    intrinsics: np.ndarray,
    position: np.ndarray,
    normal: np.ndarray,
    pixel: np.ndarray,
) -> np.ndarray:
    """(shares, 6, 6): what the observations of each share tell of an image's pose, over fixed planes.

    share: (O, 2) int64, which share an observation belongs to with its reference, and with its target
    reference, target: (O,) int32, images; the rest as in `assemble`
    """
    found = np.zeros((shares, 6, 6))
    relative, offset, jacobian = np.empty((3, 3)), np.empty(3), np.empty((3, 15))
    for o in range(len(point)):
        if sums[o, 10] == 0.0:
            continue
        p, r = point[o], reference[o]
        relative_pose(rotation, translation, r, target[o], relative, offset)
        _observation_jacobian(
            rotation, translation, intrinsics, position[p], normal[p], pixel[p], r, relative, offset, jacobian
        )
        xx, xy, yy = weights[o] * sums[o, 0], weights[o] * sums[o, 1], weights[o] * sums[o, 2]
        for end in range(2):
            block = found[share[o, end]]
            for i in range(6):
                x, y = jacobian[0, 7 * end + i], jacobian[1, 7 * end + i]
                to_x, to_y = xx * x + xy * y, xy * x + yy * y
                for j in range(6):
                    block[i, j] += to_x * jacobian[0, 7 * end + j] + to_y * jacobian[1, 7 * end + j]
    return found
