"""Scans in KITTI's .bin files: x y z intensity as float32, point after point, nothing else."""

from pathlib import Path

import numpy as np

from lvba.dataset import Scan
from lvba.errors import InputError
from lvba.io import files, finite_points

SUFFIX = ".bin"
_POINT_BYTES = 16


def read_bin(path: str | Path) -> Scan:
    """The points and intensities of a .bin file, without those that have no finite position or that of the origin.

    Raises: InputError if the file is unreadable, no whole number of points, or holds no finite point.
    """
    content = files.read_bytes(path)
    _count(path, len(content))
    table = np.frombuffer(content, "<f4").reshape(-1, 4)
    return finite_points.keep(path, table[:, :3], table[:, 3].astype(np.float32), None)


def check_bin(path: str | Path, content: bytes | None = None) -> int:
    """The number of points, from the size of the file.

    Raises: InputError if it is no whole number, or zero.
    """
    return _count(path, files.size(path) if content is None else len(content))


def _count(path: str | Path, size: int) -> int:
    if size == 0:
        raise InputError(path, "an empty scan", "remove the file")
    if size % _POINT_BYTES:
        raise InputError(path, f"truncated: {size} bytes are no whole number of points", "copy it again")
    return size // _POINT_BYTES
