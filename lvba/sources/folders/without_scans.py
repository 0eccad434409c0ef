"""Folders of programs that keep no single scans: refused, with how to get them."""

import os
from pathlib import Path

from lvba.errors import InputError
from lvba.io import files
from lvba.sources.source import Source

_FAST_LIO_MEND = (
    "run it again and record its topics /cloud_registered_body and /Odometry (or /aft_mapped_to_init) in a bag, or give "
    "the bag with the raw scans and the odometry"
)
_R3LIVE_MEND = (
    "give the bag with the raw scans and images, and record /aft_mapped_to_init (poses of the IMU) and /camera_path "
    "(world to camera, at image times) beside it"
)


def is_fast_lio(path: Path) -> bool:
    """Whether a folder has the merged map of FAST-LIO2 or Point-LIO."""
    return os.path.isfile(path / "PCD" / "scans.pcd") or os.path.isfile(path / "scans.pcd")


def refuse_fast_lio(path: Path) -> Source:
    """Raises: InputError: scans.pcd holds all scans in one cloud, without poses."""
    inside = path / "PCD" / "scans.pcd"
    file = inside if os.path.isfile(inside) else path / "scans.pcd"
    raise InputError(file, "is a merged map of FAST-LIO2 or Point-LIO, without single scans", _FAST_LIO_MEND)


def is_r3live(path: Path) -> bool:
    """Whether a folder has the output of R3LIVE."""
    return _r3live_file(path) is not None


def _r3live_file(path: Path) -> Path | None:
    for folder in (path, path / "r3live_output"):
        if os.path.isdir(folder):
            for name in files.names_in(folder):
                if name.endswith(".r3live") or name == "rgb_pt.pcd":
                    return folder / name
    return None


def refuse_r3live(path: Path) -> Source:
    """Raises: InputError: R3LIVE keeps a map of coloured points, no scans."""
    raise InputError(_r3live_file(path), "is a map of R3LIVE, which keeps no single scans", _R3LIVE_MEND)
