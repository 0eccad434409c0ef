"""Files of which only pieces are here, such as the start and the end: what else is read is noted, and an error.

A recording can so be looked at before all of it has arrived, by the readers that read the whole: their file has the
length of the whole, and holes.
"""

import io
import os
from bisect import bisect_right
from collections.abc import Iterable
from io import BufferedReader
from pathlib import Path

from lvba.errors import InputError

_known: dict[str, "PartialFile"] = {}


class PartialFile:
    """The pieces that are here of one file. absent: places that were read and are not here, in bytes from its begin."""

    def __init__(self, pieces: Iterable[tuple[int, int]]) -> None:
        """pieces: (begin, end) of each, in bytes"""
        self._begins: list[int] = []
        self._ends: list[int] = []
        for begin, end in sorted(pieces):
            if self._ends and begin <= self._ends[-1]:
                self._ends[-1] = max(self._ends[-1], end)
            elif end > begin:
                self._begins.append(begin)
                self._ends.append(end)
        self.absent: list[int] = []

    def end_of(self, place: int) -> int:
        """Where the piece ends that a place is in; the place itself: it is in none."""
        index = bisect_right(self._begins, place) - 1
        return max(place, self._ends[index]) if index >= 0 else place


def declare(path: str | Path, pieces: Iterable[tuple[int, int]]) -> PartialFile:
    """From now on this process reads only these pieces of a file, (begin, end) in bytes."""
    partial = PartialFile(pieces)
    _known[os.path.abspath(path)] = partial
    return partial


def opened(path: str | Path) -> BufferedReader | None:
    """The file, if it was declared to be one of pieces; reading elsewhere raises InputError."""
    partial = _known.get(os.path.abspath(path)) if _known else None
    return BufferedReader(_Pieces(path, partial)) if partial is not None else None


class _Pieces(io.RawIOBase):
    """Reads up to the end of the piece that it is in."""

    def __init__(self, path: str | Path, partial: PartialFile) -> None:
        super().__init__()
        self._path, self._partial = path, partial
        self._file = open(path, "rb", buffering=0)  # noqa: SIM115 (closed with this)
        self._size = os.fstat(self._file.fileno()).st_size

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        return self._file.seek(offset, whence)

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        place = self._file.tell()
        if place >= self._size or not len(buffer):
            return 0
        end = self._partial.end_of(place)
        if end <= place:
            self._partial.absent.append(place)
            raise InputError(self._path, "this part has not been looked at yet", "upload all of it")
        return self._file.readinto(memoryview(buffer)[: end - place])

    def close(self) -> None:
        self._file.close()
        super().close()
