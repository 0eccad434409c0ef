"""How much the pixels of an image differ from what their neighbors say, by blocks: what noise is read off."""

import numpy as np

from lvba.kernels.compiled import kernel


@kernel
def block_residuals(image: np.ndarray, block: int, saturated: int) -> np.ndarray:
    """Mean absolute second difference in both directions of each block of an image, (n,) float32, row by row.

    image: (H, W) uint8; block: px, edge. Blocks begin one pixel off the upper left corner; those with a pixel that is 0
    or clipped (`saturated` or more) are left out. Sums are of whole numbers, and exact.
    """
    rows, columns = max(image.shape[0] - 2, 0) // block, max(image.shape[1] - 2, 0) // block
    means, kept = np.empty(rows * columns, np.float32), 0
    # of one row of blocks, by column of pixels: sums without branches
    width = columns * block
    residual, bad = np.empty(width, np.int32), np.empty(width, np.uint8)
    for row in range(rows):
        residual[:], bad[:] = 0, 0
        for line in range(1 + row * block, 1 + (row + 1) * block):
            above, here, below = image[line - 1], image[line], image[line + 1]
            for k in range(width):
                left = np.int32(above[k]) - 2 * np.int32(here[k]) + np.int32(below[k])
                middle = np.int32(above[k + 1]) - 2 * np.int32(here[k + 1]) + np.int32(below[k + 1])
                right = np.int32(above[k + 2]) - 2 * np.int32(here[k + 2]) + np.int32(below[k + 2])
                residual[k] += abs(left - 2 * middle + right)
                bad[k] |= np.uint8((here[k + 1] <= 0) | (here[k + 1] >= saturated))
        for column in range(columns):
            total, masked = np.int64(0), False
            for k in range(column * block, (column + 1) * block):
                total += residual[k]
                masked |= bad[k] > 0
            if not masked:
                means[kept] = np.float32(total) / np.float32(block * block)
                kept += 1
    return means[:kept]
