"""A recording of the Record3D app, unpacked (.r3d files are ZIP archives).

    FOLDER/
      metadata       JSON: K (9 numbers, column by column), w, h, poses (qx qy qz qw tx ty tz each: world from camera,
                     x right, y up, z back), fps, frameTimestamps, dw, dh
      rgbd/0.jpg ... 0.depth (float32, m, dw x dh)   0.conf (uint8: 0, 1, 2)

The app compresses .depth and .conf files by LZFSE, which is not read here: decompress them, under the same names.
Source: the app's repository and nerfstudio's reader.
"""

import os
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lvba.arrays import Pose
from lvba.camera import Camera
from lvba.errors import InputError
from lvba.io import files, json_files
from lvba.io.camera_keys import as_float
from lvba.io.image_header import ImageSize
from lvba.sources.folders import tables
from lvba.sources.folders.depth_scans import FRAME, DepthCamera, image_files, image_item
from lvba.sources.folders.items import XYZ, FolderSource, Item, StreamKind, at_hand, numbered
from lvba.sources.source import Kind, KnownGeometry, PoseSample, RawScan

_LZFSE = (b"bvx1", b"bvx2", b"bvxn", b"bvx-")
_MOST_FRAMES = 1_000_000


def is_one(path: Path) -> bool:
    """Whether a folder has this layout."""
    return os.path.isfile(path / "metadata") and os.path.isdir(path / "rgbd")


def open_folder(path: Path) -> FolderSource:
    """The recording.

    Raises: InputError if a file is missing or malformed, or depth is compressed.
    """
    file = path / "metadata"
    document = _document(file)
    size = tables.image_size(file, *(_number(file, document, key) for key in ("w", "h")))
    depth_size = tables.image_size(file, *(_number(file, document, key) for key in ("dw", "dh")))
    matrix = _list(file, document, "K", 9).reshape(3, 3).T
    camera = tables.pinhole(file, matrix, size)
    poses = _poses(file, document)
    stamps = _stamps(file, document, len(poses))
    images = numbered(path / "rgbd", (".jpg", ".jpeg", ".png"))
    depths = {
        number: at for number, at in numbered(path / "rgbd", (".depth",)).items() if number < len(poses)
    }
    if not images or not depths:
        raise InputError(
            path / "rgbd", "holds no images or no depth files that have a pose", "unpack the .r3d file again"
        )
    _refuse_compressed(next(iter(depths.values())))
    depth_camera = DepthCamera(_scaled(file, camera, depth_size), 1.0)
    items: list[Item] = []
    for number, pose in enumerate(poses):
        items.append(at_hand(stamps[number], "poses", PoseSample(stamps[number], "world", FRAME, pose)))
        if number in images:
            items.append(image_item("images", images[number], stamps[number]))
        if number in depths:
            load = partial(_scan, depth_camera, depths[number], depth_size, stamps[number])
            items.append(Item(stamps[number], "depth", load, str(depths[number])))
    streams = [
        StreamKind("images", Kind.IMAGES, image_files(images.values())),
        StreamKind("depth", Kind.SCANS, "depth, float32, m", XYZ),
        StreamKind("poses", Kind.POSES, "metadata"),
    ]
    known = KnownGeometry(
        camera=camera, camera_from_lidar=np.eye(4), body_from_lidar=np.eye(4), deskewed=True
    )
    return FolderSource(path, "Record3D folder", streams, items, known, depth_camera.notes)


def _document(file: Path) -> dict[str, Any]:
    return json_files.read_mapping(file, "unpack the .r3d file again")


def _number(file: Path, document: dict[str, Any], key: str) -> float:
    value = as_float(document.get(key))
    if value is None:
        raise InputError(file, f"{key} is no number", f"write {key}, or unpack the .r3d file again")
    return value


def _list(file: Path, document: dict[str, Any], key: str, count: int) -> np.ndarray:
    raw = document.get(key)
    words = [str(value) for value in raw] if isinstance(raw, list) else []
    return tables.numbers(f"{file}: {key}", words, count, f"{count} numbers")


def _poses(file: Path, document: dict[str, Any]) -> list[Pose]:
    raw = document.get("poses")
    if not isinstance(raw, list) or not 0 < len(raw) <= _MOST_FRAMES:
        raise InputError(file, "has no poses", "record with tracking, and unpack the .r3d file again")
    poses = []
    for index, each in enumerate(raw):
        where = f"{file}: poses[{index}]"
        words = [str(value) for value in each] if isinstance(each, list) else []
        row = tables.numbers(where, words, 7, "qx qy qz qw tx ty tz")
        poses.append(tables.from_opengl(tables.quaternion_pose(where, row[4:], row[:4])))
    return poses


def _stamps(file: Path, document: dict[str, Any], count: int) -> list[int]:
    """ns, of frameTimestamps (s), or else of fps."""
    if isinstance(document.get("frameTimestamps"), list) and len(document["frameTimestamps"]) == count:
        times = _list(file, document, "frameTimestamps", count)
        if (np.diff(times) <= 0).any() or times[0] < 0 or times[-1] > 2**33:
            raise InputError(file, "frameTimestamps are not ascending seconds", "unpack the .r3d file again")
        return [tables.nanoseconds(file, f"{time:.9f}") for time in times]
    rate = _number(file, document, "fps")
    if not 0.1 <= rate <= 1000:
        raise InputError(file, f"fps is {rate:g}", "write frames a second")
    return [round(index * 1e9 / rate) for index in range(count)]


def _refuse_compressed(file: Path) -> None:
    if files.read_start(file, 4) in _LZFSE:
        mend = "decompress all .depth and .conf files (for example with pyliblzfse) under the same names"
        raise InputError(file, "is compressed by LZFSE, which is not read", mend)


def _scaled(file: Path, camera: Camera, size: ImageSize) -> Camera:
    scaled = camera.scaled(size.width / camera.width)
    if (scaled.width, scaled.height) != (size.width, size.height):
        problem = f"dw x dh, {size.width} x {size.height}, is no scaled {camera.width} x {camera.height}"
        raise InputError(file, problem, "unpack the .r3d file again")
    return scaled


def _scan(camera: DepthCamera, file: Path, size: ImageSize, stamp: int) -> RawScan:
    content = files.read_bytes(file)
    if len(content) != 4 * size.width * size.height:
        problem = f"{len(content)} bytes are no {size.width} x {size.height} float32"
        raise InputError(file, problem, "decompress it again")
    meters = np.frombuffer(content, "<f4").reshape(size.height, size.width)
    meters = np.where(np.isfinite(meters) & (meters > 0), meters, 0)
    confidence = file.with_suffix(".conf")
    if os.path.isfile(confidence):
        sure = files.read_bytes(confidence)
        if len(sure) != size.width * size.height:
            raise InputError(confidence, "has another size than the depth", "decompress it again")
        meters = np.where(np.frombuffer(sure, np.uint8).reshape(meters.shape) > 0, meters, 0)
    return camera.scan_of(file, meters, stamp)
