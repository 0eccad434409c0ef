"""Files as one zip, made while it is sent: nothing of it is ever on disk or whole in memory."""

import io
import os
import time
import zipfile
from collections.abc import Callable, Iterable, Iterator
from typing import BinaryIO

_PIECE = 1 << 20
_OLDEST = 315_619_200.0
"""1980-01-02: an entry of a zip file cannot be older."""


class _Sink(io.RawIOBase):
    """Takes what the zip writer writes, until it is taken away. Cannot seek: sizes then come after each file."""

    def __init__(self) -> None:
        self._pieces: list[bytes] = []

    def writable(self) -> bool:
        return True

    def write(self, data: "bytes | bytearray | memoryview") -> int:  # type: ignore[override]
        self._pieces.append(bytes(data))
        return len(data)

    def take(self) -> bytes:
        pieces, self._pieces = self._pieces, []
        return b"".join(pieces)


def zipped(
    opened: Callable[[str], BinaryIO], names: Iterable[str], compression: int, folder: str
) -> Iterator[bytes]:
    """The zip file of these files, piece by piece.

    opened: a file by its name, for reading; folder: all of them are below in the zip file
    """
    sink = _Sink()
    with zipfile.ZipFile(sink, "w", compression) as archive:
        for name in names:
            with (
                opened(name) as file,
                archive.open(_entry(f"{folder}/{name}", file, compression), "w", force_zip64=True) as entry,
            ):
                while data := file.read(_PIECE):
                    entry.write(data)
                    yield sink.take()
            yield sink.take()
    yield sink.take()


def _entry(name: str, file: BinaryIO, compression: int) -> zipfile.ZipInfo:
    status = os.fstat(file.fileno())
    changed = time.localtime(max(status.st_mtime, _OLDEST))[:6]
    entry = zipfile.ZipInfo(name, changed)
    entry.compress_type, entry.file_size = compression, status.st_size
    entry.external_attr = (status.st_mode & 0xFFFF) << 16
    return entry
