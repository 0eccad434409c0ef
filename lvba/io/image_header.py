"""What the bytes of a PNG or JPEG file say before they are decoded: the size, and whether the file is whole.

Decoders give back a half-gray image for half a file without a word, and allocate whatever size the header asks for.
"""

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

from lvba.errors import InputError
from lvba.io import jpeg

MAX_PIXELS = 200_000_000
"""More than any camera's; a header that asks for more is damaged or hostile."""
START_BYTES = 256 * 1024
"""The size is found within so many bytes (JPEGs carry thumbnails and profiles before it)."""
END_BYTES = 64 * 1024
"""The end marker is within so many last bytes (some cameras pad or append)."""

_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8\xff"
_COPY_AGAIN = "copy the file again, or remove it"


@dataclass(frozen=True)
class ImageSize:
    """Width and height, px."""

    width: int
    height: int


def size(path: str | Path, start: bytes) -> ImageSize:
    """The size of a PNG or JPEG image from its first bytes.

    Raises: InputError if it is neither, its header is damaged, or it has more than MAX_PIXELS pixels.
    """
    if start.startswith(_PNG):
        dimensions = _png_size(start)
    elif start.startswith(_JPEG):
        dimensions = _jpeg_size(start)
    elif not start:
        raise InputError(path, "an empty file", _COPY_AGAIN)
    else:
        raise InputError(path, "is neither PNG nor JPEG", "convert it to PNG or JPEG")
    if dimensions is None or not (dimensions.width and dimensions.height):
        raise InputError(path, "truncated or damaged: its header has no size", _COPY_AGAIN)
    if dimensions.width * dimensions.height > MAX_PIXELS:
        raise InputError(
            path,
            f"{dimensions.width} x {dimensions.height} pixels are more than {MAX_PIXELS}",
            "scale the images down",
        )
    return dimensions


def check_whole(path: str | Path, content: bytes) -> None:
    """Passes if the file is there to its end: PNG with all checksums, JPEG with all its blocks (`jpeg.problem`).

    Raises: InputError
    """
    problem = _png_problem(content) if content.startswith(_PNG) else jpeg.problem(content)
    if problem:
        raise InputError(path, problem, _COPY_AGAIN)


def check_end(path: str | Path, start: bytes, end: bytes) -> None:
    """Passes if the last bytes of the file hold the end marker: cheaper than `check_whole`, blind to damage inside.

    Raises: InputError
    """
    if (b"IEND" if start.startswith(_PNG) else b"\xff\xd9") not in end:
        raise InputError(path, "truncated: its end is missing", _COPY_AGAIN)


def _png_size(start: bytes) -> ImageSize | None:
    if len(start) < 24 or start[12:16] != b"IHDR":
        return None
    return ImageSize(*struct.unpack(">II", start[16:24]))


def _png_problem(content: bytes) -> str:
    position = len(_PNG)
    while position + 12 <= len(content):
        length = int.from_bytes(content[position : position + 4], "big")
        end = position + 12 + length
        if end > len(content):
            break
        kind = content[position + 4 : position + 8]
        if zlib.crc32(memoryview(content)[position + 4 : end - 4]) != int.from_bytes(
            content[end - 4 : end], "big"
        ):
            return f"damaged: the checksum of its {kind.decode('latin-1')!r} part is wrong"
        if kind == b"IEND":
            return ""
        position = end
    return "truncated: its end is missing"


def _jpeg_size(start: bytes) -> ImageSize | None:
    dimensions = jpeg.read_segments(start).size
    return None if dimensions is None else ImageSize(*dimensions)
