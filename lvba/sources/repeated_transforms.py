"""Transforms that hold for all times though nothing says so: ROS 1 repeats static ones among those that move."""

from dataclasses import dataclass

import numpy as np

from lvba.arrays import Pose
from lvba.sources.source import TransformSample

_FEWEST = 3
_SAME = 1e-6
"""Entries of two transforms that differ by less are one."""

Pair = tuple[str, str]


@dataclass
class _Repeated:
    """Of a pair of frames. first, last: ns"""

    parent_from_child: Pose
    first: int
    last: int
    count: int = 1
    still: bool = True


class Repeated:
    """Takes transforms that are not said to be static, one after another."""

    def __init__(self) -> None:
        self._pairs: dict[Pair, _Repeated] = {}

    def add(self, sample: TransformSample) -> None:
        """One more."""
        key = (sample.parent, sample.child)
        seen = self._pairs.get(key)
        if seen is None:
            self._pairs[key] = _Repeated(sample.parent_from_child, sample.stamp, sample.stamp)
            return
        seen.count += 1
        seen.first, seen.last = min(seen.first, sample.stamp), max(seen.last, sample.stamp)
        if seen.still:
            seen.still = bool(np.abs(sample.parent_from_child - seen.parent_from_child).max() < _SAME)

    def still(self, least: int = 0) -> dict[Pair, Pose]:
        """(parent, child) -> (4, 4), parent from child, of those that never change. least: ns, that they are said for"""
        return {
            key: seen.parent_from_child
            for key, seen in self._pairs.items()
            if seen.still and seen.count >= _FEWEST and seen.last - seen.first >= least
        }
