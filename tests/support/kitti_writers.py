"""Drives of KITTI raw and KITTI-360 in the files of the data sets: the wall and mark of `known_view`."""

from datetime import UTC, datetime

import cv2
import known_view as view
import numpy as np
from scipy.spatial.transform import Rotation

SIZE, FOCAL, CENTER = (64, 48), (60.0, 60.0), (31.0, 24.5)
START = 1317042145_000000000
BASELINE = 0.06
DAY, DRIVE = "2011_09_26", "2011_09_26_drive_0001_sync"
DRIVE_360 = "2013_05_28_drive_0000_sync"


def rigid(rotation_vector, translation):
    made = np.eye(4)
    made[:3, :3] = Rotation.from_rotvec(rotation_vector).as_matrix()
    made[:3, 3] = translation
    return made


AXES = np.eye(4)
AXES[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]  # camera axes of those of the car
CAMERA0_FROM_VELODYNE = rigid([0.01, -0.02, 0.01], [0, -0.08, -0.27]) @ AXES
VELODYNE_FROM_IMU = rigid([0.005, 0.01, -0.02], [-0.8, 0.3, -0.8])
RECTIFICATION = rigid([0.01, 0.005, -0.003], [0, 0, 0])
RECTIFIED_FROM_VELODYNE = RECTIFICATION @ CAMERA0_FROM_VELODYNE
CAMERA2 = rigid([0, 0, 0], [BASELINE, 0, 0])
K = np.array([[FOCAL[0], 0, CENTER[0]], [0, FOCAL[1], CENTER[1]], [0, 0, 1]])


def text(*numbers):
    return " ".join(f"{value:.12e}" for value in np.concatenate([np.ravel(n) for n in numbers]))


def date(stamp):
    whole = datetime.fromtimestamp(stamp // 10**9, UTC).strftime("%Y-%m-%d %H:%M:%S")
    return f"{whole}.{stamp % 10**9:09d}\n"


def camera_poses():
    """World from the rectified camera whose images are written."""
    return view.poses(3)


def scan(world_from_velodyne):
    """Points of the wall in the LiDAR's frame, (N, 4) float32, with the mark among them."""
    side = np.random.default_rng(1).uniform(-1, 1, (60, 3))
    world = view.MARK + np.vstack([np.zeros(3), side - np.outer(side @ view.NORMAL, view.NORMAL)])
    points = (world - world_from_velodyne[:3, 3]) @ world_from_velodyne[:3, :3]
    return np.column_stack([points, np.full(len(points), 0.5)]).astype("<f4")


def write(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(content, str):
        path.write_text(content)
    elif content.dtype == np.uint8:
        assert cv2.imwrite(str(path), content)
    else:
        path.write_bytes(content.tobytes())


def latitude_longitude(positions, latitude, longitude):
    """Where positions (east, north, m) are, from a first place: the Mercator projection turned around."""
    radius, scale = 6378137.0, np.cos(np.radians(latitude))
    north0 = scale * radius * np.log(np.tan(np.pi * (90 + latitude) / 360))
    north = (positions[:, 1] + north0) / (scale * radius)
    return np.degrees(2 * np.arctan(np.exp(north))) - 90, longitude + np.degrees(
        positions[:, 0] / (scale * radius)
    )


def oxts_rows(world_from_imu):
    rows = np.zeros((len(world_from_imu), 30))
    positions = world_from_imu[:, :3, 3] - world_from_imu[0, :3, 3]
    rows[:, 0], rows[:, 1] = latitude_longitude(positions, 49.01, 8.43)
    rows[:, 2] = 112.0 + positions[:, 2]
    for row, pose in zip(rows, world_from_imu, strict=True):
        rotation = pose[:3, :3]
        row[3] = np.arctan2(rotation[2, 1], rotation[2, 2])
        row[4] = -np.arcsin(rotation[2, 0])
        row[5] = np.arctan2(rotation[1, 0], rotation[0, 0])
    return rows


def kitti_raw(root):
    day, drive = root / DAY, root / DAY / DRIVE
    projection = K @ np.column_stack([np.eye(3), CAMERA2[:3, 3]])
    write(
        day / "calib_cam_to_cam.txt",
        f"calib_time: x\nR_rect_00: {text(RECTIFICATION[:3, :3])}\nP_rect_02: {text(projection)}\n",
    )
    for name, transform in (("velo_to_cam", CAMERA0_FROM_VELODYNE), ("imu_to_velo", VELODYNE_FROM_IMU)):
        write(day / f"calib_{name}.txt", f"R: {text(transform[:3, :3])}\nT: {text(transform[:3, 3])}\n")
    camera = camera_poses()
    velodyne = camera @ CAMERA2 @ RECTIFIED_FROM_VELODYNE
    rows = oxts_rows(velodyne @ VELODYNE_FROM_IMU)
    stamps = [START + i * 103_000_001 for i in range(3)]
    for i in range(3):
        write(drive / f"image_02/data/{i:010}.png", view.color_image(SIZE, FOCAL, CENTER, camera[i]))
        write(drive / f"velodyne_points/data/{i:010}.bin", scan(velodyne[i]))
        write(drive / f"oxts/data/{i:010}.txt", " ".join(f"{value:.15g}" for value in rows[i]))
    for name in ("image_02", "oxts", "velodyne_points"):
        write(drive / name / "timestamps.txt", "".join(map(date, stamps)))
    write(
        drive / "velodyne_points/timestamps_start.txt", "".join(date(stamp - 51_000_000) for stamp in stamps)
    )
    write(drive / "velodyne_points/timestamps_end.txt", "".join(date(stamp + 52_000_000) for stamp in stamps))
    return drive, (velodyne @ VELODYNE_FROM_IMU)[0]


def kitti360(root, poses="poses.txt"):
    calibration = root / "calibration"
    imu_from_camera0 = rigid([0.1, 0, 0.2], [0.5, -0.3, 0.2]) @ np.linalg.inv(AXES)
    write(
        calibration / "perspective.txt",
        f"R_rect_00: {text(RECTIFICATION[:3, :3])}\nP_rect_00: {text(np.column_stack([K, np.zeros(3)]))}\n",
    )
    write(calibration / "calib_cam_to_velo.txt", text(np.linalg.inv(CAMERA0_FROM_VELODYNE)[:3]) + "\n")
    write(
        calibration / "calib_cam_to_pose.txt",
        f"image_00: {text(imu_from_camera0[:3])}\nimage_01: {text(np.eye(4)[:3])}\n",
    )
    camera = camera_poses()
    velodyne = camera @ RECTIFIED_FROM_VELODYNE
    stamps = [START + i * 100_000_000 for i in range(3)]
    lines = ""
    for i in range(3):
        write(
            root / f"data_2d_raw/{DRIVE_360}/image_00/data_rect/{i:010}.png",
            view.color_image(SIZE, FOCAL, CENTER, camera[i]),
        )
        write(root / f"data_3d_raw/{DRIVE_360}/velodyne_points/data/{i:010}.bin", scan(velodyne[i]))
        imu = velodyne[i] @ CAMERA0_FROM_VELODYNE_INVERSE @ np.linalg.inv(imu_from_camera0)
        lines += f"{i} " + (text(imu[:3]) if poses == "poses.txt" else text(camera[i])) + "\n"
    for name in (f"data_2d_raw/{DRIVE_360}/image_00", f"data_3d_raw/{DRIVE_360}/velodyne_points"):
        write(root / name / "timestamps.txt", "".join(map(date, stamps)))
    write(root / "data_poses" / DRIVE_360 / poses, lines)
    return root


CAMERA0_FROM_VELODYNE_INVERSE = np.linalg.inv(CAMERA0_FROM_VELODYNE)
