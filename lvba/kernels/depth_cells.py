"""The nearest points of the cells of an image, and which of them are alone: they hide nothing."""

import numpy as np

from lvba.kernels.compiled import kernel

ALONE_PART = 0.1
"""A point whose depth differs by more than this part from all others in its cell and the eight around is alone: a drop of
rain, a beam split at an edge. A floor that is seen aslant has neighbors of like depth beside it."""
_FEWEST_OTHERS = 4
"""Where there are fewer, that nothing is near a point says little."""


@kernel
def keep_two(depth: np.ndarray, index: np.ndarray, z: float, m: int) -> None:
    """Takes point m at depth z into the two nearest of a cell. depth: (2,) float64, m, ascending; index: (2,) integers"""
    if z < depth[0]:
        depth[1], index[1] = depth[0], index[0]
        depth[0], index[0] = z, m
    elif z < depth[1]:
        depth[1], index[1] = z, m


@kernel
def is_alone(depth: np.ndarray, row: int, column: int) -> bool:
    """Whether nothing about a cell is as far off as its nearest point. depth: (rows, columns, 2) float64, m, inf: none"""
    own, others = depth[row, column, 0], 0
    for r in range(max(row - 1, 0), min(row + 2, depth.shape[0])):
        for c in range(max(column - 1, 0), min(column + 2, depth.shape[1])):
            for k in range(2):
                if (r == row and c == column and k == 0) or depth[r, c, k] == np.inf:
                    continue
                others += 1
                if abs(depth[r, c, k] - own) <= ALONE_PART * own:
                    return False
    return others >= _FEWEST_OTHERS
