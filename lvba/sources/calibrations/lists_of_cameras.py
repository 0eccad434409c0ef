"""Files with a list of cameras: Omni-LIVO's configuration and the Oxford Spires dataset's sensor.yaml.

Omni-LIVO: extrin_calib.cameras: [{cam_id, img_topic, Rcl, Pcl}], camera from LiDAR (a comment in its files says the
inverse; the numbers do not); the intrinsics are in a file for each camera.

Oxford Spires: sensor.cameras: [{label, topic, T_cam_lidar_t_xyz_q_xyzw, T_cam_imu_t_xyz_q_xyzw (one camera has it),
intrinsics [fx fy cx cy], extra_params, image_width, image_height}], sensor.camera_model (COLMAP's name).
"""

from pathlib import Path
from typing import Any

from lvba import geometry
from lvba.arrays import Pose
from lvba.errors import InputError
from lvba.sources.calibrations import values
from lvba.sources.calibrations.rig import FileCalibration

_LIDAR, _IMU = "T_cam_lidar_t_xyz_q_xyzw", "T_cam_imu_t_xyz_q_xyzw"


def _listed(document: dict[str, Any], section: str) -> list[dict[str, Any]]:
    inner = document.get(section)
    cameras = inner.get("cameras") if isinstance(inner, dict) else None
    return [each for each in cameras if isinstance(each, dict)] if isinstance(cameras, list) else []


def is_omni_livo(document: dict[str, Any]) -> bool:
    """Whether a YAML file has a list of cameras with Rcl and Pcl."""
    return any("Rcl" in camera for camera in _listed(document, "extrin_calib"))


def read_omni_livo(path: Path, document: dict[str, Any]) -> tuple[FileCalibration, ...]:
    """Each camera's extrinsic.

    Raises: InputError if a value is missing or malformed.
    """
    section = document["extrin_calib"]
    body_from_lidar = None
    if "extrinsic_R" in section or "extrinsic_T" in section:
        body_from_lidar = _rotation_and_translation(
            path, section, "extrinsic_R", "extrinsic_T", "extrin_calib."
        )
    calibrations = []
    for index, camera in enumerate(_listed(document, "extrin_calib")):
        prefix = f"extrin_calib.cameras[{index}]."
        calibrations.append(
            FileCalibration(
                path=str(path),
                name=f"cam{camera.get('cam_id', index)}",
                topic=str(camera.get("img_topic") or ""),
                camera_from_lidar=_rotation_and_translation(path, camera, "Rcl", "Pcl", prefix),
                body_from_lidar=body_from_lidar,
            )
        )
    return tuple(calibrations)


def _rotation_and_translation(
    path: Path, mapping: dict[str, Any], rotation_key: str, translation_key: str, prefix: str
) -> Pose:
    rotation = values.numbers(
        path, prefix + rotation_key, values.need(path, mapping, rotation_key, prefix), (9,)
    )
    translation = values.numbers(
        path, prefix + translation_key, values.need(path, mapping, translation_key, prefix), (3,)
    )
    return values.rigid(path, prefix + rotation_key, rotation.reshape(3, 3), translation)


def is_spires(document: dict[str, Any]) -> bool:
    """Whether a YAML file has a list of cameras as the Oxford Spires dataset writes it."""
    return any(_LIDAR in camera for camera in _listed(document, "sensor"))


def read_spires(path: Path, document: dict[str, Any]) -> tuple[FileCalibration, ...]:
    """Each camera, its extrinsic, and where the LiDAR is in the IMU's frame.

    Raises: InputError if a value is missing, malformed, or of a model that cannot be used.
    """
    lens = values.lens_of(path, str(values.need(path, document["sensor"], "camera_model", "sensor.")))
    cameras = _listed(document, "sensor")
    body_from_lidar = None
    for camera in cameras:
        if camera.get(_IMU):
            camera_from_body = values.translation_and_quaternion(path, _IMU, camera[_IMU])
            body_from_lidar = geometry.inverse(camera_from_body) @ _camera_from_lidar(path, camera)
    calibrations = []
    for index, camera in enumerate(cameras):
        prefix = f"sensor.cameras[{index}]."
        intrinsics = values.need(path, camera, "intrinsics", prefix)
        extra = values.need(path, camera, "extra_params", prefix)
        width, height = (
            values.number(path, prefix + key, values.need(path, camera, key, prefix))
            for key in ("image_width", "image_height")
        )
        if not (width and height):
            raise InputError(path, f"{prefix}image_width or image_height is 0", "write px")
        calibrations.append(
            FileCalibration(
                path=str(path),
                name=str(camera.get("label", f"cam{index}")),
                topic=str(camera.get("topic") or ""),
                camera=values.camera(
                    path,
                    lens,
                    values.numbers(path, f"{prefix}intrinsics", intrinsics, (4,)),
                    values.numbers(path, f"{prefix}extra_params", extra, (4, 5, 8)),
                    (width, height),
                ),
                camera_from_lidar=_camera_from_lidar(path, camera),
                body_from_lidar=body_from_lidar,
            )
        )
    return tuple(calibrations)


def _camera_from_lidar(path: Path, camera: dict[str, Any]) -> Pose:
    return values.translation_and_quaternion(path, _LIDAR, values.need(path, camera, _LIDAR))
