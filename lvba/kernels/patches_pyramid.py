"""Image pyramids: halving images so that masked pixels stay masked."""

import numpy as np
from numba import prange

from lvba.kernels.compiled import parallel_kernel


@parallel_kernel
def halve(images: np.ndarray, saturated: int) -> np.ndarray:
    """Every image at half size, (I, H // 2, W // 2, C) uint8: the mean of each 2x2 block, halves rounded to even.

    images: (I, H, W, C) uint8; saturated: value from which a pixel counts as clipped

    A block with a clipped pixel becomes 255 and one with an exactly black (invalid) pixel 0: the mean of a block that
    lost light, or holds no image, would look like a measurement.
    """
    count, height, width, channels = images.shape
    half = np.empty((count, height // 2, width // 2, channels), np.uint8)
    for row_of_all in prange(count * (height // 2)):
        image, row = row_of_all // (height // 2), row_of_all % (height // 2)
        for column in range(width // 2):
            for channel in range(channels):
                a = np.int32(images[image, 2 * row, 2 * column, channel])
                b = np.int32(images[image, 2 * row, 2 * column + 1, channel])
                c = np.int32(images[image, 2 * row + 1, 2 * column, channel])
                d = np.int32(images[image, 2 * row + 1, 2 * column + 1, channel])
                total = a + b + c + d
                # rounding up all halves would brighten every level by 1/8
                value = int((total + 1 + ((total >> 2) & 1)) >> 2)
                if max(max(a, b), max(c, d)) >= saturated:
                    value = 255
                if min(min(a, b), min(c, d)) <= 0:
                    value = 0
                half[image, row, column, channel] = value
    return half


@parallel_kernel
def blank_masked(images: np.ndarray, reach: int, dark: float, bright: float) -> np.ndarray:
    """The images with 0 wherever a pixel within `reach` px (square) is not strictly between dark and bright.

    images: (I, H, W, C) uint8; a pixel is masked when any of its channels is
    """
    count, height, width, channels = images.shape
    blank = np.empty_like(images)
    for i in prange(count):
        blank[i] = images[i]
        bad = np.empty(width * channels, np.uint8)
        for row in range(height):
            line, some = images[i, row].ravel(), np.uint8(0)
            # without branches: hardly a pixel is masked, and the compiler takes many at a time
            for k in range(width * channels):
                bad[k] = not (dark < line[k] < bright)
                some |= bad[k]
            if not some:
                continue
            top = max(row - reach, 0)
            for masked in np.flatnonzero(bad):
                column = masked // channels
                blank[i, top : row + reach + 1, max(column - reach, 0) : column + reach + 1] = 0
    return blank
