"""The scans of a window as one array of points."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Scans:
    """S scans in one array.

    points: (M, 3) float32, m, each in its scan's frame; NaN where the sensor had no return
    offsets: (S + 1,) int64, scan s owns points offsets[s] to offsets[s + 1]
    """

    points: np.ndarray
    offsets: np.ndarray

    def __len__(self) -> int:
        return len(self.offsets) - 1


def gather(scans: Sequence[np.ndarray]) -> Scans:
    """Scans of (N, 3) arrays, in order; empty ones stay, empty."""
    offsets = np.concatenate([[0], np.cumsum([len(scan) for scan in scans], dtype=np.int64)]).astype(np.int64)
    points = np.empty((offsets[-1], 3), np.float32)
    for first, last, scan in zip(offsets[:-1], offsets[1:], scans, strict=True):
        points[first:last] = scan
    return Scans(points, offsets)
