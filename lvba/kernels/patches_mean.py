"""Mean brightness of the same piece of surface in two images."""

import math

import numba
import numpy as np

from lvba.kernels.visibility import PASSED, local_scale, patch_inside, plane_homography, view_cosines, warp
from lvba.kernels.visibility_depth import patch_hidden

_jit = numba.njit(cache=True, nogil=True)


@_jit
def bilinear(image: np.ndarray, x: float, y: float, c: int, dark: float, bright: float) -> float:
    """Linear interpolation at (x, y); -1 outside or where one of the four pixels is masked."""
    x0, y0 = math.floor(x), math.floor(y)
    if x0 < 0 or y0 < 0 or x0 + 1 >= image.shape[1] or y0 + 1 >= image.shape[0]:
        return -1.0
    p, q = float(image[y0, x0, c]), float(image[y0, x0 + 1, c])
    r, s = float(image[y0 + 1, x0, c]), float(image[y0 + 1, x0 + 1, c])
    if not (dark < min(min(p, q), min(r, s)) and max(max(p, q), max(r, s)) < bright):
        return -1.0
    fx, fy = x - x0, y - y0
    return (p * (1 - fx) + q * fx) * (1 - fy) + (r * (1 - fx) + s * fx) * fy


@_jit
def compare(
    reference: np.ndarray,
    target: np.ndarray,
    h: np.ndarray,
    shrink: float,
    u: int,
    v: int,
    weights: np.ndarray,
    least: float,
    dark: float,
    bright: float,
) -> tuple[float, float, float]:
    """(mean of the reference, mean of the target, spread) over the reference's window; means -1 where too little is left.

    h: pixels of the reference to pixels of the target at the reference's level; shrink: size of `target` over that
    least: part of the window's weight that must be masked in neither; masked pixels count in neither mean
    spread: root mean square of I_t / mean_t - I_r / mean_r
    """
    half, channels = weights.shape[0] // 2, reference.shape[2]
    part, first, second, rr, rt, tt = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(-half, half + 1):
        for j in range(-half, half + 1):
            x, y, w = warp(h, u + j, v + i)
            if w <= 0:
                return -1.0, -1.0, 0.0
            x, y = (x + 0.5) * shrink - 0.5, (y + 0.5) * shrink - 0.5
            sums = (0.0, 0.0, 0.0, 0.0, 0.0)
            good = True
            for c in range(channels):
                a, b = float(reference[v + i, u + j, c]), bilinear(target, x, y, c, dark, bright)
                good = good and b > 0 and dark < a < bright
                sums = (sums[0] + a, sums[1] + b, sums[2] + a * a, sums[3] + a * b, sums[4] + b * b)
            if good:
                weight = weights[i + half, j + half]
                part += weight
                first += weight * sums[0]
                second += weight * sums[1]
                rr += weight * sums[2]
                rt += weight * sums[3]
                tt += weight * sums[4]
    if part < least:
        return -1.0, -1.0, 0.0
    first, second = first / (part * channels), second / (part * channels)
    spread = rr / first**2 - 2 * rt / (first * second) + tt / second**2
    return first, second, math.sqrt(max(spread, 0.0) / (part * channels))


@numba.njit(parallel=True, cache=True, nogil=True)
def measure_pairs(
    finer: np.ndarray,
    images: np.ndarray,
    coarser: np.ndarray,
    poses: np.ndarray,
    intrinsics: np.ndarray,
    position: np.ndarray,
    normal: np.ndarray,
    reference: np.ndarray,
    pixel: np.ndarray,
    point: np.ndarray,
    target: np.ndarray,
    weights: np.ndarray,
    gates: np.ndarray,
    nearest: np.ndarray,
    points: np.ndarray,
    cell: float,
) -> np.ndarray:
    """Mean of the reference, mean of the target and spread of every pair, (O, 3) float64; mean -1: not measured.

    finer, images, coarser: (I, H, W, C) at twice, once and half the size; the target is read where its pixels are
        closest in size to the reference's
    poses: (I, 4, 4); intrinsics: fx, fy, cx, cy of `images`; position, normal (P, 3); reference (P,); pixel (P, 2)
    point, target: (O,); weights: (N, N), sum 1
    gates: [least d.z_C, least |d.n|, least scale, largest scale, dark, bright, least part of the window, tolerance of
        hiding m]
    nearest, points, cell: as in `visibility.judge_pairs`
    """
    found = np.full((len(point), 3), -1.0)
    half, height, width = weights.shape[0] // 2, images.shape[1], images.shape[2]
    for o in numba.prange(len(point)):
        p, t = point[o], target[o]
        r, u, v = reference[p], pixel[p, 0], pixel[p, 1]
        along, slant = view_cosines(poses[t], position[p], normal[p])
        if not (along > gates[0] and slant > gates[1]):
            continue
        h = plane_homography(poses[r], poses[t], position[p], normal[p], intrinsics, intrinsics)
        if patch_inside(h, u, v, half, width, height) != PASSED:
            continue
        small, large = local_scale(h, float(u), float(v))
        if small < gates[2] or large > gates[3]:
            continue
        if len(nearest):
            depth = 0.0
            for a in range(3):
                depth += poses[r, a, 2] * (position[p, a] - poses[r, a, 3])
            if patch_hidden(
                nearest[t], points, poses[t], cell, h, u, v, half, depth, position[p], normal[p], gates[7]
            ):
                continue
        scale = math.sqrt(small * large)
        if scale > math.sqrt(2.0):
            found[o] = compare(images[r], coarser[t], h, 0.5, u, v, weights, gates[6], gates[4], gates[5])
        elif scale < math.sqrt(0.5):
            found[o] = compare(images[r], finer[t], h, 2.0, u, v, weights, gates[6], gates[4], gates[5])
        else:
            found[o] = compare(images[r], images[t], h, 1.0, u, v, weights, gates[6], gates[4], gates[5])
    return found
