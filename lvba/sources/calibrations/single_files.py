"""Files of one camera: of FAST-LIVO2, R3LIVE, M2Mapping, GS-SDF, ROS, OpenCV, VINS, EuRoC, T_cam_lidar, lvba's own."""

from pathlib import Path
from typing import Any

import numpy as np

from lvba import geometry
from lvba.errors import InputError
from lvba.io import camera_config, yaml_files
from lvba.lens import Lens
from lvba.sources.calibrations import values
from lvba.sources.calibrations.rig import FileCalibration

_BODY_KEYS = ("extrinsic_R", "extrinsic_T")
_EUROC, _NTU_VIRAL = "T_BS", "T_Body_Cam"
"""Body (IMU) from sensor, which any sensor of EuRoC has, and body from camera."""
_VINS_ROTATION, _VINS_TRANSLATION = "extrinsicRotation", "extrinsicTranslation"
"""IMU from camera; VINS does without where estimate_extrinsic is 2."""


def _section(document: dict[str, Any], *keys: str) -> dict[str, Any] | None:
    """The first mapping in a document that has all keys."""
    for _, mapping in yaml_files.mappings(document):
        if all(key in mapping for key in keys):
            return mapping
    return None


def is_m2mapping(document: dict[str, Any]) -> bool:
    """Whether a YAML file has T_C_L, as M2Mapping and GS-SDF write it."""
    return _section(document, "T_C_L") is not None


def read_m2mapping(path: Path, document: dict[str, Any]) -> FileCalibration:
    """Its camera ({model: 0 pinhole, 1 equidistant, ...}), and T_C_L and T_B_L: camera and base from LiDAR.

    d0 to d4 are k1 k2 p1 p2 k3 of a pinhole, d0 to d3 are k1 k2 k3 k4 of an equidistant lens.
    Raises: InputError if a value is missing or malformed.
    """
    extrinsic = _section(document, "T_C_L") or {}
    section = document.get("camera")
    camera = None
    if isinstance(section, dict):
        model = values.number(path, "camera.model", values.need(path, section, "model", "camera."))
        if model not in (0, 1):
            raise InputError(path, f"camera.model is {model:g}", "write 0 (pinhole) or 1 (equidistant)")
        keys = ("fx", "fy", "cx", "cy")
        intrinsics = [
            values.number(path, f"camera.{key}", values.need(path, section, key, "camera.")) for key in keys
        ]
        width, height = (
            values.number(path, f"camera.{key}", values.need(path, section, key, "camera."))
            for key in ("width", "height")
        )
        distortion = [
            values.number(path, f"camera.d{index}", section.get(f"d{index}", 0.0)) for index in range(5)
        ]
        lens = Lens.EQUIDISTANT if model else Lens.RADIAL_TANGENTIAL
        camera = values.camera(path, lens, np.array(intrinsics), np.array(distortion), (width, height))
    return FileCalibration(
        path=str(path),
        camera=camera,
        camera_from_lidar=values.matrix(path, "T_C_L", extrinsic["T_C_L"]),
        body_from_lidar=values.matrix(path, "T_B_L", extrinsic["T_B_L"]) if "T_B_L" in extrinsic else None,
    )


def is_camera_lidar(document: dict[str, Any]) -> bool:
    """Whether a YAML file has T_cam_lidar."""
    return _section(document, "T_cam_lidar") is not None


def read_camera_lidar(path: Path, document: dict[str, Any]) -> FileCalibration:
    """T_cam_lidar: camera from LiDAR, and T_cam_imu: camera from IMU, where it is there.

    Raises: InputError if a value is malformed, or the file has several of them.
    """
    sections = [mapping for _, mapping in yaml_files.mappings(document) if "T_cam_lidar" in mapping]
    if len(sections) > 1:
        raise InputError(
            path, f"has {len(sections)} times T_cam_lidar", "give a file with that of one camera"
        )
    section = sections[0]
    body_from_camera = None
    if "T_cam_imu" in section:
        body_from_camera = geometry.inverse(values.matrix(path, "T_cam_imu", section["T_cam_imu"]))
    return FileCalibration(
        path=str(path),
        camera_from_lidar=values.matrix(path, "T_cam_lidar", section["T_cam_lidar"]),
        body_from_camera=body_from_camera,
    )


def is_result(document: dict[str, Any]) -> bool:
    """Whether a YAML file is calibration.yaml of a result."""
    return "cam_model" in document and "camera_from_scan" in document


def read_result(path: Path, document: dict[str, Any]) -> FileCalibration:
    """The refined camera, where it is, and its clock.

    Raises: InputError if a value is missing or malformed.
    """
    camera_from_scan = values.matrix(path, "camera_from_scan", document["camera_from_scan"])
    offset = document.get("time_offset_s")
    note = (
        f"{path}: camera_from_scan is taken for the camera in the body's frame, in which scans of a recording are; "
        "where its config.yaml had no extrinsic_R and extrinsic_T, the body is the LiDAR."
    )
    return FileCalibration(
        path=str(path),
        camera=camera_config.read_camera(path),
        body_from_camera=geometry.inverse(camera_from_scan),
        camera_time_offset_s=None if offset is None else values.time_offset(path, "time_offset_s", offset),
        clock="" if offset is None else "LiDAR",
        notes=(note,),
    )


def read_yaml(path: Path, document: dict[str, Any]) -> FileCalibration:
    """FAST-LIVO2's and Global-LVBA's keys, R3LIVE's, files of ROS, OpenCV, VINS, EuRoC: see `lvba.io.camera_config`.

    Raises: InputError if the file holds neither a camera nor an extrinsic, or a value is missing or malformed.
    """
    calibration = camera_config.read_file(path)
    has_body = any(key in mapping for _, mapping in yaml_files.mappings(document) for key in _BODY_KEYS)
    r3live = _section(document, "camera_ext_R")
    body_from_camera = _body_from_camera(path, document) if r3live is None else _r3live(path, r3live)
    extrinsics = (calibration.camera_from_lidar, body_from_camera)
    if calibration.camera is None and all(each is None for each in extrinsics) and not has_body:
        mend = "give a file with camera keys, Rcl and Pcl, or extrinsic_R and extrinsic_T"
        raise InputError(path, "holds neither a camera nor an extrinsic in names that are known", mend)
    offset, notes = _fast_livo_clock(path, document)
    if r3live is not None and not has_body:
        notes += (
            f"{path}: R3LIVE's file does not say where the LiDAR is; its source does: for a Livox Avia extrinsic_T is "
            "[0.04165, 0.02326, -0.0284] and extrinsic_R the identity.",
        )
    return FileCalibration(
        path=str(path),
        topic=_image_topic(document),
        camera=calibration.camera,
        camera_from_lidar=calibration.camera_from_lidar,
        body_from_lidar=calibration.body_from_lidar if has_body else None,
        body_from_camera=body_from_camera,
        camera_time_offset_s=offset,
        clock="" if offset is None else "IMU",
        notes=notes,
    )


def _body_from_camera(path: Path, document: dict[str, Any]) -> np.ndarray | None:
    """(4, 4), as EuRoC, NTU VIRAL and VINS say it; None: the file does not, or is of another sensor.

    Raises: InputError if a value is malformed, or the file has several of them.
    """
    said = [
        values.matrix(path, key, mapping[key])
        for _, mapping in yaml_files.mappings(document)
        for key in (_EUROC, _NTU_VIRAL)
        if key in mapping and (key == _NTU_VIRAL or _is_camera(mapping))
    ]
    vins = _section(document, _VINS_ROTATION, _VINS_TRANSLATION)
    if vins is not None and vins.get("estimate_extrinsic") != 2:
        rotation = values.numbers(path, _VINS_ROTATION, vins[_VINS_ROTATION], (9,)).reshape(3, 3)
        translation = values.numbers(path, _VINS_TRANSLATION, vins[_VINS_TRANSLATION], (3,))
        said.append(values.rigid(path, _VINS_ROTATION, rotation, translation))
    if len(said) > 1:
        raise InputError(path, f"says {len(said)} times where a camera is", "give a file of one camera")
    return said[0] if said else None


def _is_camera(mapping: dict[str, Any]) -> bool:
    """Whether a sensor of EuRoC is a camera."""
    return str(mapping.get("sensor_type", "camera" if "intrinsics" in mapping else "")) == "camera"


def _r3live(path: Path, section: dict[str, Any]) -> np.ndarray:
    """camera_ext_R and camera_ext_t take the camera to the IMU."""
    rotation = values.numbers(path, "camera_ext_R", section["camera_ext_R"], (9,))
    translation = values.numbers(path, "camera_ext_t", values.need(path, section, "camera_ext_t"), (3,))
    return values.rigid(path, "camera_ext_R", rotation.reshape(3, 3), translation)


def _image_topic(document: dict[str, Any]) -> str:
    section = _section(document, "img_topic")
    topic = None if section is None else section["img_topic"]
    return topic if isinstance(topic, str) else ""


def _fast_livo_clock(path: Path, document: dict[str, Any]) -> tuple[float | None, tuple[str, ...]]:
    """What to add to image stamps to have the IMU's, where the file says so, and notes on the other offsets.

    FAST-LIVO2 adds img_time_offset and lidar_time_offset to stamps and takes imu_time_offset from them. 0 is the default
    of each and says nothing. lidar_time_offset may also mean that stamps are of the end of a sweep.
    """
    section = _section(document, "img_time_offset") or _section(document, "lidar_time_offset") or {}
    names = ("img_time_offset", "lidar_time_offset", "imu_time_offset")
    offsets = {
        key: values.time_offset(path, key, section[key]) if section.get(key) is not None else 0.0
        for key in names
    }
    notes = []
    if offset := offsets["lidar_time_offset"]:
        notes.append(
            f"{path}: lidar_time_offset is {offset:g} s: FAST-LIVO2 adds it to the stamps of scans, for another clock or "
            "for stamps of the end of a sweep; it is not used here."
        )
    if offset := offsets["imu_time_offset"]:
        notes.append(
            f"{path}: imu_time_offset is {offset:g} s: FAST-LIVO2 takes it from the stamps of the IMU."
        )
    if not offsets["img_time_offset"]:
        return None, tuple(notes)
    return offsets["img_time_offset"] + offsets["imu_time_offset"], tuple(notes)
