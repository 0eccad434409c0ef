"""What a simulated camera sees of a world: exact rays, four to a pixel, from one pose or from one for each row."""

from dataclasses import dataclass

import cv2
import numpy as np

from lvba.arrays import Pose, Transforms, Vectors
from lvba.camera import Camera
from lvba.simulate.camera import rays as camera_rays
from lvba.simulate.people import People
from lvba.simulate.texture import Texture
from lvba.simulate.world import RayCaster

_SHARPNESS = 60.0
"""Exponent of the highlights (Blinn-Phong)."""


@dataclass(frozen=True)
class Shine:
    """Highlights of a light that is far away.

    size: (Q,) float64, radiance in the middle of a highlight on each rectangle; normal: (Q, 3); light: (3,), towards it;
    scene frame, unit length
    """

    size: np.ndarray
    normal: np.ndarray
    light: np.ndarray

    def radiance(self, directions: Vectors, quads: np.ndarray) -> np.ndarray:
        """(N,) that rays along directions (N, 3) see on rectangles (N,).

        quads: (N,) int32, numbers of rectangles
        """
        towards = -directions / np.linalg.norm(directions, axis=1, keepdims=True)
        half = towards + self.light
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        cosine = np.abs(np.einsum("ij,ij->i", half, self.normal[quads]))
        return np.asarray(np.where(quads >= 0, self.size[quads] * cosine**_SHARPNESS, 0.0))


@dataclass(frozen=True)
class View:
    """Takes radiance images of a textured world."""

    caster: RayCaster
    texture: Texture
    camera: Camera
    rays: np.ndarray
    """(H, W, 4, 3) float64, from `lvba.simulate.camera.rays`."""
    middle: np.ndarray
    """(H, W, 3) float32, one ray through the middle of each pixel."""
    people: People | None = None
    shine: Shine | None = None

    @classmethod
    def of(
        cls,
        caster: RayCaster,
        texture: Texture,
        camera: Camera,
        people: People | None = None,
        shine: Shine | None = None,
    ) -> "View":
        """The view of a world through a camera."""
        four = camera_rays(camera)
        middle = (0.5 * (four[:, :, 0] + four[:, :, 3])).astype(np.float32)
        return cls(caster, texture, camera, four, middle, people, shine)

    def radiance(self, scene_from_camera: Transforms, moment: float = 0.0) -> np.ndarray:
        """Mean radiances (H, W, 3) float32 at a pose, or averaged over poses during the exposure.

        scene_from_camera: (4, 4), (n, 4, 4), or (n, H, 4, 4) with a pose for each row
        moment: s since the start of the motion, which tells where people are
        """
        rows = scene_from_camera.ndim == 4
        poses = scene_from_camera if rows else scene_from_camera.reshape(-1, 4, 4)
        total = self._sharp(poses[0], moment)
        for pose in poses[1:]:
            total = total + self._sharp(pose, moment)
        return total / np.float32(len(poses))

    def brightness(self, scene_from_camera: Pose, every: int) -> float:
        """Mean radiance at a pose (4, 4), from one pixel in `every` along each axis."""
        rays = np.ascontiguousarray(self.rays[::every, ::every])
        quads = np.repeat(self._cast(scene_from_camera, rays[:, :, 0])[..., None], 4, axis=-1)
        return float(self.texture.render(scene_from_camera, rays, quads, 0.5 / self.camera.fx).mean())

    def _sharp(self, scene_from_camera: np.ndarray, moment: float) -> np.ndarray:
        """At a pose (4, 4), or at one for each row (H, 4, 4)."""
        quads = self._quads(scene_from_camera)
        if scene_from_camera.ndim == 2:
            seen = self.texture.render(scene_from_camera, self.rays, quads, 0.5 / self.camera.fx)
        else:
            seen = np.concatenate(
                [
                    self.texture.render(
                        pose, self.rays[row : row + 1], quads[row : row + 1], 0.5 / self.camera.fx
                    )
                    for row, pose in enumerate(scene_from_camera)
                ]
            )
        if self.shine is not None:
            directions = _turned(scene_from_camera, self.middle).reshape(-1, 3)
            more = self.shine.radiance(directions.astype(float), quads[..., 0].ravel())
            seen = seen + more.reshape(seen.shape[:2])[..., None].astype(np.float32)
        return seen if self.people is None else self._with_people(seen, scene_from_camera, moment)

    def _with_people(self, seen: np.ndarray, scene_from_camera: np.ndarray, moment: float) -> np.ndarray:
        """The same (H, W, 3), with people where they are nearer than the scene: part by part of four rays a pixel."""
        assert self.people is not None
        out = seen.copy()
        for corner in range(4):
            rays = self.rays[:, :, corner]
            directions = _turned(scene_from_camera, rays).reshape(-1, 3)
            origins = _origins(scene_from_camera, rays)
            met = self.people.meet(moment, origins, directions)
            hit = np.flatnonzero(np.isfinite(met.distance))
            if not len(hit):
                continue
            center = origins if origins.ndim == 1 else origins[hit]
            behind, _ = self.caster.cast(center, directions[hit])
            front = hit[met.distance[hit] < behind]
            flat, new = seen.reshape(-1, 3), out.reshape(-1, 3)
            new[front] += (met.color[front].astype(np.float32) - flat[front]) / np.float32(4)
        return out

    def _quads(self, scene_from_camera: np.ndarray) -> np.ndarray:
        """(H, W, 4) int32: what the rays of each pixel meet; one ray is cast where neighbors meet the same."""
        quads = self._cast(scene_from_camera, self.middle)
        edge = _differs_from_neighbors(quads)
        every = np.repeat(quads[..., None], 4, axis=-1)
        if scene_from_camera.ndim == 2:
            every[edge] = self._cast(scene_from_camera, self.rays[edge].astype(np.float32))
        else:
            pose_of = scene_from_camera[np.nonzero(edge)[0]]
            every[edge] = self._cast(pose_of, self.rays[edge].astype(np.float32))
        return every

    def _cast(self, scene_from_camera: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """int32 of the shape of the rays; a pose (4, 4), or one for each entry of their first axis."""
        directions = _turned(scene_from_camera, rays).reshape(-1, 3)
        origins = _origins(scene_from_camera, rays)
        return self.caster.cast(origins, directions)[1].reshape(rays.shape[:-1])


def _turned(scene_from_camera: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Rays (K, ..., 3) in the scene frame; a pose (4, 4), or one for each of the K."""
    rotation = scene_from_camera[..., :3, :3].astype(rays.dtype)
    if scene_from_camera.ndim == 2:
        return np.asarray((rays.reshape(-1, 3) @ rotation.T).reshape(rays.shape))
    return np.asarray(np.einsum("kij,k...j->k...i", rotation, rays))


def _origins(scene_from_camera: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """(3,), m, scene frame, or one for each of the rays (K, ..., 3), flattened."""
    if scene_from_camera.ndim == 2:
        return np.asarray(scene_from_camera[:3, 3])
    each = int(np.prod(rays.shape[1:-1]))
    return np.repeat(scene_from_camera[:, :3, 3], each, axis=0)


def _differs_from_neighbors(quads: np.ndarray) -> np.ndarray:
    """(H, W) bool: whether one of the eight neighbors is of another rectangle."""
    number = quads.astype(np.float32)
    kernel = np.ones((3, 3), np.uint8)
    return np.asarray(cv2.dilate(number, kernel) != cv2.erode(number, kernel))
