"""The simulated camera: exact distortion, exposures, vignetting, response, noise and 8 bits."""

from dataclasses import dataclass, replace

import numpy as np

from lvba import lens as lenses
from lvba.arrays import Vector
from lvba.camera import Camera
from lvba.lens import Lens

_BLUR_POSES = 5
_VIGNETTING = 0.35
"""Part of the light missing in the corners."""
_FOCAL_PER_WIDTH = 0.78
_FISHEYE_RAD = np.radians(160.0)
_FOLLOWED = 0.5
"""Part of a change of brightness that an automatic exposure has made up for in the next image."""


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
    response: float = 1.0
    """Grey values are the light to the power of one over this."""
    srgb: float = 0.0
    """How much of the sRGB curve the grey values pass: 1 all, 0 none."""
    filmic: float = 0.0
    """How much of a filmic curve with a toe and a shoulder."""

    def __post_init__(self) -> None:
        if not 0 <= self.vignetting <= 0.9:
            raise ValueError(f"vignetting = {self.vignetting}: must lie in 0 to 0.9")

    def picture(
        self,
        radiance: np.ndarray,
        exposure: float,
        rng: np.random.Generator,
        white_balance: Vector | None = None,
    ) -> np.ndarray:
        """The (H, W, 3) uint8 image of mean radiances (H, W, 3) float32; white_balance: (3,), gains of the colors.

        radiance: (H, W, 3) float32
        """
        grey = radiance * np.float32(self.gain * exposure)
        if white_balance is not None:
            grey *= white_balance.astype(np.float32)
        if self.vignetting:
            grey *= _falloff(grey.shape[0], grey.shape[1], self.vignetting)[..., None]
        noise = rng.standard_normal(grey.shape, dtype=np.float32)
        if self.shot_noise:
            noise *= np.sqrt(self.noise**2 + self.shot_noise * grey)
        else:
            noise *= np.float32(self.noise)
        grey += noise
        grey = self._through_curves(grey)
        return np.clip(np.rint(grey), 0, 255).astype(np.uint8)

    def _through_curves(self, grey: np.ndarray) -> np.ndarray:
        """Grey values (H, W, 3) float32 as the camera stores them."""
        if self.response == 1 and not self.srgb and not self.filmic:
            return grey
        light = np.clip(grey / 255, 0, 1) ** np.float32(1 / self.response)
        if self.srgb:
            light = light + np.float32(self.srgb) * (srgb_curve(light) - light)
        if self.filmic:
            light = light + np.float32(self.filmic) * (filmic_curve(light) - light)
        return np.asarray(255 * light, np.float32)


def srgb_curve(light: np.ndarray) -> np.ndarray:
    """Grey values 0 to 1 of light 0 to 1 by IEC 61966-2-1. light: (...) float32"""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-6) ** (1 / 2.4) - 0.055)


def filmic_curve(light: np.ndarray) -> np.ndarray:
    """Grey values 0 to 1 of light 0 to 1: dark parts darker, bright ones compressed, then sRGB. light: (...) float32

    Source: the rational fit of the ACES curve of K. Narkowicz, 2016, scaled to end at 1.
    """
    toned = light * (2.51 * light + 0.03) / (light * (2.43 * light + 0.59) + 0.14)
    return srgb_curve(toned * (3.16 / 2.54))


def _falloff(height: int, width: int, missing: float) -> np.ndarray:
    """(H, W) float32: 1 in the middle, 1 - missing in the corners."""
    y, x = np.mgrid[0:height, 0:width]
    square = (x - (width - 1) / 2) ** 2 + (y - (height - 1) / 2) ** 2
    return np.asarray((1 - missing * square / square.max()).astype(np.float32))


def random_camera(width: int, height: int, rng: np.random.Generator) -> Camera:
    """A camera of about 65 degrees, with distortion."""
    focal = _FOCAL_PER_WIDTH * width * rng.uniform(0.95, 1.05)
    center = (0.5 * (width - 1), 0.5 * (height - 1)) + rng.uniform(-0.01, 0.01, 2) * width
    return Camera(
        width=width,
        height=height,
        fx=float(focal),
        fy=float(focal * rng.uniform(0.998, 1.002)),
        cx=float(center[0]),
        cy=float(center[1]),
        distortion=(
            float(rng.uniform(-0.12, -0.06)),
            float(rng.uniform(0.01, 0.04)),
            float(rng.uniform(-8e-4, 8e-4)),
            float(rng.uniform(-8e-4, 8e-4)),
        ),
    )


def fisheye_of(camera: Camera, rng: np.random.Generator) -> Camera:
    """An equidistant camera of the same size and principal point, of about 160 degrees along the wider side."""
    focal = max(camera.width, camera.height) / _FISHEYE_RAD * rng.uniform(0.97, 1.03)
    spread = np.array([0.02, 0.01, 0.004, 0.001])
    return replace(
        camera,
        fx=float(focal),
        fy=float(focal * rng.uniform(0.998, 1.002)),
        distortion=tuple(float(value) for value in spread * rng.uniform(-1, 1, 4)),
        lens=Lens.EQUIDISTANT,
    )


def rays(camera: Camera) -> np.ndarray:
    """(H, W, 4, 3) float64: rays (x, y, 1) of 2x2 places in each pixel, distortion inverted, camera frame."""
    column, row = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    places = [
        lenses.undistort(
            camera.lens,
            camera.distortion,
            (column + right - camera.cx) / camera.fx,
            (row + down - camera.cy) / camera.fy,
        )
        for down in (-0.25, 0.25)
        for right in (-0.25, 0.25)
    ]
    return np.stack([np.stack([x, y, np.ones_like(x)], axis=-1) for x, y in places], axis=2)


def blur_times(time: float, duration: float) -> np.ndarray:
    """(5,) s: the moments averaged over an exposure of `duration` (s) around `time` (s)."""
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
    return np.asarray(np.exp(change * rng.uniform(0.85, 1.0) * np.log(2.0) / max(largest, 1e-3)))


def white_balances(count: int, size: float, rng: np.random.Generator) -> np.ndarray:
    """(count, 3) gains of red, green and blue that drift apart and back by `size`; 1 in the first image."""
    time = np.arange(count) / max(count - 1, 1)
    phase, rate = rng.uniform(0, 2 * np.pi, 3), rng.uniform(1.0, 2.0, 3)
    wave = np.sin(2 * np.pi * rate * time[:, None] + phase)
    change = size * (wave - wave.mean(axis=1, keepdims=True))
    return np.asarray(np.exp(change - change[0]))


def automatic_exposures(brightness: np.ndarray, part: float) -> np.ndarray:
    """(count,) exposures relative to the first, which follow the mean radiances (count,) with some delay.

    part: 1 holds the mean grey value, 0 does nothing
    brightness: (count,) float64, mean radiances
    """
    wanted = -part * np.log(brightness)
    followed = np.empty_like(wanted)
    state = wanted[0]
    for index, value in enumerate(wanted):
        state += _FOLLOWED * (value - state)
        followed[index] = state
    return np.asarray(np.exp(followed - followed[0]))
