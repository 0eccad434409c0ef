"""Kalibr's camchain and camchain-imucam files, and OpenVINS's kalibr_imucam_chain.yaml.

    cam0:
      camera_model: pinhole    distortion_model: radtan | equidistant | none
      intrinsics: [fu, fv, pu, pv]    distortion_coeffs: [4] (5 or 8: as OpenCV)    resolution: [width, height]
      T_cam_imu: 4x4, camera from IMU (Kalibr)    T_imu_cam: its inverse (OpenVINS)
      T_cn_cnm1: 4x4, this camera from the one before
      T_cam_lidar: 4x4, camera from LiDAR (not Kalibr's; Oxford's and others' files have it beside)
      timeshift_cam_imu: s, t_imu = t_cam + shift

Source: https://github.com/ethz-asl/kalibr/wiki/yaml-formats
"""

import re
from pathlib import Path
from typing import Any

import numpy as np

from lvba import geometry
from lvba.arrays import Pose
from lvba.camera import Camera
from lvba.errors import InputError
from lvba.io.camera_keys import as_float
from lvba.lens import Lens
from lvba.sources.calibrations import agreement, values
from lvba.sources.calibrations.rig import FileCalibration

_SECTION = re.compile(r"cam\d+")
_KEYS = ("intrinsics", "T_cam_imu", "T_imu_cam", "T_cn_cnm1", "T_cam_lidar", "T_lidar_cam")


def is_one(document: dict[str, Any]) -> bool:
    """Whether a YAML file has cameras as Kalibr names them."""
    return bool(_cameras(document))


def read(path: Path, document: dict[str, Any]) -> tuple[FileCalibration, ...]:
    """Each camera.

    Raises: InputError if a value is missing, malformed, contradicts another, or of a model that cannot be used.
    """
    calibrations: list[FileCalibration] = []
    camera_from_imu: Pose | None = None
    for name, section in _cameras(document).items():
        camera_from_imu = _camera_from_imu(path, name, section, camera_from_imu)
        shift = section.get("timeshift_cam_imu")
        calibrations.append(
            FileCalibration(
                path=str(path),
                name=name,
                topic=str(section.get("rostopic") or ""),
                camera=_camera(path, name, section),
                camera_from_lidar=_both(path, name, section, "T_cam_lidar", "T_lidar_cam"),
                body_from_camera=None if camera_from_imu is None else geometry.inverse(camera_from_imu),
                camera_time_offset_s=None
                if shift is None
                else values.time_offset(path, f"{name}.timeshift_cam_imu", shift),
                clock="" if shift is None else "IMU",
            )
        )
    return tuple(calibrations)


def _cameras(document: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Sections by name, in the order of their numbers, at top level or below one other name ("stereo0")."""
    for place in (document, *(value for value in document.values() if isinstance(value, dict))):
        sections = {
            str(key): value
            for key, value in place.items()
            if _SECTION.fullmatch(str(key))
            and isinstance(value, dict)
            and any(name in value for name in _KEYS)
        }
        if sections:
            break
    return dict(sorted(sections.items(), key=lambda item: int(item[0][3:])))


def _both(path: Path, name: str, section: dict[str, Any], key: str, inverse_key: str) -> Pose | None:
    """The transform of `key`, or the inverse of that of `inverse_key`."""
    direct = values.matrix(path, f"{name}.{key}", section[key]) if key in section else None
    if inverse_key not in section:
        return direct
    other = geometry.inverse(values.matrix(path, f"{name}.{inverse_key}", section[inverse_key]))
    if direct is not None and not agreement.same_transform(direct, other):
        raise InputError(
            path, f"{name}.{key} is not the inverse of {name}.{inverse_key}", "keep the right one"
        )
    return other if direct is None else direct


def _camera_from_imu(path: Path, name: str, section: dict[str, Any], before: Pose | None) -> Pose | None:
    """What is said, or what follows from the camera before. before: (4, 4), of that one"""
    camera_from_imu = _both(path, name, section, "T_cam_imu", "T_imu_cam")
    if "T_cn_cnm1" not in section or before is None:
        return camera_from_imu
    chained = np.asarray(values.matrix(path, f"{name}.T_cn_cnm1", section["T_cn_cnm1"]) @ before)
    if camera_from_imu is not None and not agreement.same_transform(camera_from_imu, chained):
        problem = f"{name}.T_cam_imu is not what T_cn_cnm1 makes of the camera before"
        raise InputError(path, problem, "keep the right one")
    return chained if camera_from_imu is None else camera_from_imu


def _camera(path: Path, name: str, section: dict[str, Any]) -> Camera | None:
    if "intrinsics" not in section:
        return None
    where, prefix = f"{path}: {name}", f"{name}."
    model = str(values.need(path, section, "camera_model", prefix))
    if model.lower() != "pinhole":
        values.lens_of(where, model)
        raise InputError(where, f"the camera model {model[:40]!r} is not known", values.MEND)
    lens = values.lens_of(where, str(values.need(path, section, "distortion_model", prefix)))
    coefficients = section.get("distortion_coeffs") or []
    counts = (4, 5, 8) if lens is Lens.RADIAL_TANGENTIAL else (4,) if coefficients or lens else (0,)
    size = values.numbers(path, f"{prefix}resolution", values.need(path, section, "resolution", prefix), (2,))
    if any(as_float(side) == 0 for side in size):
        raise InputError(path, f"{prefix}resolution is 0", "write width and height in px")
    return values.camera(
        where,
        lens,
        values.numbers(path, f"{prefix}intrinsics", section["intrinsics"], (4,)),
        values.numbers(path, f"{prefix}distortion_coeffs", coefficients, counts),
        (size[0], size[1]),
    )
