"""Where a sensor will be at its next sweep: by its last motion, and by the IMU where there is one."""

from dataclasses import dataclass, replace

import numpy as np

from lvba import geometry
from lvba.arrays import Pose, StepSigmas, Tangents
from lvba.sources.odometry.sweeps import Inertial, Sweep

_TURN_ACCELERATION, _ACCELERATION = 4.0, 2.0
"""rad/s^2 and m/s^2: how hands and vehicles change a motion until the next scan, one standard deviation."""
_GYROSCOPE_RAD = 0.002
"""Turn between two scans by the gyroscope, one standard deviation: its noise, its bias and its extrinsic."""
_FORCE_SIGMA = 0.5
"""m/s^2, of an acceleration by the IMU: attitude, bias and lever arm."""
_FIRST_TURN, _FIRST_SPEED = 1.0, 20.0
"""rad/s and m/s: how fast a recording may begin, one standard deviation."""
_MEMORY = 0.02
"""Part of what a scan says of biases and of gravity that is taken over."""


@dataclass(frozen=True)
class Motion:
    """The motion up to a scan.

    time: s; pose: (4, 4), world_from_lidar
    interval: s, since the scan before, 0 at the first one
    velocity: (3,), m/s, world axes, mean since the scan before; turn_rate: (3,), rad/s, own axes
    bias: (3,), rad/s, of the gyroscope
    gravity: (3,), m/s^2, world axes, what the IMU feels without acceleration, with its bias; None: not known yet
    """

    time: float
    pose: Pose
    interval: float
    velocity: np.ndarray
    turn_rate: np.ndarray
    bias: np.ndarray
    gravity: np.ndarray | None

    @staticmethod
    def at_rest(time: float) -> "Motion":
        """At the world's origin, at a time (s)."""
        return Motion(
            time=time,
            pose=np.eye(4),
            interval=0.0,
            velocity=np.zeros(3),
            turn_rate=np.zeros(3),
            bias=np.zeros(3),
            gravity=None,
        )


@dataclass(frozen=True)
class Prediction:
    """What is expected of a scan.

    pose: (4, 4), world_from_lidar; sigma: (6,), rad and m, of its tangent
    during: (6,), rad/s and m/s, own axes, velocity while the sweep was measured
    turn: (3,), rad, since the scan before by the gyroscope, None without; force: (3,), m/s^2, world axes, or None
    """

    pose: Pose
    sigma: StepSigmas
    during: Tangents
    turn: np.ndarray | None
    force: np.ndarray | None


def predict(motion: Motion, sweep: Sweep, imu: Inertial | None) -> Prediction:
    """Where the sensor is at a sweep."""
    seconds = sweep.time - motion.time
    turn = imu.turn(motion.time, sweep.time, motion.bias) if imu else None
    rotation = motion.turn_rate * seconds if turn is None else turn
    force = (
        imu.force(motion.time - motion.interval / 2, motion.time + seconds / 2, motion.bias) if imu else None
    )
    velocity, spread = motion.velocity, _ACCELERATION * seconds
    if force is not None:
        before = np.r_[-motion.turn_rate * motion.interval / 2, np.zeros(3)]
        force = geometry.retract(motion.pose, before)[:3, :3] @ force
        if motion.gravity is not None and motion.interval:
            velocity = velocity + (force - motion.gravity) * (seconds + motion.interval) / 2
            spread = _FORCE_SIGMA * seconds
    pose = geometry.retract(motion.pose, np.r_[rotation, np.zeros(3)])
    pose[:3, 3] += velocity * seconds
    turn_sigma = _TURN_ACCELERATION * seconds**2 if turn is None else _GYROSCOPE_RAD
    if not motion.interval:
        spread = _FIRST_SPEED
        turn_sigma = turn_sigma if turn is not None else _FIRST_TURN * seconds
    inside = imu.turn(*sweep.extent, motion.bias) if imu else None
    length = sweep.extent[1] - sweep.extent[0]
    rate = motion.turn_rate if inside is None or not length else inside / length
    own = pose[:3, :3].T @ velocity
    return Prediction(pose, np.repeat([turn_sigma, spread * seconds], 3), np.r_[rate, own], turn, force)


def moved_on(motion: Motion, time: float, pose: Pose, registered: Pose, prediction: Prediction) -> Motion:
    """The motion up to a scan that is at `pose` (4, 4).

    time: s, of the scan; registered: (4, 4), its pose as the map alone has it
    """
    seconds = time - motion.time
    velocity = (pose[:3, 3] - motion.pose[:3, 3]) / seconds
    turned = geometry.log(geometry.inverse(motion.pose) @ pose)[:3]
    bias, gravity = motion.bias, motion.gravity
    if prediction.turn is not None:
        off = prediction.turn - geometry.log(geometry.inverse(motion.pose) @ registered)[:3]
        bias = bias + _MEMORY * np.clip(off, -3 * _GYROSCOPE_RAD, 3 * _GYROSCOPE_RAD) / seconds
    if prediction.force is not None:
        if motion.gravity is None:
            gravity = prediction.force
        elif motion.interval:
            felt = prediction.force - (velocity - motion.velocity) / ((seconds + motion.interval) / 2)
            off = np.clip(felt - motion.gravity, -2 * _FORCE_SIGMA, 2 * _FORCE_SIGMA)
            gravity = motion.gravity + _MEMORY * off
    return replace(
        motion,
        time=time,
        pose=pose,
        interval=seconds,
        velocity=velocity,
        turn_rate=turned / seconds,
        bias=bias,
        gravity=gravity,
    )
