"""Frames of a recording are decoded once, in pieces that all later steps read.

Each piece holds frames of one core, so that no frame is in two of them. A step is given the pieces of the frames that it
works on, and holds one or a few of them at a time beside what it copies out.
"""

import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

import numpy as np

from lvba.arrays import Indices
from lvba.plan import Ref, StreamedRef

T = TypeVar("T")
Range = tuple[int, int]
"""Half-open, of numbers of frames in the whole recording."""
Pieces = Sequence[tuple[Range, Callable[[], T]]]
"""Pieces by the frames they hold, ascending, as functions that read them."""
Made = tuple[Range, Ref]
Given = tuple[Range, StreamedRef]
"""A piece in a plan: as a step makes it, and as it is given to another one."""


def given(pieces: Sequence[Made], numbers: Indices) -> list[Given]:
    """The pieces that hold some frames, ascending numbers (n,)."""
    return [
        ((first, end), StreamedRef(ref.key))
        for (first, end), ref in pieces
        if np.searchsorted(numbers, first) < np.searchsorted(numbers, end)
    ]


class PieceReader(Generic[T]):
    """Reads pieces, and keeps the last ones. May be called from several threads."""

    def __init__(self, pieces: Pieces[T], keep: int = 1) -> None:
        self._pieces, self._keep = pieces, keep
        self._kept: OrderedDict[int, T] = OrderedDict()
        self._lock = threading.Lock()

    def find(self, number: int) -> tuple[int, T] | None:
        """The first frame of the piece that holds a frame, and the piece; None where no piece does."""
        for index, ((first, end), read) in enumerate(self._pieces):
            if first <= number < end:
                with self._lock:
                    if index not in self._kept:
                        while len(self._kept) >= self._keep:
                            self._kept.popitem(last=False)
                        self._kept[index] = read()
                    self._kept.move_to_end(index)
                    return first, self._kept[index]
        return None

    def frame(self: "PieceReader[np.ndarray]", number: int) -> np.ndarray:
        """One image (H, W, 3) uint8 of pieces that are arrays of them.

        Raises IndexError: no piece holds it.
        """
        piece = self.find(number)
        if piece is None:
            raise IndexError(f"no piece holds image {number}")
        return np.asarray(piece[1][number - piece[0]])
