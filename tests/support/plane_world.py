"""A tiny world of rectangles with exact truth: scans of it with range noise, and drifted poses."""

import numpy as np
from numba import njit, prange

from lvba import geometry


@njit(cache=True, parallel=True)
def _cast(origins, directions, centers, first, second, normals):
    """Ranges (N,) to the nearest rectangle; infinity where a ray meets none."""
    ranges = np.full(len(directions), np.inf)
    for i in prange(len(directions)):
        for k in range(len(centers)):
            along = 0.0
            height = 0.0
            for a in range(3):
                along += normals[k, a] * directions[i, a]
                height += normals[k, a] * (centers[k, a] - origins[i, a])
            if abs(along) < 1e-9:
                continue
            t = height / along
            if t <= 0.05 or t >= ranges[i]:
                continue
            u, v, uu, vv = 0.0, 0.0, 0.0, 0.0
            for a in range(3):
                d = origins[i, a] + t * directions[i, a] - centers[k, a]
                u += d * first[k, a]
                v += d * second[k, a]
                uu += first[k, a] * first[k, a]
                vv += second[k, a] * second[k, a]
            if abs(u) <= uu and abs(v) <= vv:
                ranges[i] = t
    return ranges


class World:
    """Rectangles: center and two half edges, each (3,)."""

    def __init__(self) -> None:
        self.parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def rectangle(self, center, first, second) -> None:
        self.parts.append(tuple(np.asarray(v, float) for v in (center, first, second)))

    def box(self, low, high) -> None:
        """The six faces of an axis-aligned box."""
        low, high = np.asarray(low, float), np.asarray(high, float)
        middle, half = (low + high) / 2, (high - low) / 2
        for axis in range(3):
            a, b = (np.eye(3)[k] * half[k] for k in range(3) if k != axis)
            for sign in (-1, 1):
                self.rectangle(middle + sign * half[axis] * np.eye(3)[axis], a, b)

    def ranges(self, origins, directions) -> np.ndarray:
        centers, first, second = (np.array([p[k] for p in self.parts]) for k in range(3))
        normals = np.cross(first, second)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return _cast(origins, directions, centers, first, second, normals)


def wall(world: World, a, b, height=3.0, thickness=0.1, openings=()) -> None:
    """A thin vertical wall from a to b (x, y), with door openings (from, to) along it."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    length = np.linalg.norm(b - a)
    along = (b - a) / length
    across = np.array([-along[1], along[0]]) * thickness / 2
    edges = [0.0, *(x for opening in sorted(openings) for x in opening), length]
    spans = [(edges[k], edges[k + 1], 0.0) for k in range(0, len(edges), 2)]
    spans += [(low, high, 2.1) for low, high in openings]
    for low, high, bottom in spans:
        middle = a + along * (low + high) / 2
        half, rise = (high - low) / 2, (height - bottom) / 2
        for sign in (-1, 1):
            center = np.append(middle + sign * across, bottom + rise)
            world.rectangle(center, np.append(along * half, 0), [0, 0, rise])
        for end in (low, high):
            if bottom == 0.0:
                center = np.append(a + along * end, rise)
                world.rectangle(center, np.append(across, 0), [0, 0, rise])


def courtyard(seed=0) -> World:
    """Open ground of 36 m by 28 m with four facades, boxes and a ramp."""
    rng = np.random.default_rng(seed)
    world = World()
    world.rectangle([0, 0, 0], [40, 0, 0], [0, 40, 0])
    world.box([-19, -15, 0], [-18, 15, 7])
    world.box([18, -15, 0], [19, 15, 9])
    world.box([-18, -15, 0], [18, -14, 8])
    world.box([-18, 14, 0], [18, 15, 6])
    for _ in range(12):
        x, y = rng.uniform(-14, 14), rng.uniform(-10, 10)
        if np.hypot(x / 1.4, y) > 6.5:
            size = rng.uniform(0.4, 1.5, 2)
            world.box([x - size[0], y - size[1], 0], [x + size[0], y + size[1], rng.uniform(0.5, 3)])
    world.rectangle([12, 10, 0.4], [2, 0, 0.4], [0, 1.5, 0])
    return world


def rooms() -> World:
    """Four rooms on both sides of a corridor, thin walls with doors, posters, cupboards."""
    world = World()
    world.rectangle([6, 5, 0], [7, 0, 0], [0, 6, 0])
    world.rectangle([6, 5, 3], [7, 0, 0], [0, 6, 0])
    for a, b in (((0, 0), (12, 0)), ((12, 0), (12, 10)), ((12, 10), (0, 10)), ((0, 10), (0, 0))):
        wall(world, a, b, thickness=0.3)
    wall(world, (0, 4), (12, 4), openings=((2, 3), (8, 9)))
    wall(world, (0, 6), (12, 6), openings=((3, 4), (9, 10)))
    wall(world, (6, 0), (6, 4))
    wall(world, (6, 6), (6, 10))
    for x in (1.0, 4.0, 7.5, 10.5):
        for low, high in ((0.15, 0.18), (9.82, 9.85)):
            world.box([x - 0.4, low, 1.2], [x + 0.4, high, 2.0])
    world.box([0.2, 1, 0], [0.8, 2.5, 1.9])
    world.box([11.2, 7, 0], [11.8, 8.5, 1.9])
    world.box([4.5, 8, 0], [5.4, 9.6, 0.8])
    world.box([7, 1.5, 0], [7.8, 2.2, 0.75])
    return world


def street(length=300.0, seed=0) -> World:
    """A street with setbacks of the houses, kerbs and parked boxes."""
    rng = np.random.default_rng(seed)
    world = World()
    world.rectangle([length / 2, 0, 0], [length / 2 + 60, 0, 0], [0, 4, 0])
    for side in (-1, 1):
        world.rectangle([length / 2, side * 7, 0.15], [length / 2 + 60, 0, 0], [0, 3, 0])
        world.rectangle([length / 2, side * 4, 0.075], [length / 2 + 60, 0, 0], [0, 0, 0.075])
        x = -50.0
        while x < length + 50:
            width, back, height = rng.uniform(8, 18), rng.uniform(7, 9.5), rng.uniform(5, 12)
            low, high = sorted((side * back, side * (back + 8)))
            world.box([x, low, 0], [x + width, high, height])
            x += width + (rng.uniform(1, 4) if rng.random() < 0.3 else 0.0)
        for x in np.arange(-40, length + 40, 15.0):
            if rng.random() < 0.6:
                low, high = sorted((side * 2.2, side * 3.8))
                world.box([x, low, 0.3], [x + 4, high, 1.5])
    return world


def directions(points: int, kind: str, rng: np.random.Generator) -> np.ndarray:
    """Unit rays (N, 3): 32 rings all round, or a forward cone whose pattern never repeats."""
    if kind == "spinning":
        rings = 32
        azimuth = np.linspace(0, 2 * np.pi, points // rings, endpoint=False) + rng.uniform(0, 0.1)
        elevation = np.radians(np.linspace(-25, 15, rings))
        a, e = np.meshgrid(azimuth, elevation)
        return np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], -1).reshape(-1, 3)
    radius = np.radians(38) * np.sqrt(rng.random(points))
    angle = rng.uniform(0, 2 * np.pi, points)
    return np.stack([np.cos(radius), np.sin(radius) * np.cos(angle), np.sin(radius) * np.sin(angle)], -1)


def look(position, yaw, pitch=0.0, roll=0.0) -> np.ndarray:
    """world_from_scan (4, 4)."""
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    return geometry.from_rotation_translation(rotation, np.asarray(position, float))


def path(name: str, scans: int) -> np.ndarray:
    """True poses (S, 4, 4) of a walk through a scene."""
    s = np.linspace(0, 1, scans)
    wobble = 0.05 * np.sin(2 * np.pi * 9 * s)
    if name == "courtyard":
        a = 2 * np.pi * s
        xyz = np.stack([8 * np.cos(a), 5 * np.sin(a), 1.5 + 0.1 * np.sin(5 * a)], -1)
        yaw = a + np.pi / 2
    elif name == "rooms":
        corners = np.array(
            [[1, 5], [2.5, 5], [2.5, 2], [4.5, 1.5], [2.5, 2.2], [2.5, 5], [3.5, 5], [3.5, 8], [1.5, 8],
             [3.5, 7.5], [3.5, 5], [8.5, 5], [8.5, 2], [10, 2], [8.5, 3], [8.5, 5], [9.5, 5], [9.5, 8],
             [8, 8.5], [9.5, 7.5], [9.5, 5], [11, 5]], float)  # fmt: skip
        length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
        xy = np.stack([np.interp(s * length[-1], length, corners[:, k]) for k in range(2)], -1)
        xyz = np.concatenate([xy, 1.5 + wobble[:, None]], 1)
        yaw = 2 * np.pi * 3 * s
    else:
        xyz = np.stack([300 * s, 0.5 * np.sin(20 * s), 1.8 + wobble], -1)
        yaw = 0.2 * np.sin(30 * s)
    return np.stack(
        [look(p, y, 0.05 * np.sin(40 * t), 0.05 * np.cos(31 * t)) for p, y, t in zip(xyz, yaw, s)]
    )


def scan_all(world: World, poses: np.ndarray, points: int, noise: float, kind: str, seed: int):
    """One (N, 3) float32 scan per pose, with Gaussian range noise, rays without an echo left out."""
    rng = np.random.default_rng(seed)
    scans = []
    for pose in poses:
        rays = directions(points, kind, rng)
        ranges = world.ranges(np.broadcast_to(pose[:3, 3], rays.shape), rays @ pose[:3, :3].T)
        hit = ranges < 120
        ranges = ranges + noise * rng.normal(size=len(ranges))
        scans.append((rays * ranges[:, None])[hit].astype(np.float32))
    return scans


def drift(poses: np.ndarray, seed: int, translation=0.08, rotation_deg=0.2) -> np.ndarray:
    """Rough poses: a random walk scaled to an RMS error, plus a little noise per frame; the first one true."""
    rng = np.random.default_rng(seed + 1000)
    n = len(poses)
    walk = np.cumsum(rng.normal(size=(n, 6)), 0)
    walk -= walk[0]
    walk /= np.sqrt((walk**2).mean(0))
    jitter = rng.normal(size=(n, 6))
    jitter[0] = 0
    scale = np.array([np.radians(rotation_deg)] * 3 + [translation] * 3) / np.sqrt(3)
    error = (walk + 0.15 * jitter) * scale
    rough = poses.copy()
    rough[:, :3, :3] = (
        geometry.exp(np.concatenate([error[:, :3], 0 * error[:, :3]], 1))[:, :3, :3] @ poses[:, :3, :3]
    )
    rough[:, :3, 3] += error[:, 3:]
    return rough


WORLDS = {"courtyard": courtyard, "rooms": rooms, "street": street}


def recording(name: str, scans=100, points=30000, kind="spinning", seed=0, noise=0.02):
    """(scans, true poses, rough poses) of a named scene."""
    truth = path(name, scans)
    return scan_all(WORLDS[name](), truth, points, noise, kind, seed), truth, drift(truth, seed)
