"""A sequence of numbered frames as 7-Scenes has them, also of 3DMatch and BundleFusion.

    SEQUENCE/
      frame-000000.color.png (or .jpg)   frame-000000.depth.png (16 bits, mm; 0 and 65535: nothing measured)
      frame-000000.pose.txt              4x4, world from depth camera; not finite: tracking was lost
      camera.yaml                        not of the data sets: color camera, in any format of `lvba.sources.calibrations`
      info.txt                           BundleFusion: m_calibrationColorIntrinsic, m_calibrationDepthIntrinsic, ...
      camera-intrinsics.txt              3DMatch, there or one folder up: K of the depth camera

Axes of the cameras: x right, y down, z forward. There are no times: 30 frames a second are assumed. 7-Scenes has no
calibration, only the intrinsics that its poses were made with; color and depth cameras of a Kinect are 25 mm apart.
Source: Shotton et al. 2013, Zeng et al. 2017, Dai et al. 2017 and the pages of their data.
"""

import os
from pathlib import Path

import numpy as np

from lvba.camera import Camera
from lvba.errors import InputError
from lvba.io import files
from lvba.io.image_header import ImageSize
from lvba.sources import calibrations
from lvba.sources.folders import tables
from lvba.sources.folders.depth_scans import (
    NO_TIMES,
    PERIOD_NS,
    DepthCamera,
    image_files,
    image_item,
    pose_items,
    size_of_first,
)
from lvba.sources.folders.items import XYZ, FolderSource, Item, StreamKind, numbered
from lvba.sources.source import Kind, KnownGeometry

_MM = 1e-3
_NOTHING = 65535
_PREFIX, _IMAGES = "frame-", (".png", ".jpg", ".jpeg")
_KINECT = ImageSize(640, 480)
_KINECT_DEPTH, _KINECT_COLOR = 585.0, 525.0
"""Focal lengths in px: of the depth camera as 7-Scenes says it, of the color camera as the driver takes it by default."""
_COLOR_FROM_DEPTH = np.array([[1.0, 0, 0, -0.025], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
_CALIBRATION, _INTRINSICS, _INFO = "camera.yaml", "camera-intrinsics.txt", "info.txt"


def is_one(path: Path) -> bool:
    """Whether a folder has this layout, by the names of its files."""
    names = files.names_in(path)
    return all(
        any(name.startswith(_PREFIX) and kind in name for name in names) for kind in (".color.", ".depth.")
    )


def open_folder(path: Path) -> FolderSource:
    """The recording.

    Raises: InputError if a file is missing or malformed, or the cameras are not known.
    """
    colors, depths = (
        numbered(path, _IMAGES, _PREFIX, ".color."),
        numbered(path, (".png",), _PREFIX, ".depth."),
    )
    known, depth_camera, origin = _cameras(
        path, size_of_first(colors.values()), size_of_first(depths.values())
    )
    items: list[Item] = [image_item("color", file, number * PERIOD_NS) for number, file in colors.items()]
    items += [depth_camera.item("depth", file, number * PERIOD_NS) for number, file in depths.items()]
    poses, lost = pose_items(numbered(path, (".txt",), _PREFIX, ".pose."), _pose)
    items += poses
    notes = [NO_TIMES, *origin, *depth_camera.notes, *lost]
    streams = [
        StreamKind("color", Kind.IMAGES, image_files(colors.values())),
        StreamKind("depth", Kind.SCANS, "depth images, mm", XYZ),
    ]
    if poses:
        streams.append(StreamKind("pose", Kind.POSES, "4x4 matrices"))
    return FolderSource(path, "folder of numbered RGB-D frames (7-Scenes)", streams, items, known, notes)


def _cameras(
    path: Path, color: ImageSize, depth: ImageSize
) -> tuple[KnownGeometry, DepthCamera, tuple[str, ...]]:
    """What the files say of the rig, the depth camera, and where both are from."""
    info = path / _INFO
    if os.path.isfile(info):
        color_matrix, depth_matrix, meters = _info(info)
        color_camera, depth_camera = (
            tables.pinhole(info, color_matrix, color),
            tables.pinhole(info, depth_matrix, depth),
        )
        known = KnownGeometry(
            camera=color_camera, camera_from_lidar=np.eye(4), body_from_lidar=np.eye(4), deskewed=True
        )
        return known, _depth_camera(depth_camera, meters), (f"intrinsics: {info}.",)
    places = [path / _INTRINSICS, path.parent / _INTRINSICS]
    file = next((place for place in places if os.path.isfile(place)), None)
    if file is not None:
        depth_camera, origin = tables.pinhole(file, tables.matrix_file(file), depth), f"depth camera: {file}."
    elif depth == _KINECT:
        depth_camera = _kinect(_KINECT_DEPTH)
        origin = f"depth camera: {_KINECT_DEPTH:g} px, as 7-Scenes says it; no file has it."
    else:
        problem = f"has no {_INTRINSICS}, and its depth images are not those of a Kinect (640 x 480 px)"
        raise InputError(path, problem, "write K of the depth camera there, 3 rows of 3 numbers")
    color_camera, camera_from_lidar, color_origin = _color(path, color)
    known = KnownGeometry(
        camera=color_camera, camera_from_lidar=camera_from_lidar, body_from_lidar=np.eye(4), deskewed=True
    )
    return known, _depth_camera(depth_camera, _MM), (origin, color_origin)


def _depth_camera(camera: Camera, meters: float) -> DepthCamera:
    return DepthCamera(camera, meters, nothing=_NOTHING)


def _kinect(focal: float) -> Camera:
    width, height = _KINECT.width, _KINECT.height
    return Camera(width=width, height=height, fx=focal, fy=focal, cx=width / 2, cy=height / 2)


def _color(path: Path, size: ImageSize) -> tuple[Camera, np.ndarray, str]:
    """The color camera, camera from depth camera, and where they are from."""
    file = path / _CALIBRATION
    if os.path.isfile(file):
        read = calibrations.read([file])
        camera = read.camera_for(size)
        if camera is None:
            raise InputError(file, "holds no camera", "write the intrinsics of the color camera there")
        given = read.camera_from_lidar
        return camera, _COLOR_FROM_DEPTH if given is None else given, f"color camera: {file}."
    if size != _KINECT:
        problem = f"has no {_CALIBRATION}, and its color images are not those of a Kinect (640 x 480 px)"
        raise InputError(path, problem, "write the intrinsics of the color camera there")
    text = (
        f"color camera: {_KINECT_COLOR:g} px and 25 mm from the depth camera, as of any Kinect: no file has it; "
        f"write {_CALIBRATION} there if it is known."
    )
    return _kinect(_KINECT_COLOR), _COLOR_FROM_DEPTH, text


def _info(file: Path) -> tuple[np.ndarray, np.ndarray, float]:
    """K of color and depth (4, 4), and m a unit of depth, of BundleFusion's file."""
    rows: dict[str, list[str]] = {}
    for line in files.read_text(file, 64 * 1024).split("\n"):
        name, _, value = line.partition("=")
        rows[name.strip()] = value.split()
    color, depth = (_matrix(file, rows, f"m_calibration{kind}Intrinsic") for kind in ("Color", "Depth"))
    for kind in ("Color", "Depth"):
        name = f"m_calibration{kind}Extrinsic"
        if name in rows and not np.abs(_matrix(file, rows, name) - np.eye(4)).max() < 1e-6:
            mend = "register depth to color first, and write the identity"
            raise InputError(file, f"{name} is not the identity, and its direction is not known here", mend)
    units = tables.numbers(file, rows.get("m_depthShift", []), 1, "m_depthShift, units a meter")[0]
    if not 1 <= units <= 1e6:
        raise InputError(file, f"m_depthShift is {units:g}", "write units a meter, 1000 for mm")
    return color, depth, 1 / float(units)


def _matrix(file: Path, rows: dict[str, list[str]], name: str) -> np.ndarray:
    return tables.numbers(file, rows.get(name, []), 16, f"{name}, 16 numbers").reshape(4, 4)


def _pose(file: Path) -> np.ndarray | None:
    """(4, 4); None where a number is none, as Windows programs write it (-1.#IND)."""
    words = files.read_text(file, 64 * 1024).split()
    if len(words) != 16:
        raise InputError(file, "is no 4x4 matrix", "copy the file again")
    if any("#" in word for word in words):
        return None
    try:
        matrix = np.array([float(word) for word in words]).reshape(4, 4)
    except ValueError as error:
        raise InputError(file, "not only numbers", "copy the file again") from error
    return matrix if np.isfinite(matrix).all() else None
