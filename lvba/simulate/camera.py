"""The simulated camera: exact distortion, exposure, vignetting, motion blur, noise and 8 bits."""

from dataclasses import dataclass

import cv2
import numpy as np

from lvba.camera import Camera
from lvba.simulate.texture import Texture
from lvba.simulate.world import RayCaster

_BLUR_POSES = 5
_VIGNETTING = 0.35
"""Part of the light missing in the corners."""
_FOCAL_PER_WIDTH = 0.78


@dataclass(frozen=True)
class Sensor:
    """What turns radiance into grey values."""

    gain: float
    """Grey value of radiance 1 at relative exposure 1."""
    noise: float = 2.0
    """Standard deviation of the noise, grey values."""
    shot_noise: float = 0.0
    """Variance that a grey value of 1 adds, grey values squared; 0.02 is slight."""
    vignetting: float = 0.0
    """Part of the light missing in the corners, 0 to 0.9."""

    def __post_init__(self) -> None:
        if not 0 <= self.vignetting <= 0.9:
            raise ValueError(f"vignetting = {self.vignetting}: must lie in 0 to 0.9")

    def picture(self, radiance: np.ndarray, exposure: float, rng: np.random.Generator) -> np.ndarray:
        """The (H, W, 3) uint8 image of mean radiances (H, W, 3) float32."""
        grey = radiance * np.float32(self.gain * exposure)
        if self.vignetting:
            grey *= _falloff(grey.shape[0], grey.shape[1], self.vignetting)[..., None]
        noise = rng.standard_normal(grey.shape, dtype=np.float32)
        if self.shot_noise:
            noise *= np.sqrt(self.noise**2 + self.shot_noise * grey)
        else:
            noise *= np.float32(self.noise)
        grey += noise
        return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def _falloff(height: int, width: int, missing: float) -> np.ndarray:
    """(H, W) float32: 1 in the middle, 1 - missing in the corners."""
    y, x = np.mgrid[0:height, 0:width]
    square = (x - (width - 1) / 2) ** 2 + (y - (height - 1) / 2) ** 2
    return (1 - missing * square / square.max()).astype(np.float32)


def random_camera(width: int, height: int, rng: np.random.Generator) -> Camera:
    """A camera of about 65 degrees, with distortion."""
    focal = _FOCAL_PER_WIDTH * width * rng.uniform(0.95, 1.05)
    center = (0.5 * (width - 1), 0.5 * (height - 1)) + rng.uniform(-0.01, 0.01, 2) * width
    return Camera(
        width,
        height,
        float(focal),
        float(focal * rng.uniform(0.998, 1.002)),
        float(center[0]),
        float(center[1]),
        (
            float(rng.uniform(-0.12, -0.06)),
            float(rng.uniform(0.01, 0.04)),
            float(rng.uniform(-8e-4, 8e-4)),
            float(rng.uniform(-8e-4, 8e-4)),
        ),
    )


def rays(camera: Camera) -> np.ndarray:
    """(H, W, 4, 3) float64: rays (x, y, 1) of 2x2 places in each pixel, distortion inverted, camera frame."""
    column, row = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    places = [
        undistort(
            (column + right - camera.cx) / camera.fx,
            (row + down - camera.cy) / camera.fy,
            camera.distortion,
        )
        for down in (-0.25, 0.25)
        for right in (-0.25, 0.25)
    ]
    return np.stack([np.stack([x, y, np.ones_like(x)], axis=-1) for x, y in places], axis=2)


def distort(
    x: np.ndarray, y: np.ndarray, distortion: tuple[float, float, float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Distorted normalized coordinates: the radial-tangential model k1 k2 p1 p2."""
    k1, k2, p1, p2 = distortion
    square = x * x + y * y
    radial = 1 + k1 * square + k2 * square * square
    return (
        x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x),
        y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
    )


def undistort(
    u: np.ndarray, v: np.ndarray, distortion: tuple[float, float, float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """The normalized coordinates that `distort` takes to (u, v), to 1e-12."""
    x, y = u, v
    for _ in range(60):
        again_u, again_v = distort(x, y, distortion)
        x, y = x + (u - again_u), y + (v - again_v)
        if max(np.abs(u - again_u).max(), np.abs(v - again_v).max()) < 1e-12:
            break
    return x, y


@dataclass(frozen=True)
class View:
    """Takes radiance images of a textured world."""

    caster: RayCaster
    texture: Texture
    camera: Camera
    rays: np.ndarray
    """(H, W, 4, 3) float64, from `rays`."""
    middle: np.ndarray
    """(H, W, 3) float32, one ray through the middle of each pixel."""

    @classmethod
    def of(cls, caster: RayCaster, texture: Texture, camera: Camera) -> "View":
        """The view of a world through a camera."""
        four = rays(camera)
        return cls(caster, texture, camera, four, (0.5 * (four[:, :, 0] + four[:, :, 3])).astype(np.float32))

    def radiance(self, scene_from_camera: np.ndarray) -> np.ndarray:
        """Mean radiances (H, W, 3) float32 at a pose, or averaged over poses (n, 4, 4) during the exposure."""
        poses = scene_from_camera.reshape(-1, 4, 4)
        total = self._sharp(poses[0])
        for pose in poses[1:]:
            total = total + self._sharp(pose)
        return total / np.float32(len(poses))

    def _sharp(self, scene_from_camera: np.ndarray) -> np.ndarray:
        return self.texture.render(
            scene_from_camera, self.rays, self._quads(scene_from_camera), 0.5 / self.camera.fx
        )

    def _quads(self, scene_from_camera: np.ndarray) -> np.ndarray:
        """(H, W, 4) int32: what the rays of each pixel meet; one ray is cast where neighbors meet the same."""
        quads = self._cast(scene_from_camera, self.middle)
        edge = _differs_from_neighbors(quads)
        every = np.repeat(quads[..., None], 4, axis=-1)
        every[edge] = self._cast(scene_from_camera, self.rays[edge].astype(np.float32))
        return every

    def _cast(self, scene_from_camera: np.ndarray, rays: np.ndarray) -> np.ndarray:
        directions = rays.reshape(-1, 3) @ scene_from_camera[:3, :3].T.astype(np.float32)
        return self.caster.cast(scene_from_camera[:3, 3], directions)[1].reshape(rays.shape[:-1])


def _differs_from_neighbors(quads: np.ndarray) -> np.ndarray:
    """(H, W) bool: whether one of the eight neighbors is of another rectangle."""
    number = quads.astype(np.float32)
    kernel = np.ones((3, 3), np.uint8)
    return np.asarray(cv2.dilate(number, kernel) != cv2.erode(number, kernel))


def blur_times(time: float, duration: float) -> np.ndarray:
    """(5,) s: the moments averaged over an exposure of `duration` (s) around `time`."""
    return time + duration * (np.arange(_BLUR_POSES) - (_BLUR_POSES - 1) / 2) / _BLUR_POSES


def exposures(count: int, rng: np.random.Generator) -> np.ndarray:
    """(count,) exposure times relative to the first: smooth, with jumps that settle; within half to twice."""
    time = np.arange(count) / 100
    drift = sum(
        size * np.sin(2 * np.pi * rate * time + rng.uniform(0, 2 * np.pi))
        for size, rate in ((0.35, 1.3), (0.2, 2.9), (0.06, 7.0))
    )
    change = np.asarray(drift)
    for start in rng.choice(
        np.arange(1, max(count, 2)), size=min(max(count // 25, 1), max(count - 1, 1)), replace=False
    ):
        after = np.maximum(np.arange(count) - start, 0)
        change = change + rng.choice([-0.4, 0.4]) * (after > 0) * np.exp(-after / 20)
    change = change - change[0]
    largest = float(np.abs(change).max(initial=1e-9))
    return np.exp(change * rng.uniform(0.85, 1.0) * np.log(2.0) / max(largest, 1e-3))
