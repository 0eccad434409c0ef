"""A textured box seen from inside: exact images, points and exposures for tests of the products."""

from dataclasses import dataclass

import numpy as np

from lvba import geometry
from lvba.camera import Camera
from lvba.products.cloud import Cloud
from lvba.products.views import Views

HALF = np.array([3.0, 2.0, 1.5])
CAMERA = Camera(96, 72, 60.0, 60.0, 47.5, 35.5)


def texture(points):
    """Radiance 0..255 (N, 3): smooth waves of about half a meter, different per channel."""
    points = np.asarray(points, float)
    phase = points @ np.array([[9.0, 5.0, 7.0], [6.0, 10.0, 4.0], [8.0, 3.0, 11.0]])
    return 110 + 45 * np.sin(phase) + 25 * np.cos(0.6 * phase[:, ::-1] + 1)


def first_wall(origin, directions):
    """Where rays (N, 3) from inside meet the box, (N, 3)."""
    with np.errstate(divide="ignore"):
        distance = np.where(directions > 0, HALF - origin, -HALF - origin) / directions
    return origin + directions * distance.min(1, keepdims=True)


@dataclass(frozen=True)
class BoxWorld:
    """world_from_camera (I, 4, 4), log_exposure (I,), pictures (I, H, W, 3) uint8, scans: list of (N, 3) float32."""

    world_from_camera: np.ndarray
    log_exposure: np.ndarray
    pictures: np.ndarray
    scans: list[np.ndarray]
    world_from_scan: np.ndarray

    def views(self, world_from_camera=None, log_exposure=None):
        poses = self.world_from_camera if world_from_camera is None else world_from_camera
        exposure = self.log_exposure if log_exposure is None else log_exposure
        return Views(lambda i: self.pictures[i], CAMERA, np.arange(len(poses), dtype=float), poses, exposure)

    def cloud(self):
        moved = [geometry.transform_points(pose, s) for pose, s in zip(self.world_from_scan, self.scans)]
        offsets = np.concatenate([[0], np.cumsum([len(s) for s in self.scans])])
        return Cloud(np.concatenate(moved).astype(np.float32), offsets, np.arange(len(self.scans)) + 0.1)


def make(images=6, points_per_scan=12000, seed=0):
    """A box with cameras turning on the spot while they drift, each image twice as bright or dark as another."""
    rng = np.random.default_rng(seed)
    delta = np.zeros((images, 6))
    delta[:, 1] = np.linspace(0, 1.2, images)
    delta[:, 3:] = rng.uniform(-0.5, 0.5, (images, 3))
    poses = geometry.exp(delta)
    log_exposure = np.concatenate([[0.0], rng.uniform(-0.5, 0.3, images - 1)])
    column, row = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    rays = np.stack(
        [(column - CAMERA.cx) / CAMERA.fx, (row - CAMERA.cy) / CAMERA.fy, np.ones(column.shape)], -1
    )
    pictures, scans = [], []
    for pose, log_eps in zip(poses, log_exposure):
        color = texture(first_wall(pose[:3, 3], rays.reshape(-1, 3) @ pose[:3, :3].T)) * np.exp(log_eps)
        pictures.append(np.clip(np.rint(color), 0, 255).reshape(*column.shape, 3).astype(np.uint8))
        directions = rng.normal(size=(points_per_scan, 3)) @ np.diag([1.0, 1.0, 1.0]) + pose[:3, 2]
        world = first_wall(pose[:3, 3], directions)
        scans.append(geometry.transform_points(geometry.inverse(pose), world).astype(np.float32))
    return BoxWorld(poses, log_exposure, np.array(pictures), scans, poses)
