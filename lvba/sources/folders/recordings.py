"""Folders that lvba opens as they are (FAST-LIVO2, Global-LVBA, KITTI odometry): to look at, or to write as a bag."""

import os
from functools import partial
from pathlib import Path

import numpy as np

from lvba.dataset import Dataset
from lvba.io import kitti, tum
from lvba.io.dataset import SCAN_FOLDERS, SCAN_POSES, open_dataset
from lvba.sources.folders import posed_scans, tables
from lvba.sources.folders.depth_scans import IMAGE_FRAME, image_item
from lvba.sources.folders.items import FolderSource, Item, StreamKind, at_hand
from lvba.sources.source import Kind, KnownGeometry, PoseSample
from lvba.trajectory import Trajectory

FRAME = "body"
RECORDING = "recording folder"
"""Format of their description."""
_OPENED = "lvba opens this folder as it is: it need not be imported."


def is_one(path: Path) -> bool:
    """Whether a folder is a recording already."""
    if kitti.is_kitti(path):
        return True
    folder = next((path / name for name in SCAN_FOLDERS if os.path.isdir(path / name)), None)
    return folder is not None and (os.path.exists(folder / SCAN_POSES) or os.path.exists(path / SCAN_POSES))


def open_folder(path: Path) -> FolderSource:
    """The recording; its images have poses of their own.

    Raises: InputError as `lvba.io.dataset.open_dataset`.
    """
    dataset = open_dataset(path)
    scans = stamps(dataset.scan_stamps, dataset.scans)
    items = [
        Item(stamp, "scans", partial(posed_scans.read, Path(file), stamp, FRAME), file)
        for stamp, file in zip(scans, dataset.scan_paths, strict=True)
    ]
    items += _poses("scan_poses", FRAME, scans, dataset.scans, dataset.origin)
    streams = [
        StreamKind("scans", Kind.SCANS, "scan files"),
        StreamKind("scan_poses", Kind.POSES, "TUM poses"),
    ]
    if dataset.image_paths:
        images = stamps(dataset.image_stamps, dataset.images)
        items += [
            image_item("images", Path(file), stamp)
            for stamp, file in zip(images, dataset.image_paths, strict=True)
        ]
        items += _poses("camera_poses", IMAGE_FRAME, images, dataset.images, dataset.origin)
        streams += [
            StreamKind("images", Kind.IMAGES, "image files"),
            StreamKind("camera_poses", Kind.POSES, "poses of the camera"),
        ]
    return FolderSource(path, RECORDING, streams, items, _known(dataset), (*dataset.warnings, _OPENED))


def _known(dataset: Dataset) -> KnownGeometry:
    if not dataset.cameras:
        return KnownGeometry(body_from_lidar=np.eye(4), deskewed=True)
    return KnownGeometry(
        camera=dataset.camera,
        camera_from_lidar=dataset.camera_from_scan,
        body_from_lidar=np.eye(4),
        deskewed=True,
    )


def stamps(texts: tuple[str, ...], trajectory: Trajectory) -> list[int]:
    """ns of the frames of a recording, by the digits that it has (`Dataset.scan_stamps`), else by their times."""
    return [
        tables.nanoseconds("time", text)
        for text in texts or tuple(tum.time_text(time) for time in trajectory.times)
    ]


def _poses(
    stream: str, child: str, stamps: list[int], trajectory: Trajectory, origin: np.ndarray
) -> list[Item]:
    items = []
    for stamp, pose in zip(stamps, trajectory.world_from_sensor, strict=True):
        moved = pose.copy()
        moved[:3, 3] += origin
        items.append(at_hand(stamp, stream, PoseSample(stamp, "world", child, moved)))
    return items
