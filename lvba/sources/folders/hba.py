"""Input of HBA: numbered deskewed scans and a pose for each, without times.

    FOLDER/ pcd/0.pcd 1.pcd ...   pose.json: tx ty tz qw qx qy qz a line (w first; it is no JSON)

10 scans a second are assumed. Source: the readme and issues of hku-mars/HBA.
"""

import os
from pathlib import Path

import numpy as np

from lvba.errors import InputError
from lvba.sources.folders import posed_scans, tables
from lvba.sources.folders.items import FolderSource, numbered

_POSES = "pose.json"
_LINE = "tx ty tz qw qx qy qz a line"


def is_one(path: Path) -> bool:
    """Whether a folder has this layout."""
    return os.path.isfile(path / _POSES) and os.path.isdir(path / "pcd")


def open_folder(path: Path) -> FolderSource:
    """The recording.

    Raises: InputError if poses and scans do not go together, or quaternions seem to be written w last.
    """
    poses: list[np.ndarray] = []
    for number, words in tables.lines_of_words(path / _POSES):
        where = f"{path / _POSES}:{number}"
        row = tables.numbers(where, words, 7, _LINE)
        if not poses and np.allclose(row[3:], [0, 0, 0, 1]):
            problem = "the first quaternion is 0 0 0 1: they seem to be written w last"
            raise InputError(where, problem, f"write {_LINE}")
        poses.append(tables.quaternion_pose(where, row[:3], row[[4, 5, 6, 3]]))
    scans = numbered(path / "pcd", (".pcd",))
    return posed_scans.source(path, "HBA folder", path / _POSES, list(scans.values()), poses, None)
