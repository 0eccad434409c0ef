"""Open-addressing hash tables: keys in an array of 2^k places, what belongs to them beside it."""

from typing import Any

import numpy as np

from lvba.kernels.compiled import kernel

FREE = np.int64(-1)
"""The key of a place that holds nothing."""


@kernel
def place_of(table: np.ndarray, key: Any) -> Any:
    """Where a key is, or the free place where it belongs.

    table: (2^k,) int64, keys or FREE, at least one of them FREE
    """
    mask = len(table) - 1
    place = np.int64((np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(32)) & mask
    while table[place] != FREE and table[place] != key:
        place = (place + 1) & mask
    return place


@kernel
def doubled(table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same keys in twice the places, (2^(k + 1),) int64, and where the key of each place went, (2^k,) int64.

    table: (2^k,) int64, keys or FREE
    """
    wider, went = np.full(2 * len(table), FREE), np.empty(len(table), np.int64)
    for old in range(len(table)):
        if table[old] != FREE:
            new = place_of(wider, table[old])
            wider[new], went[old] = table[old], new
    return wider, went
