"""Input of BALM: numbered deskewed scans and a 4x4 pose for each.

    FOLDER/ full0.pcd full1.pcd ...   alidarPose.csv: 4 lines of 4 numbers a pose

The last number of a pose is 1, or its time in seconds; without times, 10 scans a second are assumed. Some of its data
have the scans in a folder beside the file. Source: hku-mars/BALM.
"""

import os
from pathlib import Path

import numpy as np

from lvba.errors import InputError
from lvba.sources.folders import posed_scans, tables
from lvba.sources.folders.items import FolderSource, numbered

_POSES = "alidarPose.csv"


def is_one(path: Path) -> bool:
    """Whether a folder has this layout."""
    return os.path.isfile(path / _POSES)


def open_folder(path: Path) -> FolderSource:
    """The recording.

    Raises: InputError if poses and scans do not go together, or a pose is malformed.
    """
    rows, lines = [], []
    for number, words in tables.lines_of_words(path / _POSES, ","):
        filled = [word for word in words if word]
        rows.append(tables.numbers(f"{path / _POSES}:{number}", filled, 4, "4 lines of 4 numbers a pose"))
        lines.append(number)
    if not rows or len(rows) % 4:
        raise InputError(
            path / _POSES, f"{len(rows)} lines are no whole number of poses", "write 4 lines a pose"
        )
    matrices = np.array(rows).reshape(-1, 4, 4)
    corners = matrices[:, 3, 3].copy()
    matrices[:, 3, 3] = 1
    poses = [
        tables.pose(f"{path / _POSES}:{line}", matrix)
        for matrix, line in zip(matrices, lines[::4], strict=True)
    ]
    timed = len(corners) > 1 and bool((np.diff(corners) > 0).all()) and corners[0] >= 0
    stamps = [tables.nanoseconds(path / _POSES, f"{corner:.9f}") for corner in corners] if timed else None
    place = next((folder for folder in (path, *_folders(path)) if numbered(folder, (".pcd",))), path)
    scans = numbered(place, (".pcd",))
    return posed_scans.source(path, "BALM folder", path / _POSES, list(scans.values()), poses, stamps)


def _folders(path: Path) -> list[Path]:
    return [path / name for name in sorted(os.listdir(path)) if os.path.isdir(path / name)]
