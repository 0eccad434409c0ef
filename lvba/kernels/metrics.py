"""Sums behind PSNR and SSIM, one image at a time; meant to run in several threads, one image each."""

import numpy as np
from numba import njit

_C1, _C2 = np.float32((0.01 * 255.0) ** 2), np.float32((0.03 * 255.0) ** 2)
MIDDLE = np.float32(128.0)


@njit(cache=True, nogil=True)
def luma(color: np.ndarray, out: np.ndarray) -> None:
    """Writes luma less 128, (H, W) float32, of an image (H, W, 3): round zero, float32 keeps variances exact enough."""
    for row in range(color.shape[0]):
        for column in range(color.shape[1]):
            red, green, blue = color[row, column, 0], color[row, column, 1], color[row, column, 2]
            value = np.float32(0.299) * np.float32(red) + np.float32(0.587) * np.float32(green)
            out[row, column] = value + np.float32(0.114) * np.float32(blue) - MIDDLE


@njit(cache=True, nogil=True)
def squared_error(raw: np.ndarray, color: np.ndarray, squared: np.ndarray) -> None:
    """Writes the squared difference (H, W) float32, mean of the channels, of (H, W, 3) uint8 and float32 images."""
    third = np.float32(1.0 / 3.0)
    for row in range(raw.shape[0]):
        for column in range(raw.shape[1]):
            total = np.float32(0.0)
            for c in range(3):
                difference = color[row, column, c] - np.float32(raw[row, column, c])
                total += difference * difference
            squared[row, column] = total * third


@njit(cache=True, nogil=True)
def moments(
    raw: np.ndarray,
    x: np.ndarray,
    color: np.ndarray,
    covered: np.ndarray,
    fields: np.ndarray,
    squared: np.ndarray,
) -> None:
    """Writes the fields (6, H, W) float32 whose Gaussian means SSIM needs, and the squared error (H, W) float32.

    raw: (H, W, 3) uint8; x: (H, W) float32, its luma - 128; color: (H, W, 3) float32; covered: (H, W) bool.
    fields: mask, x, x x, y, y y, x y, all zero outside the mask; squared: mean over the channels
    """
    luma(color, fields[3])
    squared_error(raw, color, squared)
    for row in range(raw.shape[0]):
        for column in range(raw.shape[1]):
            mask = np.float32(covered[row, column])
            a, b = x[row, column] * mask, fields[3, row, column] * mask
            fields[0, row, column] = mask
            fields[1, row, column] = a
            fields[2, row, column] = a * a
            fields[3, row, column] = b
            fields[4, row, column] = b * b
            fields[5, row, column] = a * b


@njit(cache=True, nogil=True, error_model="numpy")
def _ssim(
    mean_x: np.float32, mean_y: np.float32, square_x: np.float32, square_y: np.float32, product: np.float32
) -> np.float32:
    """SSIM from Gaussian moments of luma - 128."""
    two = np.float32(2.0)
    variances = (square_x - mean_x * mean_x) + (square_y - mean_y * mean_y)
    covariance = product - mean_x * mean_y
    x, y = mean_x + MIDDLE, mean_y + MIDDLE
    return ((two * x * y + _C1) * (two * covariance + _C2)) / ((x * x + y * y + _C1) * (variances + _C2))


@njit(cache=True, nogil=True, error_model="numpy")
def ssim(
    means: np.ndarray, mean_x: np.ndarray, square_x: np.ndarray, whole: np.ndarray, alone: np.ndarray
) -> None:
    """Writes SSIM maps (H, W) float32: whole windows with holes black, and the covered pixels of each window alone.

    means: (6, H, W) float32, Gaussian means of the fields; mean_x, square_x: (H, W), of x and x x without mask
    """
    one = np.float32(1.0)
    for row in range(whole.shape[0]):
        for column in range(whole.shape[1]):
            weight, xm, xx = means[0, row, column], means[1, row, column], means[2, row, column]
            ym, yy, xy = means[3, row, column], means[4, row, column], means[5, row, column]
            # black is -128 here: what holes add to the means of y, y y and x y
            hole = MIDDLE * (one - weight)
            hole_x = MIDDLE * (mean_x[row, column] - xm)
            whole[row, column] = _ssim(
                mean_x[row, column], ym - hole, square_x[row, column], yy + MIDDLE * hole, xy - hole_x
            )
            scale = one / max(weight, np.float32(1e-6))
            alone[row, column] = _ssim(xm * scale, ym * scale, xx * scale, yy * scale, xy * scale)


@njit(cache=True, nogil=True)
def masked_sum(values: np.ndarray, mask: np.ndarray, border: int) -> tuple[float, int]:
    """Sum (float64) and number of the values inside a mask, `border` pixels at each side left out."""
    height, width = mask.shape
    # by column first: sums of one column do not wait for each other, so that the compiler takes many at a time
    totals, counts = np.zeros(width, np.float64), np.zeros(width, np.int32)
    for row in range(border, height - border):
        for column in range(border, width - border):
            inside = np.int32(mask[row, column])
            totals[column] += np.float64(values[row, column]) * np.float64(inside)
            counts[column] += inside
    total, count = 0.0, 0
    for column in range(border, width - border):
        total += totals[column]
        count += counts[column]
    return total, count
