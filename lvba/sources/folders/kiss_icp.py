"""Results of KISS-ICP beside the scans that it was given.

    FOLDER/ *_poses_tum.txt   scans in velodyne/, scans/, pcd/, data/ or beside it: PCD or BIN files

Scans are matched by the times in their names, or in order where there are as many as poses. They are as the sensor gave
them: not deskewed. KISS-ICP 1.3 with deskewing gives the pose of the end of a scan.
"""

import os
from pathlib import Path

import numpy as np

from lvba.errors import InputError
from lvba.io import timestamps, tum
from lvba.sources.folders import posed_scans, tables
from lvba.sources.folders.items import FolderSource, numbered

_SUFFIX = "_poses_tum.txt"
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
    read = tum.read_pose_file(file)
    stamps = [
        tables.nanoseconds(file, stamp or f"{time:.9f}")
        for stamp, time in zip(read.stamps, read.trajectory.times, strict=True)
    ]
    poses = list(read.trajectory.world_from_sensor)
    scans = next(
        (
            listed
            for name in _FOLDERS
            if os.path.isdir(path / name) and (listed := numbered(path / name, (".pcd", ".bin")))
        ),
        {},
    )
    if not scans:
        mend = "put the scans that KISS-ICP was given into a folder scans beside it (.pcd or .bin)"
        raise InputError(path, "has poses of KISS-ICP, but no scans", mend)
    files = list(scans.values())
    matched = _by_name(files, read.trajectory.times)
    if matched is not None:
        files = [files[index] for index, _ in matched]
        poses, stamps = [poses[pose] for _, pose in matched], [stamps[pose] for _, pose in matched]
    note = "scans are not deskewed, and poses of KISS-ICP are of the end of a scan."
    return posed_scans.source(
        path, "KISS-ICP folder", file, files, poses, stamps, deskewed=False, notes=(note,)
    )


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
