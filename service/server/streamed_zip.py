"""Files as one zip, made while it is sent: nothing of it is ever on disk or whole in memory."""

import io
import zipfile
from collections.abc import Iterable, Iterator
from pathlib import Path

_PIECE = 1 << 20


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


def zipped(folder: Path, names: Iterable[str], compression: int) -> Iterator[bytes]:
    """The zip file of these files, piece by piece."""
    sink = _Sink()
    with zipfile.ZipFile(sink, "w", compression) as archive:
        for name in names:
            info = zipfile.ZipInfo.from_file(folder / name, name)
            info.compress_type = compression
            with (folder / name).open("rb") as file, archive.open(info, "w", force_zip64=True) as entry:
                while data := file.read(_PIECE):
                    entry.write(data)
                    yield sink.take()
            yield sink.take()
    yield sink.take()
