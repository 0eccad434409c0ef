"""What an IMU at the body feels on its way, exactly and as a MEMS says it."""

from dataclasses import dataclass

import numpy as np

from lvba import geometry
from lvba.arrays import Pose, Times
from lvba.inertial.readings import GRAVITY, ImuReadings
from lvba.simulate.trajectories import Motion

HZ = 200
_STEP_S = 1e-3
_UP = np.array([0.0, 0.0, GRAVITY])
_MARGIN_S = 0.04
_GYROSCOPE_NOISE, _ACCELEROMETER_NOISE = 2e-3, 0.02
"""rad/s and m/s^2, of single readings."""
_GYROSCOPE_BIAS, _ACCELEROMETER_BIAS = 5e-3, 0.1
"""rad/s and m/s^2, standard deviations along each axis."""
_SCALE = 2e-3
"""Standard deviation of scales and of sines of angles between axes."""


@dataclass(frozen=True)
class SimulatedImu:
    """readings: stamped with moments (s) since the start of the motion; gyroscope_bias, accelerometer_bias: (3,), true;
    gyroscope_axes, accelerometer_axes: (3, 3), what true rates and forces are multiplied by"""

    readings: ImuReadings
    gyroscope_bias: np.ndarray
    accelerometer_bias: np.ndarray
    gyroscope_axes: np.ndarray
    accelerometer_axes: np.ndarray


def exact(motion: Motion, times: Times, body_from_imu: Pose | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Rates (N, 3), rad/s, and forces (N, 3), m/s^2, in the IMU's axes, at moments (N,) s since the start.

    body_from_imu: (4, 4), m; None: it is the body
    """
    extrinsic = np.eye(4) if body_from_imu is None else body_from_imu
    before, here, after = (motion.poses(times + step)[:, :3, :3] for step in (-_STEP_S, 0.0, _STEP_S))
    turn = np.zeros((len(times), 4, 4)) + np.eye(4)
    turn[:, :3, :3] = np.swapaxes(before, -1, -2) @ after
    lever = (before - 2 * here + after) @ extrinsic[:3, 3] / _STEP_S**2
    felt = np.einsum("nji,nj->ni", here, motion.position(times, 2) + lever + _UP)
    return geometry.log(turn)[:, :3] @ extrinsic[:3, :3] / (2 * _STEP_S), felt @ extrinsic[:3, :3]


def measure(motion: Motion, rng: np.random.Generator) -> SimulatedImu:
    """Readings over the whole motion, with noise, biases, and errors of scales and axes."""
    times = np.arange(-_MARGIN_S, motion.duration + _MARGIN_S, 1.0 / HZ)
    rates, forces = exact(motion, times)
    biases = rng.normal(size=(2, 3)) * np.array([[_GYROSCOPE_BIAS], [_ACCELEROMETER_BIAS]])
    axes = np.eye(3) + rng.normal(0, _SCALE, (2, 3, 3))
    noise = rng.normal(size=(2, len(times), 3))
    return SimulatedImu(
        readings=ImuReadings(
            times,
            rates @ axes[0].T + biases[0] + _GYROSCOPE_NOISE * noise[0],
            forces @ axes[1].T + biases[1] + _ACCELEROMETER_NOISE * noise[1],
        ),
        gyroscope_bias=biases[0],
        accelerometer_bias=biases[1],
        gyroscope_axes=axes[0],
        accelerometer_axes=axes[1],
    )
