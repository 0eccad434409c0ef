"""A small world of textured planes with known truth, rendered by exact ray-plane intersection."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter

from lvba import geometry
from lvba.camera import Camera
from lvba.visual.scene_points import Observations, ScenePoints
from lvba.visual.states import CameraStates


@dataclass(frozen=True)
class PlaneWorld:
    """Infinite planes: points (K, 3), unit normals (K, 3), in-plane axes (K, 2, 3), textures (K, n, n) splines."""

    points: np.ndarray
    normals: np.ndarray
    axes: np.ndarray
    textures: np.ndarray
    texel: float


def make(
    normals: np.ndarray, points: np.ndarray, seed: int = 0, size: int = 512, texel: float = 0.01
) -> PlaneWorld:
    """Planes with smooth random textures, rich from 2 to 60 texels, intensities about 30 to 220, periodic."""
    rng = np.random.default_rng(seed)
    normals = np.asarray(normals, float)
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    textures, axes = [], []
    for normal in normals:
        layers = [
            gaussian_filter(rng.normal(size=(size, size)), s, mode="wrap") for s in (2, 4, 8, 16, 32, 60)
        ]
        value = sum(layer / layer.std() for layer in layers)
        textures.append(spline_filter(125 + 35 * np.tanh(value / 2) * 2, order=3, mode="grid-wrap"))
        first = np.linalg.svd(normal[None])[2][1]
        axes.append([first, np.cross(normal, first)])
    return PlaneWorld(np.asarray(points, float), normals, np.array(axes), np.array(textures), texel)


def room(seed: int = 0) -> PlaneWorld:
    """A box of 6 x 5 x 3 m about the origin."""
    normals = [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]
    points = [[-3, 0, 0], [3, 0, 0], [0, -2.5, 0], [0, 2.5, 0], [0, 0, -1.5], [0, 0, 1.5]]
    return make(np.array(normals), np.array(points), seed)


def cast(world: PlaneWorld, pose: np.ndarray, camera: Camera, u: np.ndarray, v: np.ndarray):
    """Nearest plane (N,) and point (N, 3) that the pixels see."""
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)
    rays = rays @ pose[:3, :3].T
    distance = np.einsum("ki,ki->k", world.normals, world.points - pose[:3, 3])
    with np.errstate(divide="ignore"):
        depth = distance / (rays @ world.normals.T)
    depth[depth <= 0.01] = np.inf
    plane = depth.argmin(axis=-1)
    return plane, pose[:3, 3] + rays * depth.min(axis=-1)[..., None]


def in_cells(world: PlaneWorld, plane: np.ndarray, point: np.ndarray, size: float = 1.0) -> np.ndarray:
    """Of points (N, 3) on planes (N,): which cell of so many meters of its plane each is in, (N,) from 0, as a LiDAR map
    has pieces of walls."""
    along = np.einsum("nai,ni->na", world.axes[plane], point - world.points[plane])
    place = np.column_stack([plane, np.floor(along / size).astype(int)])
    return np.unique(place, axis=0, return_inverse=True)[1].ravel()


def radiance(world: PlaneWorld, plane: np.ndarray, point: np.ndarray) -> np.ndarray:
    """The texture's value at points on planes."""
    value = np.zeros(plane.shape)
    for k in range(len(world.points)):
        mine = plane == k
        where = (point[mine] - world.points[k]) @ world.axes[k].T / world.texel
        value[mine] = map_coordinates(world.textures[k], where.T, order=3, mode="grid-wrap", prefilter=False)
    return value


def render(world, poses, camera, exposures, noise=0.0, seed=0, supersample=2) -> np.ndarray:
    """(I, H, W, 1) uint8 images of (I, 4, 4) poses."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[: camera.height, : camera.width].astype(float)
    images = []
    for pose, exposure in zip(poses, exposures, strict=True):
        total = np.zeros(u.shape)
        for j in range(supersample):
            for i in range(supersample):
                du, dv = (i + 0.5) / supersample - 0.5, (j + 0.5) / supersample - 0.5
                total += radiance(world, *cast(world, pose, camera, (u + du), (v + dv)))
        noisy = exposure * total / supersample**2 + noise * rng.normal(size=u.shape)
        images.append(np.clip(np.round(noisy), 0, 255).astype(np.uint8))
    return np.stack(images)[..., None]


def scene_points(world, poses, camera, step=12, radius=4, targets=6) -> tuple[ScenePoints, Observations]:
    """Points on a pixel grid from true poses, and the nearest images that see them whole."""
    position, normal, reference, pixel, plane = [], [], [], [], []
    h = radius + 2
    for r, pose in enumerate(poses):
        v, u = np.mgrid[h : camera.height - h : step, h : camera.width - h : step].reshape(2, -1)
        k, x = cast(world, pose, camera, u.astype(float), v.astype(float))
        same = np.ones(len(k), bool)
        for du, dv in ((-h, -h), (h, -h), (-h, h), (h, h)):
            same &= cast(world, pose, camera, u + float(du), v + float(dv))[0] == k
        view = x - pose[:3, 3]
        facing = -np.einsum("ni,ni->n", view, world.normals[k]) / np.linalg.norm(view, axis=1)
        same &= np.abs(facing) > 0.3
        position.append(x[same])
        normal.append(world.normals[k[same]] * np.sign(facing[same])[:, None])
        reference.append(np.full(same.sum(), r))
        pixel.append(np.stack([u, v], axis=1)[same])
        plane.append(k[same])
    position, normal = np.concatenate(position), np.concatenate(normal)
    reference, plane = np.concatenate(reference), np.concatenate(plane)
    points = ScenePoints(
        position, normal, np.zeros(len(position)), np.zeros(len(position)), reference.astype(np.int32),
        np.concatenate(pixel).astype(np.int32), plane.astype(np.int32), np.zeros(len(position), bool),
    )  # fmt: skip
    pairs = []
    for t, pose in enumerate(poses):
        x = (position - pose[:3, 3]) @ pose[:3, :3]
        u = x[:, 0] / x[:, 2] * camera.fx + camera.cx
        v = x[:, 1] / x[:, 2] * camera.fy + camera.cy
        margin = 2 * radius + 3
        seen = (x[:, 2] > 0.1) & (u > margin) & (v > margin)
        seen &= (u < camera.width - 1 - margin) & (v < camera.height - 1 - margin) & (reference != t)
        seen &= np.abs(reference - t) <= targets
        with np.errstate(invalid="ignore"):
            facing = np.abs(((pose[:3, 3] - position) * normal).sum(1)) / np.linalg.norm(
                position - pose[:3, 3], axis=1
            )
        seen &= facing > 0.3
        where = np.flatnonzero(seen)
        seen[where] = cast(world, pose, camera, u[where], v[where])[0] == plane[where]
        pairs += [(p, t) for p in np.flatnonzero(seen)]
    pairs = np.array(sorted(pairs), np.int32)
    return points, Observations(pairs[:, 0].copy(), pairs[:, 1].copy(), np.zeros(len(pairs), bool))


def walk(count: int, seed: int = 0) -> np.ndarray:
    """(count, 4, 4) world_from_camera: a slow turn about the room's middle, camera level, z of the world up."""
    rng = np.random.default_rng(seed)
    phase = np.linspace(0, 1.0, count)
    poses = []
    for s in phase:
        yaw = 2.2 * s
        forward = np.array([np.cos(yaw), np.sin(yaw), 0.15 * np.sin(4 * s)])
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
        poses.append(
            geometry.from_rotation_translation(
                rotation, [-1.2 + 0.8 * s, -0.4 + 0.5 * s, 0.2 * np.sin(3 * s)]
            )
        )
    return np.array(poses) @ geometry.exp(rng.normal(size=(count, 6)) * [0.02] * 6)


def disturbed(poses: np.ndarray, sigma_m: float, sigma_deg: float, seed: int = 0) -> np.ndarray:
    """Poses with independent errors of these sizes per axis."""
    delta = np.random.default_rng(seed).normal(size=(len(poses), 6))
    return geometry.retract(poses, delta * np.repeat([np.radians(sigma_deg), sigma_m], 3))


def states(poses: np.ndarray, log_exposure: np.ndarray | None = None) -> CameraStates:
    """Camera states with unit exposures unless given."""
    return CameraStates(poses, np.zeros(len(poses)) if log_exposure is None else log_exposure)
