"""A hand-held motion, and what an IMU on it feels."""

import numpy as np
from scipy.interpolate import CubicSpline

from lvba import geometry
from lvba.inertial.readings import ImuReadings

SECONDS, SCANS = 6.0, 9
DOWNWARD = np.array([0.3, -0.2, 1.0]) / np.linalg.norm([0.3, -0.2, 1.0]) * -9.81


def path(seed: int = 1):
    """Poses (N, 4, 4) and accelerations (N, 3), world axes, of a hand-held sensor, over time."""
    rng = np.random.default_rng(seed)
    knots = np.linspace(-1, SECONDS + 1, 14)
    angles = CubicSpline(knots, rng.normal(0, 0.35, (14, 3)))
    places = CubicSpline(knots, np.cumsum(rng.normal(0, 0.4, (14, 3)), axis=0))

    def poses(times):
        flat = np.concatenate([angles(times), np.zeros((len(times), 3))], axis=1)
        return geometry.from_rotation_translation(geometry.exp(flat)[:, :3, :3], places(times))

    return poses, lambda times: places(times, 2)


def measured(bias=(0.0,) * 6, mount=None, hz: float = 400.0, noise=(0.0, 0.0), seed: int = 3):
    """Readings of an IMU at `mount` (scan_from_imu) without noise, and the scans' times and true poses."""
    poses, bias = path()[0], np.array(bias)
    mount = np.eye(4) if mount is None else mount
    rng, step = np.random.default_rng(seed), 1e-3
    times = np.arange(-0.5, SECONDS + 0.5, 1 / hz)
    before, here, after = (poses(times + off) @ mount for off in (-step, 0, step))
    rates = geometry.log(geometry.inverse(before) @ after)[:, :3] / (2 * step)
    accelerations = (before - 2 * here + after)[:, :3, 3] / step**2
    forces = np.einsum("nji,nj->ni", here[:, :3, :3], accelerations - DOWNWARD)
    rates = rates + bias[:3] + rng.normal(size=rates.shape) * noise[0]
    forces = forces + bias[3:] + rng.normal(size=forces.shape) * noise[1]
    scans = np.sort(np.r_[0.1, rng.uniform(0, SECONDS, SCANS - 2), SECONDS - 0.1])
    return ImuReadings(times, rates, forces), scans, poses(scans)
