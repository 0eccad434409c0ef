"""Which frames of a stream have stamps in the order in which they were recorded."""

from bisect import bisect_left

import numpy as np


def in_order(stamps: np.ndarray) -> np.ndarray:
    """(N,) bool: frames whose stamps grow, as many as there can be. stamps: (N,) int64, ns, in the order of recording

    Frames that grow beyond all before them are these where no others are more: so a stamp that is too late costs its
    own frame, and none of those after it.
    """
    grows = np.ones(len(stamps), bool)
    if len(stamps):
        grows[1:] = stamps[1:] > np.maximum.accumulate(stamps)[:-1]
    if grows.all():
        return grows
    longest = _longest(stamps)
    return longest if np.count_nonzero(longest) > np.count_nonzero(grows) else grows


def is_in_order(known: np.ndarray, number: int) -> bool:
    """Whether the frame of this number is among those in order; known: (N,) bool, as of `in_order`

    A frame that is not known was recorded after its source was looked at.
    """
    return number < len(known) and bool(known[number])


def _longest(stamps: np.ndarray) -> np.ndarray:
    """(N,) bool: the longest ascending part of stamps (N,), by the least last stamp of each length."""
    last, ends = list[int](), list[int]()
    before = np.full(len(stamps), -1)
    for number, stamp in enumerate(stamps.tolist()):
        length = bisect_left(last, stamp)
        before[number] = ends[length - 1] if length else -1
        last[length : length + 1], ends[length : length + 1] = [stamp], [number]
    chosen = np.zeros(len(stamps), bool)
    number = ends[-1]
    while number >= 0:
        chosen[number] = True
        number = int(before[number])
    return chosen
