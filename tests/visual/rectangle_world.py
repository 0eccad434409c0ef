"""A world of textured rectangles, seen exactly: images, LiDAR points and planes without any simulator."""

import functools
from dataclasses import dataclass, replace

import numpy as np

from lvba import geometry
from lvba.camera import Camera
from lvba.kernels.visibility import PairGates
from lvba.lidar.plane import PlanePoints, Planes, Surfaces
from lvba.trajectory import Trajectory
from lvba.visual import visibility
from lvba.visual.image import intrinsics_of


@dataclass(frozen=True)
class Rectangle:
    """corner + a * first + b * second, a and b in 0 to 1; texture: seed of its pattern."""

    corner: np.ndarray
    first: np.ndarray
    second: np.ndarray
    texture: int

    @property
    def normal(self) -> np.ndarray:
        n = np.cross(self.first, self.second)
        return n / np.linalg.norm(n)


def rectangle(corner, first, second, texture=0):
    return Rectangle(*(np.asarray(v, float) for v in (corner, first, second)), texture)


def box(low, high, texture=0):
    """The six inner walls of a box."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    size, e = high - low, np.eye(3)
    faces = []
    for axis in range(3):
        a, b = (axis + 1) % 3, (axis + 2) % 3
        for side in (0, 1):
            corner = low + side * e[axis] * size[axis]
            faces.append(rectangle(corner, e[a] * size[a], e[b] * size[b], texture + 2 * axis + side))
    return faces


def cast(world, origins, directions):
    """Depth along each ray (inf: none) and the index of what it hit (-1)."""
    depth, hit = np.full(len(directions), np.inf), np.full(len(directions), -1)
    for index, r in enumerate(world):
        with np.errstate(divide="ignore", invalid="ignore"):
            t = ((r.corner - origins) @ r.normal) / (directions @ r.normal)
            local = origins + t[:, None] * directions - r.corner
            a = local @ r.first / (r.first @ r.first)
            b = local @ r.second / (r.second @ r.second)
        good = (t > 1e-6) & (a >= 0) & (a <= 1) & (b >= 0) & (b <= 1) & (t < depth)
        depth[good], hit[good] = t[good], index
    return depth, hit


def radiance(world, points, hit, waves=24, finest=0.06, coarsest=2.0):
    """Smooth random pattern of each rectangle, (N,), about 40 to 200: a sum of waves of many lengths."""
    value = np.zeros(len(points))
    for index, r in enumerate(world):
        on = hit == index
        rng = np.random.default_rng(1000 + r.texture)
        x = (points[on] - r.corner) @ np.column_stack(
            [r.first / np.linalg.norm(r.first), r.second / np.linalg.norm(r.second)]
        )
        length = np.exp(rng.uniform(np.log(finest), np.log(coarsest), waves))
        angle, phase = rng.uniform(0, 2 * np.pi, (2, waves))
        k = 2 * np.pi / length * np.stack([np.cos(angle), np.sin(angle)])
        value[on] = 120 + 110 / np.sqrt(waves) * np.sin(x @ k + phase).sum(axis=1)
    return np.clip(value, 20, 235)


def render(world, camera, world_from_camera, exposure=1.0, noise=0.0, rng=None, samples=2, **texture):
    """(H, W, 1) uint8 image; `samples`^2 rays per pixel; rays that hit nothing give 200 (a bright sky)."""
    v, u = np.mgrid[: camera.height, : camera.width].astype(float)
    total = np.zeros(u.size)
    offsets = (np.arange(samples) + 0.5) / samples - 0.5
    for du in offsets:
        for dv in offsets:
            rays = np.stack(
                [(u + du - camera.cx) / camera.fx, (v + dv - camera.cy) / camera.fy, np.ones_like(u)], -1
            ).reshape(-1, 3)
            directions = rays @ world_from_camera[:3, :3].T
            origin = world_from_camera[:3, 3]
            depth, hit = cast(world, origin, directions)
            points = origin + np.where(np.isfinite(depth), depth, 0)[:, None] * directions
            total += np.where(hit >= 0, radiance(world, points, hit, **texture), 200.0)
    value = exposure * total / samples**2
    if noise:
        value = value + noise * rng.standard_normal(len(value))
    return np.clip(np.round(value), 0, 255).astype(np.uint8).reshape(camera.height, camera.width, 1)


def scan(world, position, count, noise, rng):
    """(N, 3) world points of a LiDAR that looks everywhere, and the rectangle of each."""
    directions = rng.standard_normal((count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    depth, hit = cast(world, np.asarray(position, float), directions)
    good = np.isfinite(depth)
    ranges = depth[good] + noise * rng.standard_normal(good.sum())
    return np.asarray(position) + ranges[:, None] * directions[good], hit[good]


def planes_of(world, thickness=0.01):
    """The rectangles as `Planes` (exact normals), one each."""
    center = np.array([r.corner + (r.first + r.second) / 2 for r in world])
    axes, values = [], []
    for r in world:
        sides = [r.first, r.second]
        sides.sort(key=np.linalg.norm)
        axes.append(np.column_stack([r.normal, *(s / np.linalg.norm(s) for s in sides)]))
        values.append([thickness**2, *(s @ s / 12 for s in sides)])
    k = len(world)
    return Planes(
        center=center,
        normal=np.array([r.normal for r in world]),
        eigenvalues=np.array(values),
        axes=np.array(axes),
        count=np.full(k, 1000),
        scans=np.full(k, 3, np.int32),
        size=np.ones(k),
        sigma_offset=np.full(k, thickness / np.sqrt(1000)),
        unevenness=np.zeros(k),
    )


def plane_points(scans):
    """`PlanePoints` of a list of (points, rectangle) scans."""
    return PlanePoints(
        points_world=np.concatenate([p for p, _ in scans]).astype(np.float32),
        plane=np.concatenate([h for _, h in scans]).astype(np.int32),
        scan_offsets=np.concatenate([[0], np.cumsum([len(p) for p, _ in scans])]).astype(np.int64),
    )


def look(position, target, up=(0, 0, 1)):
    """world_from_camera (4, 4) at `position` that looks at `target`, image down against `up`."""
    z = np.asarray(target, float) - position
    z /= np.linalg.norm(z)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    return geometry.from_rotation_translation(
        np.column_stack([x, np.cross(z, x), z]), np.asarray(position, float)
    )


CAMERA = Camera(200, 150, 150.0, 150.0, 99.5, 74.5)
INTRINSICS = intrinsics_of(CAMERA)
NOTHING = visibility.NOTHING_HIDES.at(CAMERA)
GATES = PairGates(
    half=4, min_view_cosine=0.17, min_normal_cosine=0.2, min_scale=0.45, max_scale=2.5, min_ncc=0.8, contrast_floor=4.0,
    dark=3.0, bright=250.0, min_usable=0.8, hiding=0.15, noise=0.0,
)  # fmt: skip
"""Of pairs of images in tests; those of runs are in `visibility.pair_gates`."""


@dataclass(frozen=True)
class Recording:
    """A small recording in a world of rectangles: everything at the truth."""

    world: list
    images: np.ndarray
    poses: np.ndarray
    times: np.ndarray
    planes: Planes
    plane_points: PlanePoints
    exposure: np.ndarray
    noise: float

    @property
    def cameras(self):
        return Trajectory(self.times, self.poses)

    @property
    def surfaces(self):
        return Surfaces(self.planes, self.plane_points, self.times)


@functools.cache
def room_with_screen(count=8, noise=2.0, seed=0, sideways=False):
    """A camera that moves ahead, or sideways, in a room where a screen hides part of the wall behind it."""
    rng = np.random.default_rng(seed)
    screen = rectangle([1.5, -0.5, -1.5], [0, 1.0, 0], [0, 0, 2.4], 50)
    world = [*box([-4, -3, -1.5], [4, 3, 1.5]), screen]
    times = np.arange(count) * 0.2
    exposure = 0.8 + 0.15 * np.sin(1.3 * np.arange(count))
    step = np.arange(count)
    path = np.column_stack([-2 + 0.1 * step, 0.05 * step - 0.2, 0 * step])
    aim = np.column_stack([3 + 0 * step, 0.3 * np.sin(step), 0 * step - 0.1])
    if sideways:
        path = np.column_stack([-1.5 + 0 * step, 0.25 * step - 1, 0 * step])
        aim = np.column_stack([4 + 0 * step, 0.05 * step - 0.2, 0 * step])
    poses = np.array([look(p, a) for p, a in zip(path, aim, strict=True)])
    images = np.stack(
        [
            render(world, CAMERA, p, e, noise, rng, samples=3, finest=0.15)
            for p, e in zip(poses, exposure, strict=True)
        ]
    )
    scans = [scan(world, p[:3, 3] + [0, 0, 0.1], 15000, 0.015, rng) for p in poses]
    return Recording(
        world, images, poses, times, planes_of(world, 0.015), plane_points(scans), exposure, noise
    )


def random_pair(rng):
    """Poses of two cameras, and position and normal of a plane in front of them."""

    def pose():
        return geometry.exp(np.concatenate([0.2 * rng.standard_normal(3), 0.5 * rng.standard_normal(3)]))

    normal = np.array([0, 0, -1.0]) + 0.4 * rng.standard_normal(3)
    return pose(), pose(), np.array([0, 0, 5.0]) + rng.standard_normal(3), normal / np.linalg.norm(normal)


def rained_on(rec, part):
    """The points of all scans, of which this part are of drops before the surfaces."""
    rng = np.random.default_rng(8)
    seen = rec.plane_points
    sensor = np.repeat(rec.poses[:, :3, 3], np.diff(seen.scan_offsets), axis=0)
    drop = rng.random(len(sensor)) < part
    points, nearness = seen.points_world.copy(), rng.uniform(0.05, 0.9, (drop.sum(), 1))
    points[drop] = sensor[drop] + nearness * (points[drop] - sensor[drop])
    return replace(seen, points_world=points, plane=np.where(drop, -1, seen.plane).astype(np.int32))
