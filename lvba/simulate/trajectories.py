"""How the sensors move: smooth paths with the sway of a walk or a vehicle."""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from lvba import geometry
from lvba.arrays import Times, Vectors

_SAMPLES_PER_M = 40
_TURN_RATE = 0.8
"""Fastest turn, rad/s: one walks slower where one turns."""


@dataclass(frozen=True)
class Motion:
    """Where the body is at each moment: x forward, y left, z up.

    duration: s; position: spline of (3,) over time, m, scene frame; angles: spline of yaw, pitch, roll (rad)
    """

    duration: float
    position: CubicSpline
    angles: CubicSpline

    def poses(self, times: Times) -> np.ndarray:
        """scene_from_body at (N,) seconds since the start, (N, 4, 4); continues at its velocity before and after."""
        yaw, pitch, roll = _going_on(self.angles, times).T
        zero = np.zeros_like(yaw)
        turns = (
            np.stack([zero, zero, yaw], -1),
            np.stack([zero, pitch, zero], -1),
            np.stack([roll, zero, zero], -1),
        )
        rotation = np.eye(3)
        for turn in turns:
            rotation = (
                rotation @ geometry.exp(np.concatenate([turn, np.zeros_like(turn)], axis=-1))[:, :3, :3]
            )
        return geometry.from_rotation_translation(rotation, _going_on(self.position, times))


def _going_on(spline: CubicSpline, times: Times) -> np.ndarray:
    """A spline at (N,) s, beyond its ends at the velocity that it has there: (N, 3).

    Its last piece is centiseconds long. There a sweep of 0.1 s before the first stamp turned at 2 rad/s, where the
    motion turned at 0.3.
    """
    inside = np.clip(times, spline.x[0], spline.x[-1])
    return np.asarray(spline(inside) + spline(inside, 1) * (times - inside)[:, None])


def along(
    corners: Vectors, speed: float, rng: np.random.Generator, *, rounding: float, sway: float = 1.0
) -> Motion:
    """A walk along a polyline at about constant speed, looking ahead and a little around.

    corners: (C, 3), m, scene frame; speed: m/s; rounding: over how many meters corners are rounded; sway: 1 for hands
    """
    length = np.r_[0, np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))]
    count = int(length[-1] * _SAMPLES_PER_M) + 2
    even = np.linspace(0, length[-1], count)
    line = np.stack([np.interp(even, length, corners[:, axis]) for axis in range(3)], axis=-1)
    line = gaussian_filter1d(line, rounding * _SAMPLES_PER_M, axis=0, mode="nearest")
    heading = np.unwrap(np.arctan2(np.gradient(line[:, 1]), np.gradient(line[:, 0])))
    heading = gaussian_filter1d(heading, 1.5 * rounding * _SAMPLES_PER_M, mode="nearest")
    return over_time(line, heading, speed, rng, sway)


def over_time(
    line: Vectors,
    yaw: np.ndarray,
    speed: float,
    rng: np.random.Generator,
    sway: float,
    pitch: float = 0.0,
) -> Motion:
    """The motion along a dense line (N, 3) with yaw (N,) and mean pitch (rad), with sway added.

    yaw: (N,) float64, rad; speed: m/s
    """
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    waits = np.maximum(np.maximum(steps, 1e-6) / speed, np.abs(np.diff(yaw)) / _TURN_RATE)
    time = np.r_[
        0, np.cumsum(gaussian_filter1d(waits, 0.3 / max(float(np.mean(steps)), 1e-3), mode="nearest"))
    ]
    position, angles = line.copy(), np.stack([yaw, np.full(len(yaw), pitch), np.zeros(len(yaw))], axis=-1)
    position[:, 2] += sway * 0.04 * _wave(time, 4.0, rng)
    for axis, (size, period) in enumerate([(0.10, 9.0), (0.04, 6.0), (0.03, 5.0)]):
        angles[:, axis] += sway * size * _wave(time, period, rng)
    return Motion(float(time[-1]), CubicSpline(time, position), CubicSpline(time, angles))


def _wave(time: np.ndarray, period: float, rng: np.random.Generator) -> np.ndarray:
    """(N,) within -1 to 1: two sines whose periods (s) do not fit together."""
    first, second = rng.uniform(0, 2 * np.pi, 2)
    other = period * rng.uniform(0.55, 0.7)
    return np.asarray(
        0.6 * np.sin(2 * np.pi * time / period + first) + 0.4 * np.sin(2 * np.pi * time / other + second)
    )
