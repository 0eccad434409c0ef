"""KITTI-360: a drive of the whole data set's folder.

    KITTI-360/
      calibration/{perspective.txt, calib_cam_to_pose.txt, calib_cam_to_velo.txt}
      data_3d_raw/DRIVE/velodyne_points/{timestamps.txt, data/0000000000.bin}
      data_2d_raw/DRIVE/image_00/{timestamps.txt, data_rect/0000000000.png}
      data_poses/DRIVE/{poses.txt, cam0_to_world.txt}      also beside velodyne_points

poses.txt: number of a frame and 12 numbers, world from IMU; for some frames only. cam0_to_world.txt: number and 16
numbers, of the RECTIFIED camera 0. calib_cam_to_pose and calib_cam_to_velo are of the camera before rectification.
timestamps.txt of the LiDAR: when it looks forward, in the middle of a sweep. Source: the data set's kitti360Scripts.
"""

import os
from pathlib import Path

import numpy as np

from lvba import geometry
from lvba.arrays import Pose
from lvba.camera import Camera
from lvba.errors import InputError
from lvba.io import files
from lvba.sources.folders import tables, velodyne_sweeps
from lvba.sources.folders.depth_scans import image_files, image_item, size_of_first
from lvba.sources.folders.items import FolderSource, Item, StreamKind, at_hand, files_of_times
from lvba.sources.folders.kitti_raw import rectified
from lvba.sources.source import Kind, KnownGeometry, PoseSample

_SCANS = "data_3d_raw"
_IMAGES = "image_00"
_LONGEST_SWEEP_NS = 500_000_000


def is_one(path: Path) -> bool:
    """Whether a folder is the data set's, data_3d_raw, or a drive in it."""
    whole = Path(os.path.abspath(path))
    drive = whole.parent.name == _SCANS and os.path.isdir(path / "velodyne_points")
    return drive or os.path.isdir(path / _SCANS) or whole.name == _SCANS


def open_folder(path: Path) -> FolderSource:
    """The drive, or the only one of the data set's folder.

    Raises: InputError if there are several, or a file is missing or malformed.
    """
    root, drive = _root_and_drive(path)
    scan_folder = root / _SCANS / drive / "velodyne_points"
    scan_times = tables.dates(scan_folder / "timestamps.txt")
    calibration = root / "calibration"
    camera0_from_velodyne = geometry.inverse(_bare(calibration / "calib_cam_to_velo.txt"))
    imu_from_camera0 = tables.pose(
        calibration / "calib_cam_to_pose.txt",
        tables.need_rows(calibration / "calib_cam_to_pose.txt", {_IMAGES: 12})[_IMAGES].reshape(3, 4),
    )
    imu_from_velodyne = np.asarray(imu_from_camera0 @ camera0_from_velodyne)
    items = _scans(scan_folder, scan_times)
    streams = [
        StreamKind("velodyne_points", Kind.SCANS, "BIN files, times by azimuth", velodyne_sweeps.FIELDS)
    ]
    camera: Camera | None = None
    camera_from_lidar: Pose | None = None
    image_folder = root / "data_2d_raw" / drive / _IMAGES
    if os.path.isdir(image_folder / "data_rect"):
        pictures = _images(image_folder)
        items += pictures
        kind = image_files(Path(picture.path) for picture in pictures)
        streams.append(StreamKind(_IMAGES, Kind.IMAGES, f"{kind}, rectified"))
        perspective = calibration / "perspective.txt"
        rows = tables.need_rows(perspective, {"P_rect_00": 12, "R_rect_00": 9})
        camera, camera_from_lidar = rectified(
            perspective,
            rows["P_rect_00"],
            rows["R_rect_00"],
            camera0_from_velodyne,
            size_of_first(Path(picture.path) for picture in pictures),
        )
    poses = _poses(root, drive, scan_times, imu_from_velodyne, camera_from_lidar)
    items += poses
    notes = ["scans are not deskewed: points have times by their azimuth, clockwise from behind."]
    if poses:
        streams.append(StreamKind("poses", Kind.POSES, "matrices"))
        notes.append(
            f"{len(poses)} of {len(scan_times)} frames have a pose; it is taken for the time of the LiDAR."
        )
    known = KnownGeometry(
        camera=camera, camera_from_lidar=camera_from_lidar, body_from_lidar=imu_from_velodyne, deskewed=False
    )
    return FolderSource(path, f"KITTI-360 drive {drive}", streams, items, known, notes)


def _root_and_drive(path: Path) -> tuple[Path, str]:
    whole = Path(os.path.abspath(path))
    if whole.parent.name == _SCANS:
        return whole.parent.parent, whole.name
    if whole.name == _SCANS:
        path = whole.parent
    drives = [
        name
        for name in files.names_in(path / _SCANS)
        if os.path.isdir(path / _SCANS / name / "velodyne_points")
    ]
    if not drives:
        raise InputError(
            path / _SCANS, "holds no DRIVE/velodyne_points", "unpack the raw Velodyne scans there"
        )
    if len(drives) > 1:
        problem = f"has {len(drives)} drives: {', '.join(drives[:4])}"
        raise InputError(path / _SCANS, problem, f"give one, {path / _SCANS / drives[0]}")
    return path, drives[0]


def _bare(path: Path) -> Pose:
    """(4, 4) of a file of 12 numbers."""
    matrix = tables.matrix_file(path)
    if matrix.size != 12:
        raise InputError(path, f"{matrix.size} numbers instead of 12", "copy it again")
    return tables.pose(path, matrix.reshape(3, 4))


def _scans(folder: Path, stamps: list[int]) -> list[Item]:
    paths = files_of_times(folder / "data", (".bin",), len(stamps), folder / "timestamps.txt")
    steps = np.diff(stamps)
    sweep = int(np.median(steps)) if len(steps) else 100_000_000
    if not 0 < sweep < _LONGEST_SWEEP_NS:
        raise InputError(folder / "timestamps.txt", f"sweeps take {sweep / 1e9:g} s", "copy it again")
    return [
        velodyne_sweeps.item("velodyne_points", path, stamps[number] - sweep // 2, sweep)
        for number, path in paths.items()
    ]


def _images(folder: Path) -> list[Item]:
    stamps = tables.dates(folder / "timestamps.txt")
    paths = files_of_times(folder / "data_rect", (".png", ".jpg"), len(stamps), folder / "timestamps.txt")
    return [image_item(_IMAGES, path, stamps[number], _IMAGES) for number, path in paths.items()]


def _poses(
    root: Path, drive: str, stamps: list[int], imu_from_velodyne: Pose, camera_from_lidar: Pose | None
) -> list[Item]:
    """Poses of the LiDAR by poses.txt, or else by cam0_to_world.txt."""
    for place in (root / "data_poses" / drive, root / _SCANS / drive):
        if os.path.isfile(place / "poses.txt"):
            return _pose_file(place / "poses.txt", 12, stamps, imu_from_velodyne)
        if os.path.isfile(place / "cam0_to_world.txt") and camera_from_lidar is not None:
            return _pose_file(place / "cam0_to_world.txt", 16, stamps, camera_from_lidar)
    return []


def _pose_file(path: Path, count: int, stamps: list[int], sensor_from_velodyne: Pose) -> list[Item]:
    items = []
    for line, words in tables.lines_of_words(path):
        where = f"{path}:{line}"
        row = tables.numbers(where, words, count + 1, f"number of the frame and {count} numbers")
        number = int(row[0])
        if number != row[0] or not 0 <= number < len(stamps):
            raise InputError(where, f"there is no time for frame {row[0]:g}", "copy the time stamps again")
        pose = tables.pose(where, row[1:].reshape(-1, 4)) @ sensor_from_velodyne
        stamp = stamps[number]
        items.append(
            at_hand(stamp, "poses", PoseSample(stamp, "world", velodyne_sweeps.FRAME, np.asarray(pose)))
        )
    return items
