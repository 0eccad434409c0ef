"""Images in PNG and JPEG files, as RGB with 8 bits."""

from pathlib import Path

import cv2
import numpy as np

from lvba.errors import InputError
from lvba.io import files, image_header
from lvba.io.image_header import ImageSize

SUFFIXES = (".png", ".jpg", ".jpeg")
_EIGHT_BITS = ((np.arange(65536) * 255 + 32767) // 65535).astype(np.uint8)
"""The nearest of 256 values to each of 65536."""


def read_image(path: str | Path) -> np.ndarray:
    """The pixels of a PNG or JPEG file, (H, W, 3) uint8, RGB, as stored: no rotation by EXIF, no color profile.

    16 bits are scaled to 8, gray becomes RGB, alpha is dropped.
    Raises: InputError if the file is unreadable, truncated, damaged or too large.
    """
    return _to_rgb(path, decoded(path))


def decoded(path: str | Path) -> np.ndarray:
    """The values of a PNG or JPEG file as stored, (H, W) or (H, W, C) uint8 or uint16, BGR.

    Raises: InputError if the file is unreadable, truncated, damaged or too large.
    """
    content = files.read_bytes(path)
    expected = image_header.size(path, content[: image_header.START_BYTES])
    image_header.check_whole(path, content)
    try:
        pixels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        pixels = None
    if pixels is None or pixels.size == 0 or pixels.shape[:2] != (expected.height, expected.width):
        raise InputError(path, "damaged: cannot be decoded", "copy the file again, or remove it")
    return np.asarray(pixels)


def check_image(path: str | Path, content: bytes | None = None) -> ImageSize:
    """Width and height of a PNG or JPEG file; its pixels are not decoded.

    content: of the file, if it is at hand, is checked to its end; else only start and end are read
    Raises: InputError
    """
    start = files.read_start(path, image_header.START_BYTES) if content is None else content
    size = image_header.size(path, start[: image_header.START_BYTES])
    if content is None:
        image_header.check_end(path, start, files.read_end(path, image_header.END_BYTES))
    else:
        image_header.check_whole(path, content)
    return size


def write_image(path: str | Path, rgb: np.ndarray, *, quality: int = 95) -> None:
    """Writes a PNG or JPEG file, as the suffix says.

    rgb: (H, W, 3) uint8; quality: of a JPEG, 1 to 100
    Raises: InputError if the file cannot be written, ValueError if the suffix is neither.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"the suffix of {path} is none of {', '.join(SUFFIXES)}")
    options = [] if suffix == ".png" else [cv2.IMWRITE_JPEG_QUALITY, quality]
    _, encoded = cv2.imencode(suffix, np.ascontiguousarray(rgb[..., ::-1]), options)
    files.write_bytes(path, encoded.tobytes())


def _to_rgb(path: str | Path, pixels: np.ndarray) -> np.ndarray:
    if pixels.dtype == np.uint16:
        pixels = _EIGHT_BITS[pixels]
    if pixels.dtype != np.uint8:
        raise InputError(path, f"its values are {pixels.dtype}", "convert it to 8 or 16 bits")
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    if pixels.shape[2] < 3:  # gray, perhaps with alpha
        return np.repeat(pixels[..., :1], 3, axis=2)
    return np.ascontiguousarray(pixels[..., 2::-1])
