"""The photometric cost by parameters that all images share: what a border of the normal equations is made of."""

import numpy as np
from numba import prange

from lvba.kernels.compiled import kernel, parallel_kernel
from lvba.kernels.homography import patch_warp, plane_in_reference, relative_pose
from lvba.kernels.photometric import (
    COUNT,
    OFFSET,
    QQ,
    QR,
    XQ,
    XR,
    XX,
    XY,
    YQ,
    YR,
    YY,
    ImagePairs,
    observation_jacobian,
)
from lvba.kernels.scene import Intrinsics, PlanePatches

_CHUNK = 256


@parallel_kernel
def assemble(
    sums: np.ndarray,
    weights: np.ndarray,
    image_pairs: ImagePairs,
    point: np.ndarray,
    poses: np.ndarray,
    intrinsics: Intrinsics,
    patches: PlanePatches,
    by_shared: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of every image pair the blocks (M, 14, k) between its two images and the shared parameters, and those of the
    parameters (M, k, k); of every observation its gradient by them (O, k), and its block (O, k) with its plane's offset.

    by_shared: (O, 3, k) float64, target pixel (x, y) of the patch centre and log exposure difference by the parameters;
    sums, weights, point, poses: as in `photometric.assemble`, and so is the order of the unknowns
    """
    pairs, size = len(image_pairs.reference), by_shared.shape[2]
    coupling, hessian = np.zeros((pairs, 14, size)), np.zeros((pairs, size, size))
    single, with_offset = np.zeros((len(point), size)), np.zeros((len(point), size))
    for m in prange(pairs):
        relative, offset, jacobian = np.empty((3, 3)), np.empty(3), np.empty((3, 15))
        r, t = image_pairs.reference[m], image_pairs.target[m]
        relative_pose(poses, r, t, relative, offset)
        for n in range(image_pairs.starts[m], image_pairs.starts[m + 1]):
            o = image_pairs.order[n]
            if sums[o, COUNT] == 0.0:
                continue
            observation_jacobian(poses[r], intrinsics, patches, point[o], relative, offset, jacobian)
            w, s = weights[o], sums[o]
            for k in range(size):
                jx, jy, jq = by_shared[o, 0, k], by_shared[o, 1, k], by_shared[o, 2, k]
                x = w * (s[XX] * jx + s[XY] * jy + s[XQ] * jq)
                y = w * (s[XY] * jx + s[YY] * jy + s[YQ] * jq)
                q = w * (s[XQ] * jx + s[YQ] * jy + s[QQ] * jq)
                single[o, k] = w * (s[XR] * jx + s[YR] * jy + s[QR] * jq)
                with_offset[o, k] = jacobian[0, OFFSET] * x + jacobian[1, OFFSET] * y
                for i in range(14):
                    coupling[m, i, k] += jacobian[0, i] * x + jacobian[1, i] * y + jacobian[2, i] * q
                for i in range(size):
                    hessian[m, i, k] += (
                        by_shared[o, 0, i] * x + by_shared[o, 1, i] * y + by_shared[o, 2, i] * q
                    )
    return coupling, hessian, single, with_offset


@kernel
def eliminate(
    coupling: np.ndarray,
    entry: np.ndarray,
    with_offset: np.ndarray,
    reference: np.ndarray,
    target: np.ndarray,
    point: np.ndarray,
) -> None:
    """Takes off the coupling (I, 7, m) of images and shared parameters what goes through the planes' offsets, in order.

    coupling: (I, 7, m) float64; entry: (P + O, 7) float64, of `plane_offsets.gather`
    with_offset: (P, m) float64, couplings over the offsets' Hessian
    reference: (P,) int32, images; target: (O,) int32, images; point: (O,) int32
    """
    points = len(reference)
    for n in range(points + len(target)):
        image = reference[n] if n < points else target[n - points]
        p = n if n < points else point[n - points]
        for i in range(7):
            for k in range(with_offset.shape[1]):
                coupling[image, i, k] -= entry[n, i] * with_offset[p, k]


@parallel_kernel
def centers(
    point: np.ndarray,
    target: np.ndarray,
    poses: np.ndarray,
    intrinsics: Intrinsics,
    patches: PlanePatches,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where the middle of each patch is in its target image, (O, 2) px, its derivative (O, 2, 2) by the reference pixel,
    and (O, 2, 12) by `[rotation | translation]` of the reference, then of the target; float64.

    point: (O,) int32; target: (O,) int32, images; poses: (I, 4, 4) float64, world_from_camera
    """
    place = np.empty((len(point), 2))
    by_pixel, by_poses = np.empty((len(point), 2, 2)), np.empty((len(point), 2, 12))
    for chunk in prange(-(-len(point) // _CHUNK)):
        relative, offset, plane, ray = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
        warp, jacobian = np.empty(8), np.empty((3, 15))
        for o in range(chunk * _CHUNK, min(len(point), (chunk + 1) * _CHUNK)):
            p = point[o]
            r = patches.reference[p]
            relative_pose(poses, r, target[o], relative, offset)
            plane_in_reference(poses[r], patches.position[p], patches.normal[p], plane)
            ray[0] = (patches.pixel[p, 0] - intrinsics.cx) / intrinsics.fx
            ray[1] = (patches.pixel[p, 1] - intrinsics.cy) / intrinsics.fy
            ray[2] = 1.0
            patch_warp(relative, offset, plane, ray, intrinsics, warp)
            observation_jacobian(poses[r], intrinsics, patches, p, relative, offset, jacobian)
            for axis in range(2):
                middle = warp[3 * axis + 2]
                place[o, axis] = middle
                by_pixel[o, axis, 0] = warp[3 * axis] - middle * warp[6]
                by_pixel[o, axis, 1] = warp[3 * axis + 1] - middle * warp[7]
                for n in range(6):
                    by_poses[o, axis, n] = jacobian[axis, n]
                    by_poses[o, axis, 6 + n] = jacobian[axis, 7 + n]
    return place, by_pixel, by_poses


@kernel
def shared_information(
    sums: np.ndarray,
    weights: np.ndarray,
    cluster: np.ndarray,
    clusters: int,
    target: np.ndarray,
    point: np.ndarray,
    poses: np.ndarray,
    intrinsics: Intrinsics,
    patches: PlanePatches,
) -> np.ndarray:
    """(clusters, 6, 6) float64: what the observations of each cluster tell of an image's pose, over fixed planes.

    cluster: (O, 2) int64, which cluster an observation belongs to with its reference, and with its target
    target: (O,) int32, images; the rest as in `assemble`
    sums, weights, point, poses: as in `assemble`
    """
    blocks = np.zeros((clusters, 6, 6))
    relative, offset, jacobian = np.empty((3, 3)), np.empty(3), np.empty((3, 15))
    for o in range(len(point)):
        if sums[o, COUNT] == 0.0:
            continue
        r = patches.reference[point[o]]
        relative_pose(poses, r, target[o], relative, offset)
        observation_jacobian(poses[r], intrinsics, patches, point[o], relative, offset, jacobian)
        w = weights[o]
        xx, xy, yy = w * sums[o, XX], w * sums[o, XY], w * sums[o, YY]
        for end in range(2):
            block = blocks[cluster[o, end]]
            for i in range(6):
                x, y = jacobian[0, 7 * end + i], jacobian[1, 7 * end + i]
                to_x, to_y = xx * x + xy * y, xy * x + yy * y
                for j in range(6):
                    block[i, j] += to_x * jacobian[0, 7 * end + j] + to_y * jacobian[1, 7 * end + j]
    return blocks
