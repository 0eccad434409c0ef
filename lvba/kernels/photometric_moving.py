"""The photometric cost with reference patches that move with the pose of their camera, as Li et al. have it (eq. 5).

The patch of a scene point p is centred at `u_r = pi(R_r^T (p - t_r))`, between pixels, and both images are read
bilinearly. Its warp about that centre is the homography of `lvba.kernels.photometric`, which takes u_r to the
projection of p into the target: where the reference turns, the moved centre and the turned ray cancel there, and what
is left of the reference's pose in the residual is the part through the gradient of I_r.

Slower than the default, and simple: it is there to be compared with. Every loop over threads owns its outputs.
"""

import numpy as np
from numba import prange

from lvba.kernels.compiled import kernel, parallel_kernel
from lvba.kernels.homography import patch_warp, plane_in_reference, relative_pose, warp_bounds
from lvba.kernels.photometric import (
    COST,
    COUNT,
    OFFSET,
    QQ,
    QR,
    SQUARE,
    WEIGHTS,
    XQ,
    XR,
    XX,
    XY,
    YQ,
    YR,
    YY,
    ImagePairs,
    Intensities,
    samples_inside,
)
from lvba.kernels.scene import Intrinsics, PlanePatches

UU, UV, VV, UX, UY, VX, VY, UQ, VQ, UR, VR = range(13, 24)
"""Columns of the sums of an observation after those of `lvba.kernels.photometric` (x, y: gradient in the target image; q:
derivative by log exposure; r: residual): products with u, v, the gradient in the reference image."""
SUMS = 24
"""How many columns there are."""

_INNER = np.array(
    [
        [XX, XY, XQ, UX, VX],
        [XY, YY, YQ, UY, VY],
        [XQ, YQ, QQ, UQ, VQ],
        [UX, UY, UQ, UU, UV],
        [VX, VY, VQ, UV, VV],
    ]
)
"""Column of the product of each two of x, y, q, u, v."""
_PULL = np.array([XR, YR, QR, UR, VR])
"""Column of the product of each of them with r."""


@kernel
def _in_camera(pose: np.ndarray, position: np.ndarray, point: np.ndarray) -> None:
    """Fills `R^T (p - t)` (3,), m. pose: (4, 4), world_from_camera"""
    for i in range(3):
        point[i] = 0.0
        for j in range(3):
            point[i] += pose[j, i] * (position[j] - pose[j, 3])


@kernel
def _sample(
    images: np.ndarray, image: int, u: float, v: float, channel: int
) -> tuple[float, float, float, float, float]:
    """Bilinear value, its derivatives by u and v, and the least and greatest of the four pixels."""
    column, row = int(u), int(v)
    right, below = column + 1, row + 1
    a, b = u - column, v - row
    i00, i10 = float(images[image, row, column, channel]), float(images[image, row, right, channel])
    i01, i11 = float(images[image, below, column, channel]), float(images[image, below, right, channel])
    top, bottom = i00 + a * (i10 - i00), i01 + a * (i11 - i01)
    by_u = (1.0 - b) * (i10 - i00) + b * (i11 - i01)
    least, greatest = min(min(i00, i10), min(i01, i11)), max(max(i00, i10), max(i01, i11))
    return top + b * (bottom - top), by_u, bottom - top, least, greatest


@kernel
def _add_sample(
    reference: tuple[float, float, float, float, float],
    target: tuple[float, float, float, float, float],
    mix: tuple[float, float],
    huber: float,
    usable: Intensities,
    slope: np.ndarray,
    sums: np.ndarray,
) -> None:
    """Adds one pixel pair to the sums; mix: eps_r / s and eps_t / s with s = sqrt(eps_r^2 + eps_t^2)."""
    wanted, wanted_u, wanted_v, wanted_least, wanted_greatest = reference
    seen, seen_x, seen_y, seen_least, seen_greatest = target
    low, high, growth = usable.least, usable.greatest, usable.growth
    if min(wanted_least, seen_least) < low or max(wanted_greatest, seen_greatest) > high:
        return
    c, s = mix
    noise = 1.0 / np.sqrt(1.0 + growth * (c * c * seen + s * s * wanted))
    r = noise * (c * seen - s * wanted)
    slope[0], slope[1] = noise * c * seen_x, noise * c * seen_y
    slope[2] = -noise * (s * seen + c * wanted) * c * s
    slope[3], slope[4] = -noise * s * wanted_u, -noise * s * wanted_v
    clipped = min(abs(r), huber)
    weight = huber / max(abs(r), huber)
    for m in range(5):
        for n in range(m, 5):
            sums[_INNER[m, n]] += weight * slope[m] * slope[n]
        sums[_PULL[m]] += weight * slope[m] * r
    sums[COST] += clipped * (abs(r) - 0.5 * clipped)
    sums[COUNT] += 1.0
    sums[SQUARE] += r * r
    sums[WEIGHTS] += weight


@kernel
def _patch_sums(
    images: np.ndarray,
    r: int,
    t: int,
    u: float,
    v: float,
    warp: np.ndarray,
    mix: tuple[float, float],
    radius: int,
    huber: float,
    usable: Intensities,
    slope: np.ndarray,
    sums: np.ndarray,
) -> None:
    """Adds all pixel pairs of the patch about (u, v) to the sums of its observation."""
    for j in range(-radius, radius + 1):
        for i in range(-radius, radius + 1):
            depth = 1.0 + warp[6] * i + warp[7] * j
            x = (warp[0] * i + warp[1] * j + warp[2]) / depth
            y = (warp[3] * i + warp[4] * j + warp[5]) / depth
            for channel in range(images.shape[3]):
                wanted = _sample(images, r, u + i, v + j, channel)
                seen = _sample(images, t, x, y, channel)
                _add_sample(wanted, seen, mix, huber, usable, slope, sums)


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
) -> np.ndarray:
    """The sums of every observation, (O, SUMS) float64; zeros where a patch leaves either image.

    Arguments as of `lvba.kernels.photometric.evaluate`.
    images, poses, exposure, starts, target, huber: as in `lvba.kernels.photometric.evaluate`
    """
    height, width = images.shape[1], images.shape[2]
    sums = np.zeros((len(target), SUMS))
    for p in prange(len(patches.reference)):
        relative, offset, plane, ray = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
        warp, slope = np.empty(8), np.empty(5)
        r = patches.reference[p]
        _in_camera(poses[r], patches.position[p], ray)
        if not ray[2] > 0.0:
            continue
        ray[0], ray[1], ray[2] = ray[0] / ray[2], ray[1] / ray[2], 1.0
        u, v = intrinsics.fx * ray[0] + intrinsics.cx, intrinsics.fy * ray[1] + intrinsics.cy
        if not (u >= radius and v >= radius and u + radius < width - 1 and v + radius < height - 1):
            continue
        plane_in_reference(poses[r], patches.position[p], patches.normal[p], plane)
        for o in range(starts[p], starts[p + 1]):
            t = target[o]
            relative_pose(poses, r, t, relative, offset)
            if not patch_warp(relative, offset, plane, ray, intrinsics, warp) > 0.0:
                continue
            # as close to the border as the default goes, so that both lose the same patches
            if not samples_inside(warp_bounds(warp, radius), width, height):
                continue
            norm = np.sqrt(exposure[r] ** 2 + exposure[t] ** 2)
            mix = (exposure[r] / norm, exposure[t] / norm)
            _patch_sums(images, r, t, u, v, warp, mix, radius, huber[o], usable, slope, sums[o])
    return sums


@kernel
def _projection_jacobian(
    pose: np.ndarray,
    intrinsics: Intrinsics,
    position: np.ndarray,
    normal: np.ndarray,
    jacobian: np.ndarray,
) -> None:
    """Fills (2, 7): where a point is seen, by the camera's local `[rotation | translation]` and by the point's offset
    along its normal. pose: (4, 4), world_from_camera"""
    point, along, row = np.empty(3), np.empty(3), np.empty(3)
    _in_camera(pose, position, point)
    for i in range(3):
        along[i] = 0.0
        for j in range(3):
            along[i] += pose[j, i] * normal[j]
    for axis in range(2):
        focal = (intrinsics.fx if axis == 0 else intrinsics.fy) / point[2]
        row[0], row[1], row[2] = 0.0, 0.0, -focal * point[axis] / point[2]
        row[axis] = focal
        jacobian[axis, 0] = row[1] * point[2] - row[2] * point[1]
        jacobian[axis, 1] = row[2] * point[0] - row[0] * point[2]
        jacobian[axis, 2] = row[0] * point[1] - row[1] * point[0]
        jacobian[axis, 3], jacobian[axis, 4], jacobian[axis, 5] = -row[0], -row[1], -row[2]
        jacobian[axis, 6] = row[0] * along[0] + row[1] * along[1] + row[2] * along[2]


@kernel
def observation_jacobian(
    poses: np.ndarray,
    intrinsics: Intrinsics,
    position: np.ndarray,
    normal: np.ndarray,
    r: int,
    t: int,
) -> np.ndarray:
    """(5, 15) float64: target pixel (x, y), log exposure difference and reference pixel (u, v) of a patch's centre, by
    the 7 unknowns of reference and target, and by the offset of the plane.

    poses: (I, 4, 4) float64, world_from_camera; position: (3,) float64, m, world; normal: (3,) float64, unit, world;
    r, t: reference and target image
    """
    jacobian, seen = np.zeros((5, 15)), np.empty((2, 7))
    for image, row, column in ((t, 0, 7), (r, 3, 0)):
        _projection_jacobian(poses[image], intrinsics, position, normal, seen)
        for axis in range(2):
            for n in range(6):
                jacobian[row + axis, column + n] = seen[axis, n]
            jacobian[row + axis, OFFSET] = seen[axis, 6]
    jacobian[2, 6], jacobian[2, 13] = -1.0, 1.0
    return jacobian


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
    """Blocks (M, 14, 14) and gradient (M, 14) of every image pair, and of every observation its gradient (O, 15) and
    the Hessian's row (O, 15) of the plane's offset.

    sums: (O, SUMS) float64 of `evaluate`; the rest as of `lvba.kernels.photometric.assemble`.
    weights, point, poses: as in `lvba.kernels.photometric.assemble`
    """
    pairs = len(image_pairs.reference)
    hessian, gradient = np.zeros((pairs, 14, 14)), np.zeros((pairs, 14))
    single, coupling = np.zeros((len(point), 15)), np.zeros((len(point), 15))
    for m in prange(pairs):
        inner, pull = np.empty((5, 5)), np.empty(5)
        r, t = image_pairs.reference[m], image_pairs.target[m]
        for n in range(image_pairs.starts[m], image_pairs.starts[m + 1]):
            o = image_pairs.order[n]
            if sums[o, COUNT] == 0.0:
                continue
            p = point[o]
            jacobian = observation_jacobian(poses, intrinsics, patches.position[p], patches.normal[p], r, t)
            for i in range(5):
                pull[i] = weights[o] * sums[o, _PULL[i]]
                for j in range(5):
                    inner[i, j] = weights[o] * sums[o, _INNER[i, j]]
            weighted = _product(inner, jacobian)
            for k in range(15):
                for i in range(5):
                    single[o, k] += jacobian[i, k] * pull[i]
                    coupling[o, k] += jacobian[i, OFFSET] * weighted[i, k]
            for k in range(14):
                gradient[m, k] += single[o, k]
                for c in range(14):
                    for i in range(5):
                        hessian[m, k, c] += jacobian[i, k] * weighted[i, c]
    return hessian, gradient, single, coupling


@kernel
def _product(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The matrix product, summed in order."""
    result = np.zeros((left.shape[0], right.shape[1]))
    for i in range(left.shape[0]):
        for k in range(right.shape[1]):
            for j in range(left.shape[1]):
                result[i, k] += left[i, j] * right[j, k]
    return result
