"""Results of KISS-ICP beside the scans that it was given.

    FOLDER/ *_poses_tum.txt   scans in velodyne/, scans/, pcd/, data/ or beside it: PCD or BIN files

Scans are matched by the times in their names, or in order where there are as many as poses. They are as the sensor gave
them: not deskewed. KISS-ICP 1.3 with deskewing gives the pose of the end of a scan. Of a folder of scans it writes the
numbers 0, 1, 2, ... in place of times.
"""

import os
import re
from pathlib import Path

import numpy as np

from lvba.errors import InputError
from lvba.io import files as files_io
from lvba.io import timestamps, tum
from lvba.sources.folders import posed_scans, tables
from lvba.sources.folders.items import FolderSource

_SUFFIX = "_poses_tum.txt"
_SUFFIXES = (".pcd", ".bin")
_DIGITS = re.compile("([0-9]+)")
_FOLDERS = ("velodyne", "scans", "pcd", "data", "velodyne_points/data", ".")


def is_one(path: Path) -> bool:
    """Whether a folder has poses of KISS-ICP."""
    return _pose_file(path) is not None


def _pose_file(path: Path) -> Path | None:
    return next((path / name for name in sorted(os.listdir(path)) if name.endswith(_SUFFIX)), None)


def open_folder(path: Path) -> FolderSource:
    """The recording.

    Raises: InputError if there are no scans, or they do not go with the poses.
    """
    file = _pose_file(path)
    if file is None:
        raise InputError(path, f"has no *{_SUFFIX}", "give the folder with the poses")
    files = next(
        (listed for name in _FOLDERS if os.path.isdir(path / name) and (listed := _scans(path / name))), []
    )
    if not files:
        mend = "put the scans that KISS-ICP was given into a folder scans beside it (.pcd or .bin)"
        raise InputError(path, "has poses of KISS-ICP, but no scans", mend)
    read = tum.read_pose_file(file)
    poses, times = list(read.trajectory.world_from_sensor), read.trajectory.times
    notes = ["scans are not deskewed, and poses of KISS-ICP are of the end of a scan."]
    stamps: list[int] | None
    if (times == np.arange(len(times))).all():
        stamps = _times_of_names(files)
        if stamps is not None:
            notes.append("its poses have no times: those in the names of the scans are taken.")
    else:
        stamps = [tables.nanoseconds(file, time) for time in read.times]
        if (matched := _by_name(files, times)) is not None:
            files = [files[index] for index, _ in matched]
            poses, stamps = [poses[pose] for _, pose in matched], [stamps[pose] for _, pose in matched]
    return posed_scans.source(
        path, "KISS-ICP folder", file, files, poses, stamps, deskewed=False, notes=notes
    )


def _scans(folder: Path) -> list[Path]:
    """Files of scans with a number, in the order in which KISS-ICP takes them: digits in their names count as numbers.

    Of files that differ by their suffix alone, the first is taken.
    """
    paths: dict[str, Path] = {}
    for name in files_io.names_in(folder):
        stem, suffix = os.path.splitext(name)
        if suffix.lower() in _SUFFIXES and not name.startswith(".") and _DIGITS.search(stem):
            paths.setdefault(stem, folder / name)
    return [paths[stem] for stem in sorted(paths, key=_natural)]


def _natural(name: str) -> tuple[list[tuple[str, int]], str]:
    """What names are sorted by: words as words, digits as numbers."""
    pieces = _DIGITS.split(name)
    numbers = [int(digits) for digits in pieces[1::2]]
    return list(zip(pieces[::2], [*numbers, 0], strict=True)), name


def _times_of_names(files: list[Path]) -> list[int] | None:
    """ns of each scan, where all names have times with a fraction that grow; None: they have not."""
    named = [timestamps.stamp(file.name) or "" for file in files]
    if not all("." in stamp for stamp in named):
        return None
    stamps = [tables.nanoseconds(file, stamp) for file, stamp in zip(files, named, strict=True)]
    return stamps if (np.diff(stamps) > 0).all() else None


def _by_name(files: list[Path], times: np.ndarray) -> list[tuple[int, int]] | None:
    """Indices of scans and their poses, where names have times of the same clock; None: they have not."""
    named = [timestamps.stamp(file.name) for file in files]
    if None in named:
        return None
    own = np.array([float(stamp) for stamp in named if stamp is not None])
    nearest = np.abs(times[:, None] - own).argmin(0)
    close = np.abs(times[nearest] - own) <= timestamps.SAME_TIME
    if np.count_nonzero(close) * 2 <= len(own) or (own == np.arange(len(own))).all():
        return None
    return [(int(index), int(nearest[index])) for index in np.flatnonzero(close)]
