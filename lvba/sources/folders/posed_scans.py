"""Folders of LiDAR scans with one pose each."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from lvba.arrays import Pose
from lvba.errors import InputError
from lvba.io import pcd, velodyne
from lvba.sources.folders.items import FolderSource, Item, StreamKind, at_hand
from lvba.sources.source import Kind, KnownGeometry, PoseSample, RawScan

FRAME = "lidar"
_PERIOD_NS = 100_000_000


def source(
    path: Path,
    form: str,
    pose_file: Path,
    scans: Sequence[Path],
    poses: Sequence[Pose],
    stamps: Sequence[int] | None,
    deskewed: bool = True,
    notes: Sequence[str] = (),
) -> FolderSource:
    """The scans of a folder, in order, with their poses.

    form: of the folder, for people; stamps: ns; None: there are no times, 10 scans a second are assumed
    Raises: InputError if there are not as many scans as poses.
    """
    if len(scans) != len(poses) or not poses:
        problem = f"has {len(poses)} poses, but there are {len(scans)} scans"
        raise InputError(pose_file, problem, "give one pose for each scan, in order")
    said = list(notes)
    if stamps is None:
        stamps = [index * _PERIOD_NS for index in range(len(poses))]
        said.append("it has no times: 10 scans a second are assumed.")
    items = []
    for scan, pose, stamp in zip(scans, poses, stamps, strict=True):
        items.append(Item(stamp, "scans", partial(read, scan, stamp, FRAME), str(scan)))
        items.append(at_hand(stamp, "poses", PoseSample(stamp, "world", FRAME, pose)))
    kinds = "/".join(sorted({scan.suffix[1:].upper() for scan in scans}))
    streams = [
        StreamKind("scans", Kind.SCANS, f"{kinds} files"),
        StreamKind("poses", Kind.POSES, pose_file.name),
    ]
    return FolderSource(
        path, form, streams, items, KnownGeometry(body_from_lidar=np.eye(4), deskewed=deskewed), said
    )


def read(path: Path, stamp: int, frame: str) -> RawScan:
    """The scan of a PCD or BIN file. stamp: ns; frame: of its points

    Raises: InputError if the file is damaged.
    """
    scan = velodyne.read_bin(path) if path.suffix.lower() == velodyne.SUFFIX else pcd.read_pcd(path)
    return RawScan(
        stamp=stamp,
        frame=frame,
        points=scan.points,
        intensity=None if scan.intensity is None else scan.intensity.astype(np.float32),
        times=scan.time,
        time_field="" if scan.time is None else "time",
    )
