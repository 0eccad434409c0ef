"""How fast the LiDAR moved at the images, by its trajectory, and how well that is known."""

import numpy as np
from scipy.spatial.transform import Rotation

from lvba import spline, trajectory
from lvba.arrays import Times
from lvba.trajectory import Trajectory
from lvba.visual.prior_config import FLOOR_POSITION_M, FLOOR_ROTATION_DEG

_RATE_STEP_S = 0.02
RATES = 0.5
"""Error of rates by a spline, as a part of what leaving a sample out changes over the time between samples: on simulated
walks 0.1 to 0.2 where samples are near each other, 0.2 to 0.9 where they are 0.5 to 1.5 s apart (root mean squares)."""


def rates_of(scans: Trajectory, times: Times) -> tuple[np.ndarray, np.ndarray]:
    """Velocity in the world (Q, 3), m/s, and angular rate in the sensor's frame (Q, 3), rad/s, at times (Q,), s."""
    if len(scans) < 2:
        return np.zeros((len(times), 3)), np.zeros((len(times), 3))
    interpolate = spline.through if len(scans) >= spline.FEWEST_SAMPLES else trajectory.sample
    clamped = np.clip(times, scans.times[0] + _RATE_STEP_S, scans.times[-1] - _RATE_STEP_S)
    before, after = interpolate(scans, clamped - _RATE_STEP_S), interpolate(scans, clamped + _RATE_STEP_S)
    turn = np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3]
    rate = Rotation.from_matrix(turn).as_rotvec() / (2 * _RATE_STEP_S)
    return (after[:, :3, 3] - before[:, :3, 3]) / (2 * _RATE_STEP_S), rate


def turns_of(cameras: Trajectory, readout: float) -> np.ndarray | None:
    """(I, 3) float64, rad, about each camera's own axes: how far it turns while the rows of its image are read, by the
    path of all cameras; None: they are read at once.

    readout: s, from the first to the last row
    """
    return rates_of(cameras, cameras.times)[1] * readout if readout else None


def rate_sigmas_of(samples: Trajectory, times: Times) -> np.ndarray | None:
    """(Q, 6): how far `rates_of` may be off in each component at times (Q,), rad/s and m/s; None: too few samples tell.

    A part of what leaving a sample out changes. Poses of samples are not better known than the floor.
    """
    if len(samples) < spline.FEWEST_SAMPLES:
        return None
    floor = np.array([np.radians(FLOOR_ROTATION_DEG), FLOOR_POSITION_M])
    return np.repeat(RATES * spline.leave_one_out_rates(samples, times, floor), 3, axis=1)
