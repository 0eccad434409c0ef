"""A wall and a mark on it, seen by a depth and a colour camera at known poses: what records must agree with."""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

NORMAL = np.array([0.1, -0.2, 1.0]) / np.linalg.norm([0.1, -0.2, 1.0])
DISTANCE = 2.5
"""The wall in the world: NORMAL x = DISTANCE, m."""
MARK = NORMAL * DISTANCE + np.array([0.2, 0.1, 0.0]) - NORMAL * (NORMAL @ [0.2, 0.1, 0.0])


def poses(count=4):
    """World from camera (x right, y down, z forward), (count, 4, 4): near the origin, turned about all axes."""
    turns = np.radians([[3, -4, 10], [-5, 2, 25], [4, 6, -15], [1, -3, 5], [2, 2, 2]])[:count]
    made = np.tile(np.eye(4), (count, 1, 1))
    made[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
    made[:, :3, 3] = [[0.1 * i, -0.05 * i, 0.2 * i] for i in range(count)]
    return made


def depth_image(size, focal, center, world_from_camera, units_a_meter):
    """(H, W) uint16: along the camera's axis, in units; each pixel's ray is cut with the wall."""
    image = np.zeros((size[1], size[0]), np.uint16)
    for row in range(size[1]):
        for column in range(size[0]):
            ray = np.array([(column - center[0]) / focal[0], (row - center[1]) / focal[1], 1.0])
            turned = world_from_camera[:3, :3] @ ray
            depth = (DISTANCE - NORMAL @ world_from_camera[:3, 3]) / (NORMAL @ turned)
            image[row, column] = round(depth * units_a_meter)
    image[0, 0] = 0  # nothing measured
    return image


def project(point_world, focal, center, world_from_camera):
    point = world_from_camera[:3, :3].T @ (point_world - world_from_camera[:3, 3])
    return np.array([focal[0] * point[0] / point[2] + center[0], focal[1] * point[1] / point[2] + center[1]])


def color_image(size, focal, center, world_from_camera):
    """(H, W, 3) uint8, BGR as OpenCV writes it: gray, with a bright spot where the mark is."""
    column, row = project(MARK, focal, center, world_from_camera)
    columns, rows = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    spot = 200 * np.exp(-((columns - column) ** 2 + (rows - row) ** 2) / (2 * 2.0**2))
    return np.repeat((40 + spot).astype(np.uint8)[..., None], 3, axis=2)


def spot_in(record):
    """The (column, row) of the bright spot of an image record."""
    image = record.pixels
    if image is None:
        image = cv2.imdecode(np.frombuffer(record.encoded, np.uint8), cv2.IMREAD_COLOR)
    weight = np.clip(image[..., 0].astype(float) - 80, 0, None)
    columns, rows = np.meshgrid(np.arange(weight.shape[1]), np.arange(weight.shape[0]))
    return np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()


def check(source, scans, images, poses_stream, resolution_m, pixel=0.2):
    """That scans are on the wall in the world, and that the mark, by pose and geometry, is where images show it."""
    records = list(source.records([scans, images, poses_stream]))
    known = source.geometry()
    stamps = [record.stamp for _, record in records]
    assert stamps == sorted(stamps)
    pose_of = {record.stamp: record.parent_from_child for name, record in records if name == poses_stream}
    seen = {"scans": 0, "images": 0}
    for name, record in records:
        if name == scans:
            world = record.points @ pose_of[record.stamp][:3, :3].T + pose_of[record.stamp][:3, 3]
            assert np.abs(world @ NORMAL - DISTANCE).max() < resolution_m
            assert (np.diff(record.rows) >= 0).all()
            seen["scans"] += 1
        if name == images:
            camera_from_world = known.camera_from_lidar @ np.linalg.inv(pose_of[record.stamp])
            camera = known.camera
            expected = project(
                MARK, (camera.fx, camera.fy), (camera.cx, camera.cy), np.linalg.inv(camera_from_world)
            )
            assert np.abs(spot_in(record) - expected).max() < pixel
            seen["images"] += 1
    assert min(seen.values()) >= 2
    assert source.losses() == ()
    return records
