"""Mean brightness of the same piece of surface in two images."""

import math

import numba
import numpy as np

from lvba.kernels.visibility import PASSED, local_scale, patch_inside, plane_homography, view_cosines
from lvba.kernels.visibility_depth import patch_hidden

_jit = numba.njit(cache=True, nogil=True)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def land(
    h: np.ndarray,
    shrink: float,
    u: int,
    v: int,
    side: np.ndarray,
    width: int,
    height: int,
    landed: np.ndarray,
) -> None:
    """Where the pixels of a window that is in front of the target (`patch_inside`) land in it.

    h: pixels of the reference to pixels of the target at the reference's level; shrink: size of the target over that
    side: (2, N) offsets of the window's pixels (right, down)
    landed: (5, N) out: column and row of the upper left of the four pixels that hold a sample, its place between them
        (right, down; 0 to 1), and 1 where all four are in the image
    """
    for n in range(side.shape[1]):
        i, j = u + side[0, n], v + side[1, n]
        w = h[2, 0] * i + h[2, 1] * j + h[2, 2]
        x = ((h[0, 0] * i + h[0, 1] * j + h[0, 2]) / w + 0.5) * shrink - 0.5
        y = ((h[1, 0] * i + h[1, 1] * j + h[1, 2]) / w + 0.5) * shrink - 0.5
        column, row = np.floor(x), np.floor(y)
        landed[0, n], landed[1, n] = column, row
        landed[2, n], landed[3, n] = x - column, y - row
        inside = (column >= 0) & (row >= 0) & (column + 1 < width) & (row + 1 < height)
        landed[4, n] = 1.0 if inside else 0.0


@_jit
def bilinear(
    image: np.ndarray,
    column: np.uint32,
    row: np.uint32,
    right: float,
    down: float,
    c: int,
    dark: float,
    bright: float,
) -> float:
    """Linear interpolation between four pixels; -1 where one of them is masked."""
    p, q = float(image[row, column, c]), float(image[row, column + 1, c])
    r, s = float(image[row + 1, column, c]), float(image[row + 1, column + 1, c])
    if not (dark < min(min(p, q), min(r, s)) and max(max(p, q), max(r, s)) < bright):
        return -1.0
    return (p * (1 - right) + q * right) * (1 - down) + (r * (1 - right) + s * right) * down


@_jit
def compare(
    reference: np.ndarray,
    target: np.ndarray,
    u: int,
    v: int,
    side: np.ndarray,
    weights: np.ndarray,
    landed: np.ndarray,
    least: float,
    dark: float,
    bright: float,
) -> tuple[float, float, float]:
    """(mean of the reference, mean of the target, spread) over the reference's window; means -1 where too little is left.

    side, landed: see `land`; weights: (N,)
    least: part of the window's weight that must be masked in neither; masked pixels count in neither mean
    spread: root mean square of I_t / mean_t - I_r / mean_r
    """
    channels = reference.shape[2]
    part, first, second, rr, rt, tt = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for n in range(len(weights)):
        if landed[4, n] == 0.0:
            continue
        column, row = np.uint32(np.int32(landed[0, n])), np.uint32(np.int32(landed[1, n]))
        i, j = np.uint32(v + np.int32(side[1, n])), np.uint32(u + np.int32(side[0, n]))
        a_sum, b_sum, aa, ab, bb = 0.0, 0.0, 0.0, 0.0, 0.0
        good = True
        for c in range(channels):
            a = float(reference[i, j, c])
            b = bilinear(target, column, row, landed[2, n], landed[3, n], c, dark, bright)
            good = good and b > 0 and dark < a < bright
            a_sum, b_sum, aa, ab, bb = a_sum + a, b_sum + b, aa + a * a, ab + a * b, bb + b * b
        if good:
            weight = weights[n]
            part += weight
            first += weight * a_sum
            second += weight * b_sum
            rr += weight * aa
            rt += weight * ab
            tt += weight * bb
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
    flat, side = weights.ravel(), np.empty((2, weights.size))
    for n in range(weights.size):
        side[0, n], side[1, n] = n % weights.shape[1] - half, n // weights.shape[1] - half
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
            shrink, seen = 0.5, coarser[t]
        elif scale < math.sqrt(0.5):
            shrink, seen = 2.0, finer[t]
        else:
            shrink, seen = 1.0, images[t]
        landed = np.empty((5, side.shape[1]))
        land(h, shrink, u, v, side, seen.shape[1], seen.shape[0], landed)
        found[o] = compare(images[r], seen, u, v, side, flat, landed, gates[6], gates[4], gates[5])
    return found
