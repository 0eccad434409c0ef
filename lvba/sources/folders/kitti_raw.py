"""Raw data of KITTI: a drive of the synchronised and rectified data.

    2011_09_26/
      calib_cam_to_cam.txt  calib_velo_to_cam.txt  calib_imu_to_velo.txt
      2011_09_26_drive_0001_sync/
        image_02/{timestamps.txt, data/0000000000.png}             (also 03, 00, 01)
        velodyne_points/{timestamps_start.txt, timestamps_end.txt, data/0000000000.bin}
        oxts/{timestamps.txt, data/0000000000.txt}

Scans are not deskewed: the azimuth gives times to points. Images are rectified; camera_from_lidar = the baseline in
P_rect x R_rect_00 x calib_velo_to_cam. Poses are of the OXTS, by Mercator. Source: the readme of its development kit.
"""

import os
from pathlib import Path

import numpy as np

from lvba import geometry
from lvba.arrays import Pose
from lvba.camera import Camera
from lvba.errors import InputError
from lvba.io import files
from lvba.io.image_header import ImageSize
from lvba.sources.folders import oxts, tables, velodyne_sweeps
from lvba.sources.folders.depth_scans import image_files, image_item, size_of_first
from lvba.sources.folders.items import FolderSource, Item, StreamKind, at_hand, files_of_times
from lvba.sources.source import Kind, KnownGeometry, PoseSample

_CAMERAS = ("image_02", "image_03", "image_00", "image_01")
_CALIBRATION = "calib_cam_to_cam.txt"
_LONGEST_SWEEP_NS = 500_000_000


def is_one(path: Path) -> bool:
    """Whether a folder is a drive, or has drives."""
    return _is_drive(path) or bool(_drives(path))


def _is_drive(path: Path) -> bool:
    scans = path / "velodyne_points"
    return os.path.isdir(scans) and os.path.isfile(scans / "timestamps_start.txt")


def _drives(path: Path) -> list[Path]:
    if not os.path.isfile(path / _CALIBRATION):
        return []
    return [path / name for name in files.names_in(path) if _is_drive(path / name)]


def open_folder(path: Path) -> FolderSource:
    """The drive, or the only one of a day.

    Raises: InputError if there are several, or a file is missing or malformed.
    """
    if not _is_drive(path):
        drives = _drives(path)
        if len(drives) > 1:
            names = ", ".join(drive.name for drive in drives[:4])
            raise InputError(path, f"has {len(drives)} drives: {names}", f"give one, {drives[0]}")
        path = drives[0]
    calibration = _calibration_folder(path)
    imu_from_velodyne = geometry.inverse(_rigid(calibration / "calib_imu_to_velo.txt"))
    streams = [
        StreamKind("velodyne_points", Kind.SCANS, "BIN files, times by azimuth", velodyne_sweeps.FIELDS)
    ]
    items = _scans(path / "velodyne_points")
    notes = ["scans are not deskewed: points have times by their azimuth, clockwise from behind."]
    camera, camera_from_lidar = None, None
    present = [name for name in _CAMERAS if os.path.isdir(path / name / "data")]
    if present:
        name = present[0]
        pictures = _images(path / name)
        items += pictures
        kind = image_files(Path(picture.path) for picture in pictures)
        streams.append(StreamKind(name, Kind.IMAGES, f"{kind}, rectified"))
        camera, camera_from_lidar = _camera(
            calibration, name, size_of_first(Path(picture.path) for picture in pictures)
        )
        notes += [f"of several cameras {name} is read."] if len(present) > 1 else []
    if os.path.isdir(path / "oxts" / "data"):
        items += _oxts(path / "oxts", imu_from_velodyne)
        streams += [StreamKind("oxts", Kind.POSES, "OXTS, Mercator"), StreamKind("gnss", Kind.GNSS, "OXTS")]
        notes.append("poses of the OXTS may jump by decimeters where its satellites change.")
    known = KnownGeometry(
        camera=camera, camera_from_lidar=camera_from_lidar, body_from_lidar=imu_from_velodyne, deskewed=False
    )
    return FolderSource(path, "KITTI raw drive", streams, items, known, notes)


def _calibration_folder(path: Path) -> Path:
    """Where the files of the day are: above the drive, or in it."""
    for folder in (Path(os.path.abspath(path)).parent, path):
        if os.path.isfile(folder / _CALIBRATION):
            return folder
    mend = "unpack the calibration of the day (2011_09_26_calib.zip and the like) into the folder above the drive"
    raise InputError(Path(os.path.abspath(path)).parent / _CALIBRATION, "there is no such file", mend)


def _scans(folder: Path) -> list[Item]:
    begins, ends = (tables.dates(folder / f"timestamps_{name}.txt") for name in ("start", "end"))
    paths = files_of_times(
        folder / "data", (".bin",), min(len(begins), len(ends)), folder / "timestamps_start.txt"
    )
    items = []
    for number, path in paths.items():
        sweep = ends[number] - begins[number]
        if not 0 < sweep < _LONGEST_SWEEP_NS:
            where = f"{folder / 'timestamps_end.txt'}:{number + 1}"
            raise InputError(where, f"the sweep takes {sweep / 1e9:g} s", "copy the files again")
        items.append(velodyne_sweeps.item("velodyne_points", path, begins[number], sweep))
    return items


def _images(folder: Path) -> list[Item]:
    stamps = tables.dates(folder / "timestamps.txt")
    paths = files_of_times(folder / "data", (".png", ".jpg"), len(stamps), folder / "timestamps.txt")
    return [image_item(folder.name, path, stamps[number], folder.name) for number, path in paths.items()]


def _oxts(folder: Path, imu_from_velodyne: Pose) -> list[Item]:
    stamps = tables.dates(folder / "timestamps.txt")
    paths = files_of_times(folder / "data", (".txt",), len(stamps), folder / "timestamps.txt")
    rows = np.array([oxts.read(path) for path in paths.values()])
    items = []
    for number, row, pose in zip(paths, rows, oxts.poses(rows), strict=True):
        stamp = stamps[number]
        sample = PoseSample(stamp, "world", velodyne_sweeps.FRAME, np.asarray(pose @ imu_from_velodyne))
        items += [at_hand(stamp, "oxts", sample), at_hand(stamp, "gnss", oxts.fix(row, stamp))]
    return items


def _rigid(path: Path) -> Pose:
    """R and T of a file as (4, 4)."""
    rows = tables.need_rows(path, {"R": 9, "T": 3})
    return tables.pose(path, np.column_stack([rows["R"].reshape(3, 3), rows["T"]]))


def _camera(calibration: Path, name: str, size: ImageSize) -> tuple[Camera, Pose]:
    """The rectified camera, and camera from LiDAR."""
    path, index = calibration / _CALIBRATION, name[-2:]
    rows = tables.need_rows(path, {f"P_rect_{index}": 12, "R_rect_00": 9})
    camera0_from_velodyne = _rigid(calibration / "calib_velo_to_cam.txt")
    return rectified(path, rows[f"P_rect_{index}"], rows["R_rect_00"], camera0_from_velodyne, size)


def rectified(
    path: Path,
    projection: np.ndarray,
    rectification: np.ndarray,
    camera0_from_velodyne: Pose,
    size: ImageSize,
) -> tuple[Camera, Pose]:
    """A rectified camera, and camera from LiDAR (4, 4), of P = K [I | t] and the rotation that rectifies camera 0.

    projection: (12,) float64, px, rectification: (9,) float64, row by row; camera0_from_velodyne: not rectified
    Raises: InputError if they are none.
    """
    projection = projection.reshape(3, 4)
    camera = tables.pinhole(path, projection[:, :3], size)
    rectify = tables.pose(path, np.column_stack([rectification.reshape(3, 3), np.zeros(3)]))
    baseline = np.eye(4)
    column = projection[:, 3]  # K t, solved from below: K is upper triangular
    baseline[2, 3] = column[2]
    baseline[1, 3] = (column[1] - camera.cy * column[2]) / camera.fy
    baseline[0, 3] = (column[0] - camera.cx * column[2]) / camera.fx
    return camera, np.asarray(baseline @ rectify @ camera0_from_velodyne)
