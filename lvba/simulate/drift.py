"""Rough poses as an odometry leaves them, of a chosen size."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline

from lvba import geometry
from lvba.arrays import Poses, Tangents, Times, Vector
from lvba.errors import InputError
from lvba.trajectory import pose_error

_STEP_S = 1.0
_NOISE_M, _NOISE_DEG = 0.012, 0.06
"""What scans have beside the drift, each for itself, at medium difficulty."""


@dataclass(frozen=True)
class Difficulty:
    """How wrong the rough poses are; all root mean squares."""

    scan_m: float
    """Position of scans after alignment, m."""
    scan_deg: float
    """Rotation of scans after alignment, degrees."""
    camera_m: float
    """Position of cameras beside the drift they fraction with the scans, m."""
    camera_deg: float
    """The same of their rotation, degrees."""
    time_offset_s: float
    """Images are stamped this much too early or too late at most, s."""
    scale: float
    """1 for medium."""


_MEDIUM = Difficulty(
    scan_m=0.08, scan_deg=0.2, camera_m=0.015, camera_deg=0.3, time_offset_s=0.004, scale=1.0
)


def difficulty(name: str) -> Difficulty:
    """easy: a third of medium and no time offset; hard: three times medium.

    Raises: InputError if there is no such difficulty.
    """
    scales = {"easy": 1 / 3, "medium": 1.0, "hard": 3.0}
    if name not in scales:
        raise InputError(
            "difficulty", f"there is none called {name[:40]!r}", f"take one of {', '.join(scales)}"
        )
    s, m = scales[name], _MEDIUM
    offset = 0.0 if name == "easy" else s * m.time_offset_s
    return Difficulty(
        scan_m=s * m.scan_m,
        scan_deg=s * m.scan_deg,
        camera_m=s * m.camera_m,
        camera_deg=s * m.camera_deg,
        time_offset_s=offset,
        scale=s,
    )


_DRIFT_DEG_PER_M = 6.0


def drifting(level: Difficulty, size_m: float) -> Difficulty:
    """The same with scans that are off by size_m, m, and by as many degrees as that means."""
    return replace(level, scan_m=size_m, scan_deg=_DRIFT_DEG_PER_M * size_m) if size_m else level


class Drift:
    """A smooth random walk over time, the same for scans and cameras."""

    def __init__(self, duration: float, rng: np.random.Generator) -> None:
        """duration: s"""
        count = max(int(duration / _STEP_S), 8) + 1
        self.knots = np.linspace(0, duration, count)
        walk = np.cumsum(rng.normal(size=(count, 6)), axis=0)
        self.walk = walk / np.sqrt(count)

    def at(self, times: Times, scale: tuple[float, float]) -> np.ndarray:
        """(N, 6) tangents at (N,) s; scale: of rotation (rad) and translation (m)."""
        inside = np.clip(times, self.knots[0], self.knots[-1])
        return np.asarray(CubicSpline(self.knots, self.walk)(inside) * np.repeat(scale, 3))


def rough_scans(
    truth: Poses, times: Times, drift: Drift, level: Difficulty, rng: np.random.Generator
) -> tuple[np.ndarray, tuple[float, float]]:
    """world_from_scan (S, 4, 4) whose error after alignment is about what `level` says, and the scale of the drift in it.

    truth: (S, 4, 4); times: (S,) s. The noise keeps its size, the drift takes what is left.
    """
    size_m, size_deg = level.scan_m * rng.uniform(0.85, 1.15), level.scan_deg * rng.uniform(0.85, 1.15)
    noise = _noise(len(truth), level.scale * _NOISE_M, level.scale * _NOISE_DEG, rng)
    scale = (np.radians(size_deg), size_m)
    rough = truth
    for _ in range(20):
        rough = truth @ geometry.exp(drift.at(times, scale)) @ geometry.exp(noise)
        error = pose_error(rough, truth)
        if error.ate_m == 0 or error.rotation_deg == 0:  # one scan: alignment takes everything
            break
        scale = (scale[0] * size_deg / error.rotation_deg, scale[1] * size_m / error.ate_m)
    return rough, scale


@dataclass(frozen=True)
class Closing:
    """Drift beside all other, which grows evenly to this size: by how much the ends of a loop miss each other."""

    size_m: float
    size_deg: float

    def __post_init__(self) -> None:
        """Raises: InputError if it is out of range."""
        if not (0 <= self.size_m <= 50 and 0 <= self.size_deg <= 45):
            raise InputError(
                "closing",
                f"{self.size_m} m and {self.size_deg} degrees",
                "take 0 to 50 m and 0 to 45 degrees",
            )

    def motion(self, rng: np.random.Generator) -> np.ndarray:
        """(6,) tangent of that size, mostly turned about the vertical."""
        turn, shift = rng.normal(size=3) * [0.2, 0.2, 1.0], rng.normal(size=3)
        turn *= np.radians(self.size_deg) / np.linalg.norm(turn)
        shift *= self.size_m / np.linalg.norm(shift)
        return np.concatenate([turn, shift])


def leaving(motion: Tangents, part: np.ndarray, last: Vector) -> np.ndarray:
    """drifted_from_world, (N, 4, 4): what poses are moved by.

    motion: (6,) tangent, what those at the end are moved by; part: (N,) float64, 0 at the start of the recording to 1 at
    its end
    last: (3,) m, where it ends
    """
    there = geometry.from_rotation_translation(np.eye(3), last)
    return np.asarray(
        there @ geometry.exp(np.clip(part, 0.0, 1.0)[:, None] * motion) @ geometry.inverse(there)
    )


@dataclass(frozen=True)
class CameraError:
    """What is wrong with the rough cameras beside the drift: one tangent for all, and one each."""

    extrinsic: np.ndarray
    """(6,): camera_from_true_camera of the slightly wrong extrinsic."""
    noise: np.ndarray
    """(I, 6)"""


def camera_error(motion: Poses, level: Difficulty, rng: np.random.Generator) -> CameraError:
    """An extrinsic error and noise that make, with the motion during the time offset, the size that `level` says.

    motion: (I, 4, 4), true camera from where the camera was at the stamped time
    """
    direction = rng.normal(size=6)
    direction[:3] /= np.linalg.norm(direction[:3])
    direction[3:] /= np.linalg.norm(direction[3:])
    noise = _noise(len(motion), 1.0, np.degrees(1.0), rng)
    fraction = rng.uniform(0.5, 0.7)
    extrinsic, each = direction * fraction, noise * (1 - fraction)
    scale = np.array([np.radians(level.camera_deg), level.camera_m])
    for _ in range(30):
        factor = np.repeat(scale, 3)
        error = motion @ geometry.exp(extrinsic * factor) @ geometry.exp(each * factor)
        size_m = np.sqrt(np.mean(np.sum(error[:, :3, 3] ** 2, axis=1)))
        size_deg = np.sqrt(np.mean(geometry.rotation_angle_deg(error) ** 2))
        scale = scale * [(level.camera_deg / size_deg) ** 0.7, (level.camera_m / size_m) ** 0.7]
    factor = np.repeat(scale, 3)
    return CameraError(extrinsic * factor, each * factor)


def _noise(count: int, size_m: float, size_deg: float, rng: np.random.Generator) -> np.ndarray:
    """(count, 6) tangents of that root mean square length."""
    sigma = np.repeat([np.radians(size_deg), size_m], 3) / np.sqrt(3)
    return np.asarray(rng.normal(size=(count, 6)) * sigma)
