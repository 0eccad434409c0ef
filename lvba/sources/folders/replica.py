"""Rendered sequences of Replica as NICE-SLAM made them; GS-SDF and others use the same.

    SCENE/
      results/frame000000.jpg ...  depth000000.png ...
      traj.txt                      16 numbers a line: world from camera, x right, y down, z forward
      cam_params.json               here or one folder up: camera: {w, h, fx, fy, cx, cy, scale}; scale: units a meter

There are no times: 30 frames a second are assumed. Source: the data of Zhu et al. 2022 (NICE-SLAM).
"""

import os
from pathlib import Path
from typing import Any

import numpy as np

from lvba.camera import Camera
from lvba.errors import InputError
from lvba.io import json_files
from lvba.io.camera_keys import as_float
from lvba.sources.folders import tables
from lvba.sources.folders.depth_scans import FRAME, NO_TIMES, PERIOD_NS, DepthCamera, image_files, image_item
from lvba.sources.folders.items import XYZ, FolderSource, Item, StreamKind, at_hand, numbered
from lvba.sources.source import Kind, KnownGeometry, PoseSample

_IMAGES = (".jpg", ".jpeg", ".png")
_PARAMETERS = "cam_params.json"


def is_one(path: Path) -> bool:
    """Whether a folder has this layout."""
    return os.path.isfile(path / "traj.txt") and os.path.isdir(path / "results")


def open_folder(path: Path) -> FolderSource:
    """The recording.

    Raises: InputError if a file is missing or malformed.
    """
    camera, scale = _camera(path)
    depth_camera = DepthCamera(camera, 1 / scale)
    results = path / "results"
    colors, depths = numbered(results, _IMAGES, "frame"), numbered(results, (".png",), "depth")
    if not colors or not depths:
        raise InputError(results, "holds no frame*.jpg or no depth*.png", "copy the folder again")
    items: list[Item] = [image_item("images", file, number * PERIOD_NS) for number, file in colors.items()]
    items += [depth_camera.item("depth", file, number * PERIOD_NS) for number, file in depths.items()]
    poses = _poses(path / "traj.txt")
    if len(poses) <= max(depths):
        problem = f"has {len(poses)} poses, but results has frame {max(depths)}"
        raise InputError(path / "traj.txt", problem, "copy it again")
    for number, pose in enumerate(poses):
        stamp = number * PERIOD_NS
        items.append(at_hand(stamp, "poses", PoseSample(stamp, "world", FRAME, pose)))
    streams = [
        StreamKind("images", Kind.IMAGES, image_files(colors.values())),
        StreamKind("depth", Kind.SCANS, f"depth images, {scale:g} a meter", XYZ),
        StreamKind("poses", Kind.POSES, "4x4 matrices"),
    ]
    known = KnownGeometry(
        camera=camera, camera_from_lidar=np.eye(4), body_from_lidar=np.eye(4), deskewed=True
    )
    notes = [
        NO_TIMES,
        *depth_camera.notes,
        "it is rendered: its poses and depths are exact.",
    ]
    return FolderSource(path, "Replica folder (NICE-SLAM)", streams, items, known, notes)


def _camera(path: Path) -> tuple[Camera, float]:
    """The camera, and units of depth a meter."""
    places = [path / _PARAMETERS, path.parent / _PARAMETERS]
    file = next((place for place in places if os.path.isfile(place)), None)
    if file is None:
        mend = f"put {_PARAMETERS} of the data set there or one folder up: camera: {{w, h, fx, fy, cx, cy, scale}}"
        raise InputError(places[0], "there is no such file, and so no intrinsics", mend)
    values = {key: _number(file, _section(file), key) for key in ("w", "h", "fx", "fy", "cx", "cy", "scale")}
    width, height = int(values["w"]), int(values["h"])
    if not (
        0 < width <= 20_000
        and 0 < height <= 20_000
        and values["scale"] > 0
        and values["fx"] > 0
        and values["fy"] > 0
    ):
        raise InputError(file, "camera has values that no camera has", "correct w, h, fx, fy, scale")
    camera = Camera(
        width=width, height=height, fx=values["fx"], fy=values["fy"], cx=values["cx"], cy=values["cy"]
    )
    return camera, values["scale"]


def _section(file: Path) -> dict[str, Any]:
    section = json_files.read_mapping(file, "copy it again", 1024 * 1024).get("camera")
    if not isinstance(section, dict):
        raise InputError(file, "has no section camera", "write camera: {w, h, fx, fy, cx, cy, scale}")
    return section


def _number(file: Path, section: dict[str, Any], key: str) -> float:
    value = as_float(section.get(key))
    if value is None:
        raise InputError(file, f"camera.{key} is no number", f"write camera.{key}")
    return value


def _poses(path: Path) -> list[np.ndarray]:
    poses = []
    for number, words in tables.lines_of_words(path):
        where = f"{path}:{number}"
        matrix = tables.numbers(where, words, 16, "16 numbers a line: world from camera").reshape(4, 4)
        poses.append(tables.pose(where, matrix))
    return poses
