"""Compressed pieces of bags, unpacked within bounds: a short file may not stand for endless data."""

import bz2
import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lvba.errors import InputError
from lvba.sources.bags.container import MAX_MESSAGE

_MOST_TIMES = 1000
"""Of what a file has stored, plus MAX_MESSAGE: as much may be unpacked of it in one pass."""
_LZ4_TIMES = 255


class Damaged(ValueError):  # noqa: N818 (a state, which callers count)
    """A piece of a bag that cannot be read; says why in a few words."""


class Unpacker:
    """Unpacks pieces of one file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._allowed = MAX_MESSAGE

    def unpack(self, kind: str, data: bytes, size: int) -> bytes:
        """At most `size` bytes; fewer where the data are cut.

        kind: "none" or "", "bz2", "lz4", "zstd"
        Raises Damaged: the data are none of the kind. InputError: what unpacks it is not installed.
        """
        if kind in ("none", ""):
            return data
        self._allowed += _MOST_TIMES * len(data)
        most = min(size, MAX_MESSAGE, self._allowed)
        unpacked = _unpack(kind, data, most, self._path)
        self._allowed -= len(unpacked)
        if self._allowed <= 0:
            raise Damaged("it unpacks to more than a thousand times its size")
        return unpacked


def _unpack(kind: str, data: bytes, most: int, path: Path) -> bytes:
    if kind == "bz2":
        return _in_turn(bz2.BZ2Decompressor, data, most, OSError)
    if kind == "lz4":
        frame = lz4_frame(path)
        return _in_turn(frame.LZ4FrameDecompressor, data, min(most, _LZ4_TIMES * len(data)), RuntimeError)
    if kind == "zstd":
        zstd = zstd_module(path)
        return _in_turn(zstd.ZstdDecompressor, data, most, zstd.ZstdError)
    raise Damaged(f"it is compressed by {kind[:20]!r}")


def _in_turn(make: Callable[[], Any], data: bytes, most: int, error: type[Exception]) -> bytes:
    """Several frames, one behind the other, as one."""
    pieces: list[bytes] = []
    while data and most > 0:
        unpacker = make()
        try:
            piece = unpacker.decompress(data, max_length=most)
        except (error, EOFError, ValueError) as failed:
            if pieces:
                break
            raise Damaged("it cannot be unpacked") from failed
        pieces.append(piece)
        most -= len(piece)
        if not unpacker.eof:
            break
        data = unpacker.unused_data or b""
    return pieces[0] if len(pieces) == 1 else b"".join(pieces)


def lz4_frame(path: Path) -> Any:
    """The module that unpacks lz4.

    Raises InputError: it is not installed.
    """
    try:
        from lz4 import frame
    except ImportError as error:
        raise _missing(path, "lz4") from error
    return frame


def zstd_module(path: Path) -> Any:
    """The module that unpacks zstd.

    Raises InputError: it is not installed.
    """
    name = "compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd"
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise _missing(path, "zstd") from error


def _missing(path: Path, kind: str) -> InputError:
    return InputError(
        path, f"is compressed by {kind}, which needs a package", "install it: pip install 'lvba[bags]'"
    )
