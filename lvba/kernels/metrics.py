"""Sums behind PSNR and SSIM, one image at a time; meant to run in several threads, one image each.

An image is walked once, row by row, so that all but the image itself stays in the processor's cache. Regions are the
bits of a byte per pixel. Sums go down the columns first: those of one row do not wait for each other, and the compiler
takes many at a time.
"""

import numpy as np

from lvba.kernels.compiled import kernel

_C1, _C2 = np.float32((0.01 * 255.0) ** 2), np.float32((0.03 * 255.0) ** 2)
_MIDDLE = np.float32(128.0)
X, XX, MASK, MASKED_X, MASKED_XX, MASKED_Y, MASKED_YY, MASKED_XY = range(8)
"""Rows of what `_moments` writes: x, x x; then over the covered pixels: 1, x, x x, y, y y, x y. x, y: luma less 128."""
_FIELDS = 8
WINDOW = 11
"""Edge of the windows of SSIM, px."""
REGIONS = 4
"""Bits of a region that are looked at. The first is the part of the image that is covered."""


@kernel
def luma(color: np.ndarray, out: np.ndarray) -> None:
    """Writes luma less 128, (W,) float32, of a row of pixels (W, 3): round zero, float32 keeps variances exact enough.

    color: (W, 3) uint8 or float32; out: (W,) float32
    """
    for column in range(len(color)):
        red, green, blue = color[column, 0], color[column, 1], color[column, 2]
        value = np.float32(0.299) * np.float32(red) + np.float32(0.587) * np.float32(green)
        out[column] = value + np.float32(0.114) * np.float32(blue) - _MIDDLE


@kernel
def image_luma(color: np.ndarray) -> np.ndarray:
    """Luma less 128, (H, W) float32, of an image (H, W, 3).

    color: (H, W, 3) uint8 or float32
    """
    out = np.empty(color.shape[:2], np.float32)
    for row in range(len(color)):
        luma(color[row], out[row])
    return out


@kernel
def _square(raw: np.ndarray, color: np.ndarray, out: np.ndarray) -> None:
    """Writes the squared difference (W,) float32, mean of the channels, of two rows of pixels (W, 3)."""
    third = np.float32(1.0 / 3.0)
    for column in range(len(raw)):
        red = color[column, 0] - np.float32(raw[column, 0])
        green = color[column, 1] - np.float32(raw[column, 1])
        blue = color[column, 2] - np.float32(raw[column, 2])
        out[column] = (red * red + green * green + blue * blue) * third


@kernel
def _add(values: np.ndarray, regions: np.ndarray, sums: np.ndarray) -> None:
    """Adds a row's values (W,) to the sums (REGIONS, W) float64 of the regions (W,) that they are in."""
    zero = np.float32(0.0)
    for region in range(REGIONS):
        flag, line = np.uint8(1 << region), sums[region]
        for column in range(len(values)):
            line[column] += np.float64(values[column] if regions[column] & flag else zero)


@kernel
def _total(sums: np.ndarray) -> np.ndarray:
    """(REGIONS,) float64, from column to column."""
    totals = np.zeros(REGIONS)
    for region in range(REGIONS):
        for column in range(sums.shape[1]):
            totals[region] += sums[region, column]
    return totals


@kernel
def count(regions: np.ndarray, border: int) -> np.ndarray:
    """Pixels (REGIONS,) float64 in each region, `border` pixels at each side of the image left out.

    regions: (H, W) uint8
    """
    inner = regions[border : regions.shape[0] - border, border : regions.shape[1] - border]
    sums, ones = np.zeros((REGIONS, inner.shape[1])), np.ones(inner.shape[1], np.float32)
    for row in range(inner.shape[0]):
        _add(ones, inner[row], sums)
    return _total(sums)


@kernel
def squared_error(raw: np.ndarray, color: np.ndarray, regions: np.ndarray) -> np.ndarray:
    """Sums (REGIONS,) float64 of the squared difference, mean of the channels, of (H, W, 3) uint8 and float32 images.

    regions: (H, W) uint8
    raw: (H, W, 3) uint8; color: (H, W, 3) float32
    """
    height, width = regions.shape
    sums, squared = np.zeros((REGIONS, width)), np.empty(width, np.float32)
    for row in range(height):
        _square(raw[row], color[row], squared)
        _add(squared, regions[row], sums)
    return _total(sums)


@kernel
def _moments(x: np.ndarray, y: np.ndarray, regions: np.ndarray, fields: np.ndarray) -> None:
    """Writes the fields (8, W) float32 of a row, X to MASKED_XY, from luma less 128 (W,)."""
    for column in range(len(x)):
        mask = np.float32(regions[column] & 1)
        a, b = x[column] * mask, y[column] * mask
        fields[X, column] = x[column]
        fields[XX, column] = x[column] * x[column]
        fields[MASK, column] = mask
        fields[MASKED_X, column] = a
        fields[MASKED_XX, column] = a * a
        fields[MASKED_Y, column] = b
        fields[MASKED_YY, column] = b * b
        fields[MASKED_XY, column] = a * b


@kernel
def _blur(values: np.ndarray, step: int, taps: np.ndarray, out: np.ndarray) -> None:
    """Writes sums of the values i, i + step, ... i + 10 step, weighted by the taps (11,), which are symmetric."""
    n = len(out)
    t0, t1, t2, t3, t4, t5 = taps[0], taps[1], taps[2], taps[3], taps[4], taps[5]
    a0, b0 = values[:n], values[10 * step : 10 * step + n]
    a1, b1 = values[step : step + n], values[9 * step : 9 * step + n]
    a2, b2 = values[2 * step : 2 * step + n], values[8 * step : 8 * step + n]
    a3, b3 = values[3 * step : 3 * step + n], values[7 * step : 7 * step + n]
    a4, b4 = values[4 * step : 4 * step + n], values[6 * step : 6 * step + n]
    middle = values[5 * step : 5 * step + n]
    for i in range(n):
        near = t5 * middle[i] + t4 * (a4[i] + b4[i]) + t3 * (a3[i] + b3[i])
        out[i] = near + t2 * (a2[i] + b2[i]) + t1 * (a1[i] + b1[i]) + t0 * (a0[i] + b0[i])


@kernel
def _ssim(
    mean_x: np.float32, mean_y: np.float32, square_x: np.float32, square_y: np.float32, product: np.float32
) -> np.float32:
    """SSIM from Gaussian moments of luma - 128."""
    two = np.float32(2.0)
    variances = (square_x - mean_x * mean_x) + (square_y - mean_y * mean_y)
    covariance = product - mean_x * mean_y
    x, y = mean_x + _MIDDLE, mean_y + _MIDDLE
    return ((two * x * y + _C1) * (two * covariance + _C2)) / ((x * x + y * y + _C1) * (variances + _C2))


@kernel
def _ssim_row(means: np.ndarray, whole: np.ndarray, alone: np.ndarray) -> None:
    """Writes the SSIM of a row, (W,) float32 each, from the means (8, W) of the fields of `_moments`."""
    one = np.float32(1.0)
    for column in range(len(whole)):
        mean_x, square_x, weight = means[X, column], means[XX, column], means[MASK, column]
        xm, xx = means[MASKED_X, column], means[MASKED_XX, column]
        ym, yy = means[MASKED_Y, column], means[MASKED_YY, column]
        xy = means[MASKED_XY, column]
        # black is -128 here: what holes add to the means of y, y y and x y
        hole = _MIDDLE * (one - weight)
        hole_x = _MIDDLE * (mean_x - xm)
        whole[column] = _ssim(mean_x, ym - hole, square_x, yy + _MIDDLE * hole, xy - hole_x)
        scale = one / max(weight, np.float32(1e-6))
        alone[column] = _ssim(xm * scale, ym * scale, xx * scale, yy * scale, xy * scale)


@kernel
def ssim(
    x: np.ndarray, color: np.ndarray, regions: np.ndarray, taps: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Sums (REGIONS,) float64 of SSIM: whole windows with holes black, and the covered pixels of each window alone.

    x: (H, W) float32, luma - 128 of the raw image; color: (H, W, 3) float32; regions: (H, W) uint8; taps: (11,) float32,
    the window in one direction. Pixels whose window does not fit into the image are left out.
    """
    height, width = regions.shape
    half = WINDOW // 2
    inner = max(width - WINDOW + 1, 0)
    y, fields = np.empty(width, np.float32), np.empty((_FIELDS, width), np.float32)
    # every row stands in it twice, so that the last eleven always follow each other
    rows = np.empty((2 * WINDOW, _FIELDS * inner), np.float32)
    means = np.empty((_FIELDS, inner), np.float32)
    whole, alone = np.empty(inner, np.float32), np.empty(inner, np.float32)
    whole_sums, alone_sums = np.zeros((REGIONS, inner)), np.zeros((REGIONS, inner))
    for row in range(height):
        luma(color[row], y)
        _moments(x[row], y, regions[row], fields)
        slot = row % WINDOW
        for field in range(_FIELDS):
            _blur(fields[field], 1, taps, rows[slot, field * inner : (field + 1) * inner])
        rows[slot + WINDOW] = rows[slot]
        if row < WINDOW - 1:
            continue
        _blur(rows[slot + 1 : slot + 1 + WINDOW].ravel(), _FIELDS * inner, taps, means.ravel())
        _ssim_row(means, whole, alone)
        center = regions[row - half, half : half + inner]
        _add(whole, center, whole_sums)
        _add(alone, center, alone_sums)
    return _total(whole_sums), _total(alone_sums)
