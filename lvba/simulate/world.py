"""The geometry of a scene: parallelograms, and which of them rays meet."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from lvba.arrays import Pose
from lvba.errors import InputError


@dataclass(frozen=True)
class World:
    """Rectangles with what their textures are made of, scene frame (z up).

    corner, edge_u, edge_v: (Q, 3) float64, m; color: (Q, 3) float64, mean radiance
    contrast: (Q,) float64, 0 flat to 1; patches: (Q,) float64, part of the 0.7 m cells that hold a flat patch
    texture: (Q,) int64, number of its texture: copies of a rectangle have the same
    """

    corner: np.ndarray
    edge_u: np.ndarray
    edge_v: np.ndarray
    color: np.ndarray
    contrast: np.ndarray
    patches: np.ndarray
    texture: np.ndarray

    def __len__(self) -> int:
        return len(self.corner)

    @property
    def normal(self) -> np.ndarray:
        """(Q, 3), unit length; the side is arbitrary."""
        normal = np.cross(self.edge_u, self.edge_v)
        return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))


class Builder:
    """Collects rectangles; objects get colors and contrasts of their own from `rng`."""

    def __init__(self, rng: np.random.Generator, bare: float = 0.0) -> None:
        """bare: part of the objects that have hardly any texture."""
        self.rng = rng
        self._bare = bare
        self._edges: list[np.ndarray] = []
        self._styles: list[np.ndarray] = []
        self._twins: list[int] = []

    def __len__(self) -> int:
        return len(self._edges)

    def rectangle(
        self,
        corner: tuple[float, ...] | np.ndarray,
        edge_u: tuple[float, ...] | np.ndarray,
        edge_v: tuple[float, ...] | np.ndarray,
        style: np.ndarray | None = None,
    ) -> None:
        """One parallelogram.

        style: (5,) float64, see `lvba.kernels.texture`; None: one of its own
        """
        self._edges.append(np.array([corner, edge_u, edge_v], float))
        self._styles.append(self.style() if style is None else style)
        self._twins.append(len(self._twins))

    def box(
        self,
        center: tuple[float, float, float],
        size: tuple[float, float, float],
        yaw: float = 0.0,
        tilt: float = 0.0,
        style: np.ndarray | None = None,
    ) -> None:
        """A cuboid, turned about z by `yaw` and then about its own x axis by `tilt` (rad); faces differ in shade.

        Faces: below, above, then those across its second axis and those across its first.
        style: (5,) float64, see `lvba.kernels.texture`; None: one of its own
        """
        c, s = np.cos(yaw), np.sin(yaw)
        ct, st = np.cos(tilt), np.sin(tilt)
        axes = np.array([[c, s, 0.0], [-s * ct, c * ct, st], [s * st, -c * st, ct]])
        x, y, z = axes * np.array(size)[:, None]
        corner = np.array(center) - (x + y + z) / 2
        style = self.style() if style is None else style
        for u, v, across in ((x, y, z), (x, z, y), (y, z, x)):
            self.rectangle(corner, u, v, self._shaded(style))
            self.rectangle(corner + across, u, v, self._shaded(style))

    def repeat(self, rectangles: slice, scene_from_here: Pose) -> None:
        """The same rectangles again, moved, with the same texture."""
        for index in range(*rectangles.indices(len(self))):
            edges = self._edges[index] @ scene_from_here[:3, :3].T
            edges[0] += scene_from_here[:3, 3]
            self._edges.append(edges)
            self._styles.append(self._styles[index])
            self._twins.append(self._twins[index])

    def style(self) -> np.ndarray:
        """(5,): mean radiance (red, green, blue), contrast, patch density."""
        level, tint = self.rng.uniform(0.25, 0.65), self.rng.uniform(-1, 1, 3)
        color = level * (1 + 0.3 * (tint - tint.mean()))
        bare = self.rng.random() < self._bare
        contrast = self.rng.uniform(0.08, 0.2) if bare else self.rng.uniform(0.6, 1.0)
        return np.array([*color, contrast, 0.0 if bare else self.rng.uniform(0.15, 0.5)])

    def build(self) -> World:
        """The world of all rectangles so far."""
        return self.without(slice(0, 0))

    def without(self, rectangles: slice) -> World:
        """The world of all rectangles but these, which may have been copied."""
        kept = np.delete(np.arange(len(self)), rectangles)
        edges, styles = np.array(self._edges)[kept], np.array(self._styles)[kept]
        _, texture = np.unique(np.array(self._twins)[kept], return_inverse=True)
        return World(
            corner=edges[:, 0],
            edge_u=edges[:, 1],
            edge_v=edges[:, 2],
            color=styles[:, :3],
            contrast=styles[:, 3].copy(),
            patches=styles[:, 4].copy(),
            texture=texture.astype(np.int64),
        )

    def _shaded(self, style: np.ndarray) -> np.ndarray:
        shaded = style.copy()
        shaded[:3] *= self.rng.uniform(0.75, 1.15)
        return shaded


class RayCaster(Protocol):
    """Finds the first rectangle along rays."""

    def cast(self, center: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far rays go, (M,) float32 (inf: no hit), in lengths of their direction; what they meet, (M,) int32 (-1).

        center: (3,) or (M, 3) float64, m, scene frame; directions: (M, 3) float64
        """


class PlainCaster:
    """A ray caster of numpy alone, which tries every rectangle: for a few rays in small worlds."""

    def __init__(self, world: World) -> None:
        self._world = world

    def cast(self, center: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far rays go, (M,) float32 (inf: no hit), in lengths of their direction; what they meet, (M,) int32 (-1).

        center: (3,) or (M, 3) float64, m, scene frame; directions: (M, 3) float64
        """
        world = self._world
        distance = np.full(len(directions), np.inf)
        quad = np.full(len(directions), -1, np.int32)
        for number in range(len(world)):
            u, v = world.edge_u[number], world.edge_v[number]
            # rows: how far along u, along v and off the plane a place is
            inverse = np.linalg.inv(np.stack([u, v, np.cross(u, v)], axis=1))
            start, step = (center - world.corner[number]) @ inverse.T, directions @ inverse.T
            with np.errstate(divide="ignore", invalid="ignore"):
                far = -start[..., 2] / step[:, 2]
                along_u, along_v = start[..., 0] + far * step[:, 0], start[..., 1] + far * step[:, 1]
            hit = (
                (far > 0) & (far < distance) & (np.abs(along_u - 0.5) <= 0.5) & (np.abs(along_v - 0.5) <= 0.5)
            )
            distance[hit], quad[hit] = far[hit], number
        return distance.astype(np.float32), quad


class EmbreeCaster:
    """A ray caster for large worlds (Embree, through Open3D)."""

    def __init__(self, world: World) -> None:
        """Raises: InputError if Open3D is not installed."""
        try:
            import open3d.core
            import open3d.t.geometry
        except ImportError as error:
            raise InputError(
                "lvba simulate", f"Open3D cannot be loaded ({error})", "pip install 'lvba[simulate]'"
            ) from error
        tensor: Any = open3d.core.Tensor
        self._tensor = tensor
        c, u, v = world.corner, world.edge_u, world.edge_v
        vertices = np.stack([c, c + u, c + u + v, c + v], axis=1).reshape(-1, 3).astype(np.float32)
        first = 4 * np.arange(len(world))[:, None, None]
        triangles = (first + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
        self._scene: Any = open3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(tensor(vertices), tensor(triangles.astype(np.uint32)))

    def cast(self, center: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far rays go, (M,) float32 (inf: no hit), in lengths of their direction; what they meet, (M,) int32 (-1).

        center: (3,) or (M, 3) float64, m, scene frame; directions: (M, 3) float64
        """
        rays = np.empty((len(directions), 6), np.float32)
        rays[:, :3], rays[:, 3:] = center, directions
        answer = self._scene.cast_rays(self._tensor(rays))
        distance = answer["t_hit"].numpy()
        quad = (answer["primitive_ids"].numpy() // 2).astype(np.int32)
        quad[~np.isfinite(distance)] = -1
        return distance, quad
