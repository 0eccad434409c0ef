"""Jumps of a trajectory: motions between neighboring frames that do not go on as those before and after them do."""

from dataclasses import dataclass

import numpy as np

from lvba import geometry
from lvba.trajectory import Trajectory

_NEIGHBORS = 2
_FEWEST_STEPS = 2 * _NEIGHBORS + 1
_ORDINARY = 6.0
"""Times the typical change from one motion to the next (some nine standard deviations of noise) that is nothing special:
people and cars speed up, brake and shake."""
_LEAST_M, _LEAST_DEG = 0.15, 1.8
"""Smaller ones are within three standard deviations of what is expected of an odometry from frame to frame."""


@dataclass(frozen=True)
class Jumps:
    """after: (J,) int64, frames after which the trajectory jumps; meters, degrees: (J,) by how much, 0 where that alone
    would be no jump"""

    after: np.ndarray
    meters: np.ndarray
    degrees: np.ndarray


def find(trajectory: Trajectory) -> Jumps:
    """The jumps of a trajectory; a gap in time is none as long as the speed fits."""
    meters, degrees = unexpected(trajectory)
    if len(meters) < _FEWEST_STEPS:
        return Jumps(np.zeros(0, np.int64), np.zeros(0), np.zeros(0))
    interval = np.diff(trajectory.times)
    jumps = []
    judged = slice(_NEIGHBORS, len(meters) - _NEIGHBORS)
    for size, least in ((meters, _LEAST_M), (degrees, _LEAST_DEG)):
        ordinary = _ORDINARY * np.median((size / interval)[judged]) * interval
        jumps.append(np.where(size > np.maximum(ordinary, least), size, 0.0))
    after = np.flatnonzero((jumps[0] > 0) | (jumps[1] > 0))
    return Jumps(after, jumps[0][after], jumps[1][after])


def unexpected(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """How far each motion to the next frame, (N - 1,) m and degrees, is from what the two before and the two after it let
    expect (the median of their speeds); 0 of the first two and the last two, which have none on one side."""
    poses, interval = trajectory.world_from_sensor, np.diff(trajectory.times)
    if len(interval) < _FEWEST_STEPS:
        return np.zeros(len(interval)), np.zeros(len(interval))
    rate = geometry.log(geometry.inverse(poses[:-1]) @ poses[1:]) / interval[:, None]
    offsets = [k for k in range(-_NEIGHBORS, _NEIGHBORS + 1) if k]
    inner = np.arange(_NEIGHBORS, len(rate) - _NEIGHBORS)
    off = np.zeros_like(rate)
    off[inner] = rate[inner] - np.median(rate[inner[:, None] + offsets], axis=1)
    off *= interval[:, None]
    return np.linalg.norm(off[:, 3:], axis=1), np.degrees(np.linalg.norm(off[:, :3], axis=1))
