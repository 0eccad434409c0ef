"""Raw data of the Polycam app (LiDAR mode, developer export).

    CAPTURE/keyframes/
      corrected_images/N.jpg corrected_cameras/N.json (after Polycam's own adjustment), or images/ and cameras/
      depth/N.png (16 bits, mm)     confidence/N.png (0: low)

A camera file has t_00 to t_23 (rows of world from camera, ARKit's axes: x right, y up, z back), fx fy cx cy, width and
height of the image. The world has y up. Source: Polycam's poly repository, and nerfstudio's reader.
"""

import os
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from lvba.arrays import Pose
from lvba.camera import Camera
from lvba.errors import InputError
from lvba.io import depth, json_files
from lvba.io.camera_keys import as_float
from lvba.sources.folders import tables
from lvba.sources.folders.depth_scans import FRAME, DepthCamera, image_item, image_size
from lvba.sources.folders.items import XYZ, FolderSource, Item, StreamKind, at_hand, numbered
from lvba.sources.source import Kind, KnownGeometry, PoseSample, RawScan

_MM = 1e-3
_PERIOD_NS = 100_000_000
_KEYS = tuple(f"t_{row}{column}" for row in range(3) for column in range(4))
_ONE_CAMERA = 0.01
"""Part by which focal lengths of the frames may differ and still be one camera."""


@dataclass(frozen=True)
class _Frame:
    """Camera and pose (world from camera, z forward) of one image."""

    camera: Camera
    pose: Pose


def is_one(path: Path) -> bool:
    """Whether a folder has this layout."""
    frames = path / "keyframes"
    return os.path.isdir(frames / "depth") and any(
        os.path.isdir(frames / name) for name in ("cameras", "corrected_cameras")
    )


def open_folder(path: Path) -> FolderSource:
    """The recording.

    Raises: InputError if a file is missing or malformed, or the frames are of different cameras.
    """
    folder = path / "keyframes"
    corrected = all(os.path.isdir(folder / f"corrected_{name}") for name in ("cameras", "images"))
    prefix = "corrected_" if corrected else ""
    frames = {
        number: _frame(file) for number, file in numbered(folder / f"{prefix}cameras", (".json",)).items()
    }
    images = numbered(folder / f"{prefix}images", (".jpg", ".jpeg", ".png"))
    depths = numbered(folder / "depth", (".png",))
    confidence = numbered(folder / "confidence", (".png",)) if os.path.isdir(folder / "confidence") else {}
    used = [number for number in frames if number in images and number in depths]
    if not used:
        raise InputError(
            folder, "no frame has a camera, an image and a depth image", "export the raw data again"
        )
    camera, notes = _one_camera(folder, [frames[number].camera for number in used])
    items: list[Item] = []
    for index, number in enumerate(used):
        stamp = index * _PERIOD_NS
        items.append(image_item("images", images[number], stamp))
        sure = partial(_trusted, confidence[number]) if number in confidence else None
        items.append(_scan(depths[number], frames[number].camera, stamp, sure))
        items.append(at_hand(stamp, "poses", PoseSample(stamp, "world", FRAME, frames[number].pose)))
    streams = [
        StreamKind("images", Kind.IMAGES, f"{prefix}images"),
        StreamKind("depth", Kind.SCANS, "depth images, mm", XYZ),
        StreamKind("poses", Kind.POSES, f"{prefix}cameras"),
    ]
    notes += ["it has no times that are known: the frames are in the order of their names, 10 a second."]
    known = KnownGeometry(
        camera=camera, camera_from_lidar=np.eye(4), body_from_lidar=np.eye(4), deskewed=True
    )
    return FolderSource(path, "Polycam raw data", streams, items, known, notes)


def _frame(file: Path) -> _Frame:
    document = json_files.read_mapping(file, "export it again", 1024 * 1024)
    names = (*_KEYS, "fx", "fy", "cx", "cy", "width", "height")
    values = {name: as_float(document.get(name)) for name in names}
    missing = next((name for name, value in values.items() if value is None), None)
    if missing is not None:
        raise InputError(file, f"{missing} is no number", "export it again")
    matrix = np.eye(4)
    matrix[:3] = np.array([values[key] for key in _KEYS], float).reshape(3, 4)
    intrinsics = np.eye(3)
    intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]] = [values[key] or 0.0 for key in ("fx", "fy", "cx", "cy")]
    size = tables.image_size(file, values["width"] or 0.0, values["height"] or 0.0)
    return _Frame(tables.pinhole(file, intrinsics, size), tables.from_opengl(tables.pose(file, matrix)))


def _one_camera(folder: Path, cameras: list[Camera]) -> tuple[Camera, list[str]]:
    """The camera of the middle (median) focal length; its autofocus moves it a little."""
    values = np.array([[camera.fx, camera.fy, camera.cx, camera.cy] for camera in cameras])
    middle = np.median(values, axis=0)
    spread = float(np.abs(values[:, :2] / middle[:2] - 1).max())
    sizes = {(camera.width, camera.height) for camera in cameras}
    if len(sizes) > 1 or spread > _ONE_CAMERA:
        problem = f"its frames are of different cameras: focal lengths differ by {100 * spread:.1f} %"
        raise InputError(folder, problem, "give frames of one camera")
    width, height = sizes.pop()
    fx, fy, cx, cy = (float(value) for value in middle)
    notes = [
        f"focal lengths of the frames differ by up to {100 * spread:.2f} %: the median is taken for images."
    ]
    return Camera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy), notes if spread > 1e-6 else []


def _scan(file: Path, camera: Camera, stamp: int, sure: partial[np.ndarray] | None) -> Item:
    """Its own rays, made when it is its turn: each frame has its own focal length."""

    def load() -> RawScan:
        size = image_size(file)
        scaled = camera.scaled(size.width / camera.width)
        if (scaled.width, scaled.height) != (size.width, size.height):
            problem = (
                f"{size.width} x {size.height} px is no scaled image of {camera.width} x {camera.height}"
            )
            raise InputError(file, problem, "export it again")
        return DepthCamera(scaled, _MM).scan(file, stamp, None if sure is None else sure())

    return Item(stamp, "depth", load, str(file))


def _trusted(file: Path) -> np.ndarray:
    return depth.read_depth(file) > 0
