"""A recording of the Stray Scanner app (iPhones and iPads with a LiDAR).

    RECORDING/
      rgb.mp4              frame after frame as in odometry.csv
      depth/000000.png     16 bits, mm, 256x192        confidence/000000.png: 0, 1 or 2
      odometry.csv         timestamp, frame, x, y, z, qx, qy, qz, qw: world from camera, x right, y down, z forward
      camera_matrix.csv    3x3, of the video           imu.csv: timestamp, a_x, ... (g), alpha_x, ... (rad/s)

The app turns ARKit's axes (y up, z back) before it writes. Depth is at the place of the colour image, at another scale.
Points of confidence 0 are left out. Source: the app's repository (OdometryEncoder, IMUEncoder, DatasetEncoder).
"""

import os
from functools import partial
from pathlib import Path

import numpy as np

from lvba.camera import Camera
from lvba.errors import InputError
from lvba.io import depth
from lvba.io.image_header import ImageSize
from lvba.io.video import Video
from lvba.sources.folders import tables
from lvba.sources.folders.depth_scans import FRAME, IMAGE_FRAME, DepthCamera, size_of_first
from lvba.sources.folders.items import XYZ, FolderSource, Item, StreamKind, at_hand, need_folder, numbered
from lvba.sources.source import ImuSample, Kind, KnownGeometry, PoseSample, RawImage

_MM = 1e-3
_ODOMETRY = "timestamp, frame, x, y, z, qx, qy, qz, qw"
_IMU = "timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z"


def is_one(path: Path) -> bool:
    """Whether a folder has this layout."""
    return all(os.path.isfile(path / name) for name in ("odometry.csv", "camera_matrix.csv"))


def open_folder(path: Path) -> FolderSource:
    """The recording.

    Raises: InputError if a file is missing or malformed.
    """
    need_folder(path / "depth", "copy the recording again")
    video = Video(path / "rgb.mp4")
    size = ImageSize(*video.size())
    matrix = path / "camera_matrix.csv"
    camera = tables.pinhole(matrix, tables.matrix_file(matrix), size)
    rows = _rows(path / "odometry.csv")
    depths = {number: file for number, file in numbered(path / "depth", (".png",)).items() if number in rows}
    if not depths:
        raise InputError(
            path / "depth", "holds no depth image that odometry.csv names", "copy the recording again"
        )
    depth_camera = _depth_camera(camera, list(depths.values()))
    confidence = numbered(path / "confidence", (".png",)) if os.path.isdir(path / "confidence") else {}
    items: list[Item] = []
    for number, (stamp, pose) in rows.items():
        items.append(at_hand(stamp, "odometry", PoseSample(stamp, "world", FRAME, pose)))
        items.append(Item(stamp, "rgb", partial(_frame, video, number, stamp)))
        if number in depths:
            sure = partial(_trusted, confidence[number]) if number in confidence else None
            items.append(depth_camera.item("depth", depths[number], stamp, sure))
    items += _imu(path / "imu.csv")
    streams = [
        StreamKind("rgb", Kind.IMAGES, "frames of a video"),
        StreamKind("depth", Kind.SCANS, "depth images, mm", XYZ),
        StreamKind("odometry", Kind.POSES, "ARKit's poses"),
        StreamKind("imu", Kind.IMU, "CSV"),
    ]
    notes = ["the camera has a rolling shutter and automatic exposure.", "where the IMU is, no file says."]
    if video.count() and video.count() != len(rows):
        notes.append(f"rgb.mp4 has {video.count()} frames, odometry.csv {len(rows)} lines.")
    known = KnownGeometry(camera=camera, camera_from_lidar=np.eye(4), body_from_lidar=None, deskewed=True)
    return FolderSource(path, "Stray Scanner folder", streams, items, known, notes)


def _depth_camera(camera: Camera, images: list[Path]) -> DepthCamera:
    size = size_of_first(images)
    factor = size.width / camera.width
    scaled = camera.scaled(factor)
    if (scaled.width, scaled.height) != (size.width, size.height):
        problem = f"{size.width} x {size.height} px is no scaled image of {camera.width} x {camera.height}"
        raise InputError(images[0], problem, "copy the recording again")
    return DepthCamera(scaled, _MM)


def _trusted(file: Path) -> np.ndarray:
    return depth.read_depth(file) >= 1


def _frame(video: Video, number: int, stamp: int) -> RawImage:
    return RawImage(stamp=stamp, frame=IMAGE_FRAME, pixels=video.frame(number))


def _rows(path: Path) -> dict[int, tuple[int, np.ndarray]]:
    """Time (ns) and pose of each frame."""
    rows = {}
    for number, words in tables.lines_of_words(path, ","):
        where = f"{path}:{number}"
        if words[0].lower() == "timestamp":
            continue
        values = tables.numbers(where, words[:9], 9, _ODOMETRY)
        pose = tables.quaternion_pose(where, values[2:5], values[5:9])
        if values[1] != int(values[1]) or values[1] < 0:
            raise InputError(where, "frame is no number of a frame", f"write {_ODOMETRY}")
        rows[int(values[1])] = (tables.nanoseconds(where, words[0]), pose)
    if not rows:
        raise InputError(path, "holds no poses", f"write {_ODOMETRY} a line")
    return rows


def _imu(path: Path) -> list[Item]:
    items: list[Item] = []
    if not os.path.isfile(path):
        return items
    for number, words in tables.lines_of_words(path, ","):
        if words[0].lower() == "timestamp":
            continue
        values = tables.numbers(f"{path}:{number}", words, 7, _IMU)
        stamp = tables.nanoseconds(f"{path}:{number}", words[0])
        items.append(at_hand(stamp, "imu", ImuSample(stamp, "imu", values[4:7], values[1:4])))
    return items
