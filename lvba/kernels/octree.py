"""Which level of an octree each point of a cloud belongs to, so that every level shows the cloud evenly."""

from typing import Any

import numpy as np
from numba import prange

from lvba.kernels.compiled import kernel, parallel_kernel
from lvba.kernels.morton import gather, spread

KEY_LEVELS = 21
"""Levels of a key: 21 bits for each axis."""
GRID_LEVELS = 7
"""A node is sampled on a grid of 128 cells along each axis."""
MAX_LEVEL = KEY_LEVELS - GRID_LEVELS
"""The deepest level of nodes: whatever is left there stays there."""
_NONE = np.uint8(255)


@parallel_kernel
def keys(position: np.ndarray, bits: int) -> np.ndarray:
    """Morton keys (N,) uint64 of whole-number positions (N, 3) int32 in [0, 2^bits): x, y, z from the highest bit down.

    Positions of fewer than 21 bits are stretched, those of more are shortened: a key always has 21 levels.
    position: (N, 3) int32
    """
    out = np.empty(len(position), np.uint64)
    for i in prange(len(position)):
        code = np.uint64(0)
        for a in range(3):
            x = np.int64(position[i, a])
            x = x >> (bits - KEY_LEVELS) if bits >= KEY_LEVELS else x << (KEY_LEVELS - bits)
            code |= spread(x) << np.uint64(2 - a)
        out[i] = code
    return out


@kernel(inline=True)
def _off_center(key: Any, level: Any) -> Any:
    """Squared distance from the center of the point's sampling cell, in half units of the key's finest cells."""
    below = KEY_LEVELS - GRID_LEVELS - level
    size = np.int64(1) << below
    total = np.int64(0)
    for a in range(3):
        inside = np.int64(gather(key >> np.uint64(a))) & (size - 1)
        away = 2 * inside + 1 - size
        total += away * away
    return total


@kernel
def levels(keys: np.ndarray, first: int, leaf_points: int) -> np.ndarray:
    """The level (N,) uint8 of each point of one octree node of level `first`. keys: (N,) uint64, ascending.

    From the root down, a node keeps one point of each cell of its grid, the one nearest to the cell's center (the first
    of several), and hands the others to its children; a node of at most `leaf_points` keeps all of them. Nodes above
    `first` hold other points too, and are therefore never leaves.
    """
    out = np.full(len(keys), _NONE)
    left = np.arange(len(keys))
    level = 0
    while len(left):
        node_shift = np.uint64(3 * (KEY_LEVELS - level))
        cell_shift = np.uint64(3 * (KEY_LEVELS - GRID_LEVELS - level))
        start, kept = 0, 0
        while start < len(left):
            end, node = start, keys[left[start]] >> node_shift
            while end < len(left) and keys[left[end]] >> node_shift == node:
                end += 1
            if level == MAX_LEVEL or (level >= first and end - start <= leaf_points):
                for i in range(start, end):
                    out[left[i]] = level
            else:
                i = start
                while i < end:
                    cell = keys[left[i]] >> cell_shift
                    best, least = i, _off_center(keys[left[i]], level)
                    j = i + 1
                    while j < end and keys[left[j]] >> cell_shift == cell:
                        away = _off_center(keys[left[j]], level)
                        if away < least:
                            best, least = j, away
                        j += 1
                    out[left[best]] = level
                    i = j
            start = end
        for i in range(len(left)):
            if out[left[i]] == _NONE:
                left[kept] = left[i]
                kept += 1
        left = left[:kept]
        level += 1
    return out
