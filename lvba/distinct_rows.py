"""Which rows of integers are the same, as cells of a grid that points are in."""

import math

import numpy as np

from lvba.arrays import Indices

_MOST = 1 << 62


def number(rows: np.ndarray) -> Indices:
    """(N,) int64: for each row its place among the distinct ones, sorted by the first column, then by the next.

    rows: (N, K) int64
    As `np.unique` gives for rows, which sorts whole rows; one number for each row is sorted in a tenth of the time.
    """
    if not len(rows):
        return np.zeros(0, np.int64)
    low = rows.min(axis=0)
    spans = [int(high) - int(least) + 1 for high, least in zip(rows.max(axis=0), low, strict=True)]
    if math.prod(spans) >= _MOST:
        return np.unique(rows, axis=0, return_inverse=True)[1].reshape(-1)
    key = np.zeros(len(rows), np.int64)
    for column, least, span in zip(rows.T, low, spans, strict=True):
        key = key * span + (column - least)
    return np.unique(key, return_inverse=True)[1].reshape(-1)
