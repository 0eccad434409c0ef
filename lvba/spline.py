"""Poses between the samples of a trajectory by twice differentiable splines, and how far these may be off."""

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from lvba import geometry, trajectory
from lvba.trajectory import Trajectory

FEWEST_SAMPLES = 5
"""Of a trajectory, to tell how far its spline may be off."""


def through(samples: Trajectory, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses (Q, 4, 4) at the times (Q,), and (Q, 2) by how much (rad, m) one that is left out may be missed.

    samples: at least FEWEST_SAMPLES. Times before the first and after the last are taken for these: see `outside`.
    The second is the error of predicting a sample from two neighbors on either side. A spline is off by a part of it:
    most half way between samples, where it is given in full, and not at all at one.
    """
    clamped = np.clip(times, samples.times[0], samples.times[-1])
    rotation = RotationSpline(samples.times, Rotation.from_matrix(samples.world_from_sensor[:, :3, :3]))
    position = CubicSpline(samples.times, samples.world_from_sensor[:, :3, 3])
    pose = geometry.from_rotation_translation(rotation(clamped).as_matrix(), position(clamped))
    missed = _leave_one_out(samples)
    before, fraction = trajectory.bracket(samples.times, times)
    around = np.maximum(missed[before], missed[np.minimum(before + 1, len(samples) - 1)])
    inside = ~outside(samples, times)
    around *= np.where(inside, 4 * fraction * (1 - fraction), 1.0)[:, None]
    return pose, around


def outside(samples: Trajectory, times: np.ndarray) -> np.ndarray:
    """Which times (Q,) are before the first sample or after the last, (Q,) bool."""
    return np.asarray((times < samples.times[0]) | (times > samples.times[-1]))


def _leave_one_out(samples: Trajectory) -> np.ndarray:
    """(N, 2): by how much (rad, m) each pose differs from the cubic through its two neighbors on either side."""
    count = len(samples)
    index = np.arange(2, count - 2)[:, None] + [-2, -1, 1, 2]
    middle = geometry.inverse(samples.world_from_sensor[2:-2])
    around = geometry.log(middle[:, None] @ samples.world_from_sensor[index])
    offset = samples.times[index] - samples.times[2:-2, None]
    weight = np.ones(offset.shape)
    for a in range(4):
        for b in range(4):
            if a != b:
                weight[:, a] *= offset[:, b] / (offset[:, b] - offset[:, a])
    missed = np.einsum("sa,saj->sj", weight, around)
    size = np.stack([np.linalg.norm(missed[:, :3], axis=1), np.linalg.norm(missed[:, 3:], axis=1)], axis=1)
    return np.pad(size, ((2, 2), (0, 0)), mode="edge") / np.sqrt(3.0)
