"""Depth images: PNG files of one channel, 8 or 16 bits."""

from pathlib import Path

import numpy as np

from lvba.errors import InputError
from lvba.io import images


def read_depth(path: str | Path) -> np.ndarray:
    """The values of a depth image, (H, W) uint16, in the unit of the file; 0 where nothing was measured.

    Raises: InputError if the file is unreadable, truncated, damaged, or no image of one channel.
    """
    pixels = images.decoded(path)
    if pixels.ndim != 2 or pixels.dtype not in (np.uint8, np.uint16):
        raise InputError(path, "is no depth image: it has colors", "give PNG files of one channel")
    return pixels.astype(np.uint16)
