"""Folders of LiDAR programs and rigs, as each writes them: the wall and mark of `known_view`."""

import json

import cv2
import known_view as view
import numpy as np
from scipy.spatial.transform import Rotation

from lvba.io import pcd


def points(pose):
    """Points on the wall in the sensor's frame, the first of which is the mark."""
    side = np.random.default_rng(1).uniform(-1, 1, (50, 3))
    world = view.MARK + np.vstack([np.zeros(3), side - np.outer(side @ view.NORMAL, view.NORMAL)])
    return ((world - pose[:3, 3]) @ pose[:3, :3]).astype(np.float32)


def write_scans(folder, names):
    folder.mkdir(parents=True, exist_ok=True)
    for name, pose in zip(names, view.poses(), strict=True):
        pcd.write_pcd(folder / name, points(pose))


def quaternions():
    return Rotation.from_matrix(view.poses()[:, :3, :3]).as_quat()


def line(*values):
    return " ".join(f"{value:.9f}" for value in values) + "\n"


def hba(path):
    write_scans(path / "pcd", [f"{i}.pcd" for i in (8, 9, 10, 11)])  # by number, not by name
    rows = zip(view.poses()[:, :3, 3], quaternions(), strict=True)
    (path / "pose.json").write_text("".join(line(*t, q[3], *q[:3]) for t, q in rows))


def balm(path, timed=True):
    write_scans(path, [f"full{i}.pcd" for i in range(4)])
    lines = ""
    for i, pose in enumerate(view.poses()):
        matrix = pose.copy()
        matrix[3, 3] = 100.25 + 0.1 * i if timed else 1
        lines += "".join(",".join(f"{value:.9f}" for value in row) + ",\n" for row in matrix)
    (path / "alidarPose.csv").write_text(lines)


def kiss_icp(path, names=tuple(f"{i:06}.pcd" for i in range(4)), times=(50.5, 50.6, 50.7, 50.8)):
    write_scans(path / "scans", names)
    rows = zip(times, view.poses()[:, :3, 3], quaternions(), strict=True)
    (path / "run_poses_tum.txt").write_text("".join(f"{time} {line(*t, *q)}" for time, t, q in rows))


BASE_FROM_LIDAR = np.diag([-1.0, -1.0, 1.0, 1.0])
BASE_FROM_LIDAR[2, 3] = 0.124
CAMERA_FROM_BASE = np.eye(4)
CAMERA_FROM_BASE[:3, :3] = Rotation.from_rotvec([0.05, -0.02, 0.1]).as_matrix()
CAMERA_FROM_BASE[:3, 3] = [0.05, 0.02, -0.03]


def spires(path, viewpoints=True):
    clouds = path / "processed/vilens-slam/undist-clouds"
    write_scans(clouds, [f"cloud_1710338090_{100 + i}000000.pcd" for i in range(4)])
    rows = list(zip(view.poses()[:, :3, 3], quaternions(), strict=True))
    for file, (t, q) in zip(sorted(clouds.iterdir()), rows, strict=True):
        text = file.read_bytes()
        assert b"VIEWPOINT 0 0 0 1 0 0 0" in text
        if viewpoints:
            file.write_bytes(
                text.replace(
                    b"VIEWPOINT 0 0 0 1 0 0 0", b"VIEWPOINT " + line(*t, q[3], *q[:3]).strip().encode()
                )
            )
    (path / "processed/trajectory").mkdir()
    lines = [line(1710338090.1 + i / 1000, *t, *q) for i, (t, q) in enumerate(rows)]
    (path / "processed/trajectory/vilens-slam-tum.txt").write_text("".join(lines))
    (path / "raw/cam0").mkdir(parents=True)
    for i, pose in enumerate(view.poses()):
        image = view.color_image((64, 48), (60, 60), (31, 24), pose @ np.linalg.inv(CAMERA_FROM_BASE))
        assert cv2.imwrite(str(path / f"raw/cam0/1710338090.{100 + i}000000.jpg"), image)
    camera_from_lidar = CAMERA_FROM_BASE @ BASE_FROM_LIDAR
    numbers = [*camera_from_lidar[:3, 3], *Rotation.from_matrix(camera_from_lidar[:3, :3]).as_quat()]
    camera = dict(label="cam_front", topic="/alphasense_driver_ros/cam0/debayered/image/compressed")
    camera |= dict(
        T_cam_lidar_t_xyz_q_xyzw=[float(number) for number in numbers], intrinsics=[60, 60, 31, 24]
    )
    camera |= dict(extra_params=[0, 0, 0, 0], image_width=64, image_height=48)
    sensor = dict(cameras=[camera, camera | dict(topic="/other", label="x")], camera_model="OPENCV_FISHEYE")
    sensor["T_base_lidar_t_xyz_q_xyzw"] = [0, 0, 0.124, 0, 0, 1, 0]
    (path / "sensor.yaml").write_text(json.dumps({"sensor": sensor}))


def recording(path):
    write_scans(path / "all_pcd_body", [f"{10.5 + i / 10}.pcd" for i in range(4)])
    rows = zip(view.poses()[:, :3, 3], quaternions(), strict=True)
    text = "".join(line(10.5 + i / 10, *t, *q) for i, (t, q) in enumerate(rows))
    (path / "lidar_poses.txt").write_text(text)
    (path / "image_poses.txt").write_text("# camera\n" + text)
    (path / "all_image").mkdir()
    for i, pose in enumerate(view.poses()):
        image = view.color_image((64, 48), (60, 60), (31, 24), pose)
        assert cv2.imwrite(str(path / f"all_image/{10.5 + i / 10}.png"), image)
    (path / "config.yaml").write_text(
        "cam_model: {cam_width: 64, cam_height: 48, cam_fx: 60, cam_fy: 60, cam_cx: 31, cam_cy: 24}\n"
        "extrin_calib: {Rcl: [1, 0, 0, 0, 1, 0, 0, 0, 1], Pcl: [0, 0, 0], extrinsic_T: [0, 0, 0],\n"
        "               extrinsic_R: [1, 0, 0, 0, 1, 0, 0, 0, 1]}\n"
    )
