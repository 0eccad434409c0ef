"""Calibration files as other programs write them, from one camera and its place: the tests' own writers."""

import json
from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from lvba import geometry

WIDTH, HEIGHT = 1280, 1024
FOCAL = (863.4241, 861.25, 640.6808, 518.3392)


def rows(transform):
    return [[float(value) for value in row] for row in transform]


def flat(matrix):
    return [float(value) for value in np.asarray(matrix).ravel()]


def xyz_quaternion(transform):
    return [*flat(transform[:3, 3]), *flat(Rotation.from_matrix(transform[:3, :3]).as_quat())]


def opencv_matrix(matrix, indent="    "):
    matrix = np.atleast_2d(matrix)
    data = ", ".join(repr(float(value)) for value in matrix.ravel())
    lines = (
        "!!opencv-matrix",
        f"rows: {matrix.shape[0]}",
        f"cols: {matrix.shape[1]}",
        "dt: d",
        f"data: [ {data} ]",
    )
    return f"\n{indent}".join(lines)


def write(path: Path, text) -> Path:
    path.write_text(text if isinstance(text, str) else yaml.safe_dump(text, sort_keys=False))
    return path


def fast_livo(path, coefficients, fisheye, camera_from_lidar, body_from_lidar):
    keys = {
        "cam_model": "EquidistantCamera" if fisheye else "Pinhole",
        "cam_width": WIDTH,
        "cam_height": HEIGHT,
    }
    keys |= {"scale": 0.5, **dict(zip(("cam_fx", "cam_fy", "cam_cx", "cam_cy"), FOCAL, strict=True))}
    names = [f"k{i}" for i in range(1, 5)] if fisheye else [f"cam_d{i}" for i in range(len(coefficients))]
    keys |= dict(zip(names, coefficients, strict=True))
    keys["extrin_calib"] = {
        "extrinsic_T": flat(body_from_lidar[:3, 3]),
        "extrinsic_R": flat(body_from_lidar[:3, :3]),
        "Rcl": flat(camera_from_lidar[:3, :3]),
        "Pcl": flat(camera_from_lidar[:3, 3]),
    }
    return write(path / "fast_livo.yaml", keys)


def r3live(path, coefficients, fisheye, camera_from_lidar, body_from_lidar):
    body_from_camera = body_from_lidar @ geometry.inverse(camera_from_lidar)
    fx, fy, cx, cy = FOCAL
    section = {
        "image_width": WIDTH,
        "image_height": HEIGHT,
        "camera_intrinsic": [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        "camera_dist_coeffs": list(coefficients),
        "camera_ext_R": flat(body_from_camera[:3, :3]),
        "camera_ext_t": flat(body_from_camera[:3, 3]),
    }
    return write(path / "r3live_config.yaml", {"Lidar_front_end": {"lidar_type": 1}, "r3live_vio": section})


def kalibr(path, coefficients, fisheye, camera_from_lidar, body_from_lidar, inverse=False, shift=0.0123):
    camera_from_body = camera_from_lidar @ geometry.inverse(body_from_lidar)
    key, transform = (
        ("T_imu_cam", geometry.inverse(camera_from_body)) if inverse else ("T_cam_imu", camera_from_body)
    )
    section = {
        key: rows(transform),
        "camera_model": "pinhole",
        "distortion_coeffs": list(coefficients),
        "distortion_model": "equidistant" if fisheye else "radtan",
        "intrinsics": list(FOCAL),
        "resolution": [WIDTH, HEIGHT],
        "rostopic": "/cam0/image_raw",
        "timeshift_cam_imu": shift,
    }
    return write(path / ("openvins.yaml" if inverse else "camchain-imucam.yaml"), {"cam0": section})


def openvins(path, coefficients, fisheye, camera_from_lidar, body_from_lidar):
    return kalibr(path, coefficients, fisheye, camera_from_lidar, body_from_lidar, inverse=True)


def m2mapping(path, coefficients, fisheye, camera_from_lidar, body_from_lidar):
    lines = [
        "%YAML:1.0",
        "camera:",
        f"   model: {int(fisheye)}",
        f"   width: {WIDTH}",
        f"   height: {HEIGHT}",
    ]
    lines += [f"   {key}: {value!r}" for key, value in zip(("fx", "fy", "cx", "cy"), FOCAL, strict=True)]
    padded = (*coefficients, *(0.0,) * (5 - len(coefficients)))
    lines += [f"   d{i}: {float(value)!r}" for i, value in enumerate(padded)]
    lines += ["extrinsic:"]
    lines += [f"   T_C_L: {opencv_matrix(camera_from_lidar, '      ')}"]
    lines += [f"   T_B_L: {opencv_matrix(body_from_lidar, '      ')}"]
    return write(path / "m2mapping.yaml", "\n".join(lines) + "\n")


def spires(path, coefficients, fisheye, camera_from_lidar, body_from_lidar):
    camera = {
        "label": "cam_front",
        "topic": "/cam0/image/compressed",
        "T_cam_lidar_t_xyz_q_xyzw": xyz_quaternion(camera_from_lidar),
        "T_cam_imu_t_xyz_q_xyzw": xyz_quaternion(camera_from_lidar @ geometry.inverse(body_from_lidar)),
        "intrinsics": list(FOCAL),
        "extra_params": list(coefficients),
        "image_height": HEIGHT,
        "image_width": WIDTH,
    }
    model = "OPENCV_FISHEYE" if fisheye else "OPENCV"
    return write(path / "sensor.yaml", {"sensor": {"cameras": [camera], "camera_model": model}})


def dvlc(path, coefficients, fisheye, camera_from_lidar, body_from_lidar):
    padded = list(coefficients) if fisheye else [*coefficients, *[0.0] * (5 - len(coefficients))]
    camera = {"camera_model": "fisheye" if fisheye else "plumb_bob", "intrinsics": list(FOCAL)}
    document = {
        "camera": camera | {"distortion_coeffs": padded},
        "meta": {"image_topic": "/image"},
        "results": {"T_lidar_camera": xyz_quaternion(geometry.inverse(camera_from_lidar))},
    }
    return write(path / "calib.json", json.dumps(document))


def opencv(path, coefficients, fisheye, camera_from_lidar, body_from_lidar):
    fx, fy, cx, cy = FOCAL
    lines = ["%YAML:1.0", "---", f"image_width: {WIDTH}", f"image_height: {HEIGHT}", "flags: 0"]
    lines += [
        f"fisheye_model: {int(fisheye)}",
        f"camera_matrix: {opencv_matrix([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])}",
    ]
    lines += [f"distortion_coefficients: {opencv_matrix(np.array(coefficients)[:, None])}"]
    lines += ["avg_reprojection_error: 0.2"]
    return write(path / "opencv.yaml", "\n".join(lines) + "\n")


def colmap(path, coefficients, fisheye, camera_from_lidar, body_from_lidar):
    fx, fy, cx, cy = FOCAL
    model = "OPENCV_FISHEYE" if fisheye else "FULL_OPENCV" if len(coefficients) > 4 else "OPENCV"
    padded = (*coefficients, *(0.0,) * (8 - len(coefficients))) if model == "FULL_OPENCV" else coefficients
    numbers = " ".join(repr(float(value)) for value in (fx, fy, cx + 0.5, cy + 0.5, *padded))
    return write(path / "cameras.txt", f"# CAMERA_ID, MODEL, ...\n1 {model} {WIDTH} {HEIGHT} {numbers}\n")


def orb_slam(path, coefficients, fisheye, camera_from_lidar, body_from_lidar, version=1):
    """Of ORB-SLAM3, version 1.0; 0: as ORB-SLAM2 and older ones of ORB-SLAM3, which need not say the size."""
    name, body_from_camera = ("Camera1", "IMU.T_b_c1") if version else ("Camera", "Tbc")
    kinds = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    lines = ["%YAML:1.0", "", "#-----", "# Camera", "#-----"]
    lines += ['File.version: "1.0"'] if version else []
    lines += [f'Camera.type: "{"KannalaBrandt8" if fisheye else "PinHole"}"'] if fisheye or version else []
    lines += [f"{name}.{key}: {value!r}" for key, value in zip(("fx", "fy", "cx", "cy"), FOCAL, strict=True)]
    lines += [f"{name}.{key}: {value!r}" for key, value in zip(kinds, coefficients, strict=False)]
    lines += [f"Camera.width: {WIDTH}", f"Camera.height: {HEIGHT}"] if version else []
    lines += ["Camera.fps: 30.0", "Camera.RGB: 1", "Viewer.PointSize:2", "Viewer.ViewpointY: -0.7"]
    transform = body_from_lidar @ geometry.inverse(camera_from_lidar)
    lines += [f"{body_from_camera}: {opencv_matrix(transform, '   ')}"]
    return write(path / ("orb_slam3.yaml" if version else "orb_slam2.yaml"), "\n".join(lines) + "\n")


def orb_slam2(path, coefficients, fisheye, camera_from_lidar, body_from_lidar):
    return orb_slam(path, coefficients, fisheye, camera_from_lidar, body_from_lidar, version=0)


def vins(path, coefficients, fisheye, camera_from_lidar, body_from_lidar):
    """One file, as VINS-Mono has it; its fisheye has the coefficient of the angle itself, k1 = 1, before the others."""
    model, focal, kinds = (
        ("KANNALA_BRANDT", ("mu", "mv", "u0", "v0"), ("k2", "k3", "k4", "k5"))
        if fisheye
        else ("PINHOLE", ("fx", "fy", "cx", "cy"), ("k1", "k2", "p1", "p2", "k3"))
    )
    lines = [
        "%YAML:1.0",
        "---",
        'imu_topic: "/imu0"',
        "estimate_td: 0",
        "acc_n: 0.08",
        f"model_type: {model}",
    ]
    lines += ["camera_name: camera", f"image_width: {WIDTH}", f"image_height: {HEIGHT}"]
    projection = [f"   {key}: {value!r}" for key, value in zip(focal, FOCAL, strict=True)]
    distortion = [f"   {key}: {value!r}" for key, value in zip(kinds, coefficients, strict=False)]
    lines += ["projection_parameters:", *(distortion if fisheye else []), *projection]
    lines += [] if fisheye else ["distortion_parameters:", *distortion]
    transform = body_from_lidar @ geometry.inverse(camera_from_lidar)
    lines += ["estimate_extrinsic: 0", f"extrinsicRotation: {opencv_matrix(transform[:3, :3], '   ')}"]
    lines += [f"extrinsicTranslation: {opencv_matrix(transform[:3, 3:], '   ')}"]
    return write(path / "vins.yaml", "\n".join(lines) + "\n")


def ntu_viral(path, coefficients, fisheye, camera_from_lidar, body_from_lidar):
    """A camera in VINS's names, beside T_Body_Cam."""
    file = vins(path, coefficients, fisheye, camera_from_lidar, body_from_lidar)
    lines = file.read_text().split("estimate_extrinsic")[0].split("model_type")
    body = f"T_Body_Cam: {opencv_matrix(body_from_lidar @ geometry.inverse(camera_from_lidar), '   ')}"
    text = f"%YAML:1.0\n---\nsensor_type: camera\ncomment: left camera\n{body}\nrate_hz: 10\nmodel_type{lines[1]}"
    return write(path / "camera_left.yaml", text)


def euroc(path, coefficients, fisheye, camera_from_lidar, body_from_lidar):
    body_from_camera = body_from_lidar @ geometry.inverse(camera_from_lidar)
    document = {
        "sensor_type": "camera",
        "comment": "VI-Sensor cam0",
        "T_BS": {"cols": 4, "rows": 4, "data": flat(body_from_camera)},
        "rate_hz": 20,
        "resolution": [WIDTH, HEIGHT],
        "camera_model": "pinhole",
        "intrinsics": list(FOCAL),
        "distortion_model": "equidistant" if fisheye else "radial-tangential",
        "distortion_coefficients": list(coefficients),
    }
    return write(path / "sensor.yaml", document)
