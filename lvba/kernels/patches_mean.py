"""Mean brightness of the same piece of surface in two images."""

import math
from typing import NamedTuple

import numpy as np
from numba import prange

from lvba.kernels.compiled import kernel, parallel_kernel
from lvba.kernels.homography import plane_homography
from lvba.kernels.scene import Intrinsics, NearestPoints, PlanePatches
from lvba.kernels.visibility import PASSED, local_scale, patch_inside, view_cosines, warp
from lvba.kernels.visibility_depth import patch_hidden

COLUMN, ROW, RIGHT, DOWN, INSIDE = range(5)
"""Rows of what `land` writes: column and row of the upper left of the four pixels that hold a sample, the sample's place
between them (to the right and down, 0 to 1), and 1 where all four are in the image."""
REFERENCE_MEAN, TARGET_MEAN, SPREAD, CONTRAST = range(4)
"""Columns of what `measure_pairs` returns: mean of the reference and of the target (-1: not measured), the root mean
square of I_t / mean_t - I_r / mean_r, and what it would be if the two had nothing in common: of both, the standard
deviation over the mean, in squares together."""
PIXEL_VARIANCE = 1 / 12
"""px^2, along each axis: of the square that a pixel is the mean over."""
SAMPLE_VARIANCE = 1 / 12 + 1 / 6
"""px^2: of what a sample between four pixels is the mean over, on average over places between them."""
MOST_NARROWED = 0.6
"""Of the square of a window's radius: nothing would be left of one whose samples are as large as it is."""


class MeanGates(NamedTuple):
    """What a pair must pass to be compared; the first four, dark, bright and hiding as in `visibility.PairGates`.

    min_usable: least part of the window's weight that must be masked in neither
    """

    min_view_cosine: float
    min_normal_cosine: float
    min_scale: float
    max_scale: float
    dark: float
    bright: float
    min_usable: float
    hiding: float


@kernel
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

    h: (3, 3) float64, pixels of the reference to pixels of the target at the reference's level
    shrink: size of the target over that level's
    side: (2, N) float64, offsets of the window's pixels (right, down); landed: (5, N) float64, out: COLUMN to INSIDE
    """
    for n in range(side.shape[1]):
        i, j = u + side[0, n], v + side[1, n]
        w = h[2, 0] * i + h[2, 1] * j + h[2, 2]
        x = ((h[0, 0] * i + h[0, 1] * j + h[0, 2]) / w + 0.5) * shrink - 0.5
        y = ((h[1, 0] * i + h[1, 1] * j + h[1, 2]) / w + 0.5) * shrink - 0.5
        column, row = np.floor(x), np.floor(y)
        landed[COLUMN, n], landed[ROW, n] = column, row
        landed[RIGHT, n], landed[DOWN, n] = x - column, y - row
        inside = (column >= 0) & (row >= 0) & (column + 1 < width) & (row + 1 < height)
        landed[INSIDE, n] = 1.0 if inside else 0.0


@kernel
def bilinear(
    image: np.ndarray,
    column: np.uint32,
    row: np.uint32,
    right: float,
    down: float,
    c: int,
    gates: MeanGates,
) -> float:
    """Linear interpolation between four pixels of an image (H, W, C) uint8; -1 where one of them is masked."""
    p, q = float(image[row, column, c]), float(image[row, column + 1, c])
    r, s = float(image[row + 1, column, c]), float(image[row + 1, column + 1, c])
    if not (gates.dark < min(min(p, q), min(r, s)) and max(max(p, q), max(r, s)) < gates.bright):
        return -1.0
    return (p * (1 - right) + q * right) * (1 - down) + (r * (1 - right) + s * right) * down


@kernel
def window(xx: float, xy: float, yy: float, side: np.ndarray, weights: np.ndarray) -> None:
    """Weights (1 - q)^2 with sum 1, q = x^T A^-1 x, of what lies in the ellipse q < 1; their covariance is A / 8.

    xx, xy, yy: px^2, A; side: (2, N) float64, px; weights: (N,) float64, out
    """
    area, total = xx * yy - xy * xy, 0.0
    for n in range(len(weights)):
        x, y = side[0, n], side[1, n]
        inside = max(1.0 - (yy * x * x - 2 * xy * x * y + xx * y * y) / area, 0.0)
        weights[n] = inside * inside
        total += weights[n]
    for n in range(len(weights)):
        weights[n] /= total


@kernel
def matched_windows(
    h: np.ndarray, shrink: float, u: int, v: int, half: int, side: np.ndarray, weights: np.ndarray
) -> None:
    """Weights of a reference's pixels and of a target's samples that cover the same piece of surface.

    A pixel is a mean over a square, and a sample between pixels one over more; where the target is farther away these are
    larger pieces of surface, and the same weights would cover more of it, fainter. So the target's window is narrower by
    what its samples are larger, in every direction.
    h, shrink, u, v: see `land`; half: px, of the window; side: (2, N) float64, px; weights: (2, N) float64, out
    """
    x, y, w = warp(h, float(u), float(v))
    a, b = shrink * (h[0, 0] - x * h[2, 0]) / w, shrink * (h[0, 1] - x * h[2, 1]) / w
    c, d = shrink * (h[1, 0] - y * h[2, 0]) / w, shrink * (h[1, 1] - y * h[2, 1]) / w
    square = (half + 0.5) ** 2
    small, _ = local_scale(h, float(u), float(v))
    longest = 8 * SAMPLE_VARIANCE / (shrink * small) ** 2
    smaller = min(longest, MOST_NARROWED * square) / longest * 8 * SAMPLE_VARIANCE / (a * d - b * c) ** 2
    window(square, 0.0, square, side, weights[0])
    square += 8 * PIXEL_VARIANCE
    xx, xy, yy = smaller * (b * b + d * d), -smaller * (a * b + c * d), smaller * (a * a + c * c)
    window(square - xx, -xy, square - yy, side, weights[1])


@kernel
def compare(
    reference: np.ndarray,
    target: np.ndarray,
    u: int,
    v: int,
    side: np.ndarray,
    weights: np.ndarray,
    landed: np.ndarray,
    gates: MeanGates,
) -> tuple[float, float, float, float]:
    """REFERENCE_MEAN, TARGET_MEAN, SPREAD and CONTRAST over the reference's window; means -1 where too little is left.

    reference, target: (H, W, C) uint8; side, landed: see `land`; weights: (2, N) float64, of the pixels of the reference
    and of the samples of the target, each with sum 1. A pixel that is masked in one counts in neither mean.
    """
    channels = reference.shape[2]
    own, part, first, second, middle, rr, rt, tt = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for n in range(weights.shape[1]):
        if landed[INSIDE, n] == 0.0 or weights[0, n] + weights[1, n] == 0.0:
            continue
        column, row = np.uint32(np.int32(landed[COLUMN, n])), np.uint32(np.int32(landed[ROW, n]))
        i, j = np.uint32(v + np.int32(side[1, n])), np.uint32(u + np.int32(side[0, n]))
        a_sum, b_sum, aa, ab, bb = 0.0, 0.0, 0.0, 0.0, 0.0
        good = True
        for c in range(channels):
            a = float(reference[i, j, c])
            b = bilinear(target, column, row, landed[RIGHT, n], landed[DOWN, n], c, gates)
            good = good and b > 0 and gates.dark < a < gates.bright
            a_sum, b_sum, aa, ab, bb = a_sum + a, b_sum + b, aa + a * a, ab + a * b, bb + b * b
        if good:
            weight = weights[1, n]
            own += weights[0, n]
            part += weight
            first += weights[0, n] * a_sum
            second += weight * b_sum
            middle += weight * a_sum
            rr += weight * aa
            rt += weight * ab
            tt += weight * bb
    if min(own, part) < gates.min_usable:
        return -1.0, -1.0, 0.0, 0.0
    count = part * channels
    first, second, middle = first / (own * channels), second / count, middle / count
    spread = (rr / first**2 - 2 * rt / (first * second) + tt / second**2) / count
    contrast = (rr / count - middle**2) / first**2 + (tt / count - second**2) / second**2
    return first, second, math.sqrt(max(spread, 0.0)), math.sqrt(max(contrast, 0.0))


@parallel_kernel
def measure_pairs(
    finer: np.ndarray,
    images: np.ndarray,
    coarser: np.ndarray,
    poses: np.ndarray,
    intrinsics: Intrinsics,
    patches: PlanePatches,
    point: np.ndarray,
    target: np.ndarray,
    size: int,
    gates: MeanGates,
    nearest: NearestPoints,
) -> np.ndarray:
    """REFERENCE_MEAN, TARGET_MEAN, SPREAD and CONTRAST of every pair, (O, 4) float64.

    finer, images, coarser: (I, H, W, C) uint8, at twice, once and half the size; the target is read where its pixels are
        closest in size to the reference's
    poses: (I, 4, 4) float64, world_from_camera; intrinsics: of `images`
    point: (O,) int32, of the patches; target: (O,) int32, image; size: px, odd, of the window
    """
    means = np.full((len(point), 4), -1.0)
    half, height, width = size // 2, images.shape[1], images.shape[2]
    side = np.empty((2, size * size))
    for n in range(size * size):
        side[0, n], side[1, n] = n % size - half, n // size - half
    for o in prange(len(point)):
        p, t = point[o], target[o]
        r, u, v = patches.reference[p], patches.pixel[p, 0], patches.pixel[p, 1]
        position, normal = patches.position[p], patches.normal[p]
        along, slant = view_cosines(poses[t], position, normal)
        if not (along > gates.min_view_cosine and slant > gates.min_normal_cosine):
            continue
        h = plane_homography(poses, r, t, position, normal, intrinsics)
        if patch_inside(h, u, v, half, width, height) != PASSED:
            continue
        small, large = local_scale(h, float(u), float(v))
        if small < gates.min_scale or large > gates.max_scale:
            continue
        if len(nearest.nearest):
            depth = 0.0
            for a in range(3):
                depth += poses[r, a, 2] * (position[a] - poses[r, a, 3])
            if patch_hidden(nearest, t, poses[t], h, u, v, half, depth, position, normal, gates.hiding):
                continue
        scale = math.sqrt(small * large)
        if scale > math.sqrt(2.0):
            shrink, seen = 0.5, coarser[t]
        elif scale < math.sqrt(0.5):
            shrink, seen = 2.0, finer[t]
        else:
            shrink, seen = 1.0, images[t]
        landed, weights = np.empty((5, side.shape[1])), np.empty((2, side.shape[1]))
        land(h, shrink, u, v, side, seen.shape[1], seen.shape[0], landed)
        matched_windows(h, shrink, u, v, half, side, weights)
        means[o] = compare(images[r], seen, u, v, side, weights, landed, gates)
    return means
