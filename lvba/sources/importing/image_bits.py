"""How many of 16 bits images use: cameras write 10, 12 or 14 into 16, which looks black where all are taken for used.

One factor for all images of a stream, so that their exposures stay what they are.
"""

from dataclasses import replace

import cv2
import numpy as np

from lvba.sources.source import RawImage

ALL = 16
_USUAL = (8, 10, 12, 14, ALL)
_PNG = b"\x89PNG\r\n\x1a\n"
_DEPTH_AT = 24
"""Byte of a PNG that says how many bits a value has: the header's chunk is always the first."""


def values(image: RawImage) -> np.ndarray | None:
    """(H, W) or (H, W, 3) uint16, RGB, of an image of 16 bits, without alpha; None: it has 8, or cannot be decoded."""
    if image.encoded is None:
        pixels = image.pixels
        return pixels if pixels is not None and pixels.dtype == np.uint16 else None
    if image.encoded[:8] != _PNG or image.encoded[_DEPTH_AT : _DEPTH_AT + 1] != bytes([ALL]):
        return None
    decoded = cv2.imdecode(np.frombuffer(image.encoded, np.uint8), cv2.IMREAD_UNCHANGED)
    if decoded is None or decoded.dtype != np.uint16:
        return None
    return np.asarray(decoded if decoded.ndim == 2 else decoded[..., 2::-1])


def used(largest: int) -> int:
    """The bits of a camera, by the largest value of all its images; 16 where all are 0."""
    return next(bits for bits in _USUAL if largest < 1 << bits) if largest else ALL


def widened(image: RawImage, bits: int) -> RawImage:
    """The image with its values spread over all 16 bits, by one factor; as it is where it has 8, or uses 16."""
    pixels = values(image) if bits < ALL else None
    return image if pixels is None else replace(image, encoded=None, pixels=pixels << np.uint16(ALL - bits))


def notes(bits: int) -> list[str]:
    """What is said of images that use so many bits of 16."""
    if bits == ALL:
        return []
    least, factor = (1 << bits) - 1, 1 << (ALL - bits)
    return [
        f"images: no value of their 16 bits is above {least}: they are of {bits} bits, and written times {factor}"
    ]
