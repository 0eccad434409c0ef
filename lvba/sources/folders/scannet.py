"""A scan of ScanNet, exported by its SensReader.

    SCENE/
      color/0.jpg ...   depth/0.png ... (16 bits, mm, another size)   pose/0.txt ... (4x4, world from camera; -inf: lost)
      intrinsic/intrinsic_color.txt  intrinsic_depth.txt  extrinsic_color.txt  extrinsic_depth.txt (4x4)

Axes of the camera: x right, y down, z forward. There are no times: 30 frames a second are assumed. Depth and colour are
taken to be at one place where the two extrinsic files are the identity, as they are in the data set.
Source: Dai et al. 2017 and the SensReader of its repository.
"""

import os
from pathlib import Path

import numpy as np

from lvba.camera import Camera
from lvba.errors import InputError
from lvba.io.image_header import ImageSize
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
from lvba.sources.folders.items import XYZ, FolderSource, Item, StreamKind, need_folder, numbered
from lvba.sources.source import Kind, KnownGeometry

_MM = 1e-3


def is_one(path: Path) -> bool:
    """Whether a folder has this layout."""
    return all(os.path.isdir(path / name) for name in ("color", "depth", "pose", "intrinsic"))


def open_folder(path: Path) -> FolderSource:
    """The recording.

    Raises: InputError if a file is missing or malformed, or the extrinsics are not the identity.
    """
    for name in ("color", "depth", "pose", "intrinsic"):
        need_folder(path / name, "export it from the .sens file again")
    colors, depths = numbered(path / "color", (".jpg", ".jpeg", ".png")), numbered(path / "depth", (".png",))
    if not colors or not depths:
        raise InputError(path, "has no colour or no depth images", "export them from the .sens file")
    _check_extrinsics(path / "intrinsic")
    camera = _camera(path / "intrinsic" / "intrinsic_color.txt", size_of_first(colors.values()))
    depth_size = size_of_first(depths.values())
    depth_camera = DepthCamera(_camera(path / "intrinsic" / "intrinsic_depth.txt", depth_size), _MM)
    items: list[Item] = [image_item("color", file, number * PERIOD_NS) for number, file in colors.items()]
    items += [depth_camera.item("depth", file, number * PERIOD_NS) for number, file in depths.items()]
    poses, lost = pose_items(numbered(path / "pose", (".txt",)), _pose)
    if not poses:
        raise InputError(path / "pose", "holds no pose that is finite", "export the poses again")
    items += poses
    notes = [NO_TIMES, *depth_camera.notes, *lost]
    streams = [
        StreamKind("color", Kind.IMAGES, image_files(colors.values())),
        StreamKind("depth", Kind.SCANS, "depth images, mm", XYZ),
        StreamKind("pose", Kind.POSES, "4x4 matrices"),
    ]
    known = KnownGeometry(
        camera=camera, camera_from_lidar=np.eye(4), body_from_lidar=np.eye(4), deskewed=True
    )
    return FolderSource(path, "ScanNet folder", streams, items, known, notes)


def _camera(file: Path, size: ImageSize) -> Camera:
    matrix = tables.matrix_file(file)
    return tables.pinhole(file, matrix, size)


def _check_extrinsics(folder: Path) -> None:
    for name in ("extrinsic_color.txt", "extrinsic_depth.txt"):
        if os.path.isfile(folder / name):
            matrix = tables.matrix_file(folder / name)
            if matrix.shape != (4, 4) or not np.abs(matrix - np.eye(4)).max() < 1e-6:
                problem = "is not the identity, and its direction is not known here"
                raise InputError(
                    folder / name, problem, "register depth to colour first, and write the identity"
                )


def _pose(file: Path) -> np.ndarray | None:
    matrix = tables.matrix_file(file)
    if matrix.shape != (4, 4):
        raise InputError(file, "is no 4x4 matrix", "export it again")
    return matrix if np.isfinite(matrix).all() else None
