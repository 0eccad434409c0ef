"""calib.json of direct_visual_lidar_calibration.

    camera: {camera_model: plumb_bob | fisheye | ..., intrinsics: [fx fy cx cy], distortion_coeffs: [k1 k2 p1 p2 k3]}
    results: {T_lidar_camera: [x y z qx qy qz qw]}      p_lidar = T_lidar_camera p_camera
    meta: {image_topic, ...}

It does not say the size of the images. Source: its docs/programs.md.
"""

from pathlib import Path
from typing import Any

import numpy as np

from lvba import geometry
from lvba.arrays import Pose
from lvba.camera import Camera
from lvba.errors import InputError
from lvba.io import json_files
from lvba.sources.calibrations import values
from lvba.sources.calibrations.rig import FileCalibration

_MAX_BYTES = 1024 * 1024


def read(path: Path) -> FileCalibration:
    """The camera and its place.

    Raises: InputError if it is no such file, a value is malformed, or the model cannot be used.
    """
    document = _document(path)
    meta = document.get("meta")
    topic = meta.get("image_topic") if isinstance(meta, dict) else None
    camera_from_lidar, notes = _extrinsic(path, document.get("results"))
    return FileCalibration(
        path=str(path),
        topic=topic if isinstance(topic, str) else "",
        camera=_camera(path, document["camera"]),
        camera_from_lidar=camera_from_lidar,
        notes=notes,
    )


def _document(path: Path) -> dict[str, Any]:
    document = json_files.read_mapping(path, "give calib.json as it was written", _MAX_BYTES)
    if not isinstance(document.get("camera"), dict):
        mend = "give calib.json of direct_visual_lidar_calibration"
        raise InputError(path, "has no section camera", mend)
    return document


def _camera(path: Path, section: dict[str, Any]) -> Camera:
    lens = values.lens_of(path, str(values.need(path, section, "camera_model", "camera.")))
    intrinsics = values.numbers(
        path, "camera.intrinsics", values.need(path, section, "intrinsics", "camera."), (4,)
    )
    raw = section.get("distortion_coeffs") or []
    coefficients = (
        np.zeros(0) if not raw else values.numbers(path, "camera.distortion_coeffs", raw, (4, 5, 8))
    )
    return values.camera(path, lens, intrinsics, coefficients, (0, 0))


def _extrinsic(path: Path, results: Any) -> tuple[Pose | None, tuple[str, ...]]:
    if isinstance(results, dict) and "T_lidar_camera" in results:
        lidar_from_camera = values.translation_and_quaternion(
            path, "T_lidar_camera", results["T_lidar_camera"]
        )
        return geometry.inverse(lidar_from_camera), ()
    return None, (
        f"{path}: has no T_lidar_camera (the calibration was not finished): its extrinsic is not used.",
    )
