"""A small textured room with images, scans and rough trajectories of known truth."""

import numpy as np
import textured_planes

from lvba import geometry
from lvba.camera import Camera
from lvba.lidar.plane import PlanePoints, Planes
from lvba.trajectory import Trajectory
from lvba.visual import image

CAMERA = Camera(320, 240, 190.0, 190.0, 159.5, 119.5)
MOUNT = geometry.exp(np.array([0.02, -0.01, 0.03, 0.05, -0.02, 0.04]))
COUNT, RAYS = 12, 6000


def scan(
    world: textured_planes.PlaneWorld, pose: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) in the world that a LiDAR sees all round, and the plane of each."""
    u, v = rng.uniform(0, 320, RAYS), rng.uniform(0, 240, RAYS)
    wide = Camera(320, 240, 60.0, 60.0, 159.5, 119.5)
    plane, points = textured_planes.cast(world, pose, wide, u, v)
    return (points + 0.01 * rng.normal(size=points.shape)).astype(np.float32), plane.astype(np.int32)


def make():
    """Everything `refine` takes, and the truth."""
    rng = np.random.default_rng(0)
    world, every = textured_planes.room(), textured_planes.walk(2 * COUNT)
    times = np.arange(2 * COUNT) * 0.2
    truth = np.array(geometry.interpolate(every[0], every[-1], np.linspace(0, 1, 2 * COUNT)))
    images = truth[::2] @ MOUNT
    log_exposure = 0.2 * rng.normal(size=COUNT)
    log_exposure -= log_exposure[0]
    pictures = textured_planes.render(world, images, CAMERA, np.exp(log_exposure), noise=2.0, supersample=1)
    found = [scan(world, pose, rng) for pose in truth]
    points = np.concatenate([p for p, _ in found])
    walls = np.concatenate([k for _, k in found])
    planes = textured_planes.in_cells(world, walls, points).astype(np.int32)
    _, first, seen = np.unique(planes, return_index=True, return_counts=True)
    wall, count = walls[first], len(first)
    axes = np.stack([world.normals, world.axes[:, 0], world.axes[:, 1]], axis=2)[wall]
    middle = np.stack([points[planes == k].mean(axis=0) for k in range(count)])
    height = ((middle - world.points[wall]) * world.normals[wall]).sum(axis=1)
    center = middle - height[:, None] * world.normals[wall]
    axes[:, :, 0] *= np.sign(((truth[0, :3, 3] - center) * world.normals[wall]).sum(axis=1))[:, None]
    lidar = Planes(
        center=center,
        normal=axes[:, :, 0].copy(),
        eigenvalues=np.tile([1e-4, 1 / 12, 1 / 12], (count, 1)),
        axes=axes,
        count=seen,
        scans=np.full(count, 2 * COUNT, np.int32),
        size=np.ones(count),
        sigma_offset=np.full(count, 3e-4),
        unevenness=np.zeros(count),
    )
    rough = textured_planes.disturbed(images, 0.006, 0.15, seed=3)
    return (
        {
            "pyramid": image.build_pyramid(pictures, CAMERA, 2),
            "keyframes": np.arange(COUNT),
            "images": Trajectory(times[::2], rough),
            "scans": Trajectory(times, truth),
            "refined_scans": truth,
            "camera_from_scan": geometry.inverse(MOUNT),
            "sensor_position_scan": np.zeros(3),
            "planes": lidar,
            "plane_points": PlanePoints(points, planes, np.arange(0, len(points) + 1, RAYS)),
        },
        images,
        log_exposure,
    )
