"""Which program wrote a folder."""

import os
from collections.abc import Callable
from pathlib import Path

from lvba.errors import InputError
from lvba.sources.folders import (
    balm,
    hba,
    kiss_icp,
    kitti360,
    kitti_raw,
    polycam,
    record3d,
    recordings,
    replica,
    scannet,
    seven_scenes,
    spires,
    stray,
    tum_rgbd,
    without_scans,
)
from lvba.sources.source import Source

_FAMILIES: tuple[tuple[Callable[[Path], bool], Callable[[Path], Source]], ...] = (
    (recordings.is_one, recordings.open_folder),
    (kitti_raw.is_one, kitti_raw.open_folder),
    (kitti360.is_one, kitti360.open_folder),
    (stray.is_one, stray.open_folder),
    (record3d.is_one, record3d.open_folder),
    (polycam.is_one, polycam.open_folder),
    (scannet.is_one, scannet.open_folder),
    (seven_scenes.is_one, seven_scenes.open_folder),
    (replica.is_one, replica.open_folder),
    (tum_rgbd.is_one, tum_rgbd.open_folder),
    (spires.is_one, spires.open_folder),
    (hba.is_one, hba.open_folder),
    (balm.is_one, balm.open_folder),
    (kiss_icp.is_one, kiss_icp.open_folder),
    (without_scans.is_fast_lio, without_scans.refuse_fast_lio),
    (without_scans.is_r3live, without_scans.refuse_r3live),
)
"""In this order: whether a folder is one of the family, and its source."""


_ARCHIVES = {
    ".r3d": (
        "is a ZIP archive of Record3D",
        "unpack it, decompress its .depth files (LZFSE), and give the folder",
    ),
    ".sens": (
        "is a file of ScanNet",
        "export color, depth, pose and intrinsic with its SensReader, and give the folder",
    ),
}
"""Files that hold such a folder, by their suffix: what they are, and the fix."""


def is_known(path: Path) -> bool:
    """Whether a folder is one of another program, by the names of its files."""
    return os.path.isdir(path) and any(is_one(path) for is_one, _ in _FAMILIES[1:])


def find(path: Path) -> Source | None:
    """The source of a folder of another program; None: it is none that is known.

    Raises: InputError: it is one, damaged or of no use, with the fix.
    """
    if path.suffix.lower() in _ARCHIVES and os.path.isfile(path):
        raise InputError(path, *_ARCHIVES[path.suffix.lower()])
    if not os.path.isdir(path):
        return None
    return next((open_folder(path) for is_one, open_folder in _FAMILIES if is_one(path)), None)
