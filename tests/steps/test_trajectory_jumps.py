"""Jumps of a trajectory are found; speed, braking, shaking and gaps in time are none."""

import numpy as np
import pytest

from lvba import geometry
from lvba.steps import trajectory_jumps
from lvba.trajectory import Trajectory


def drive(times, noise=0.005, seed=0):
    """A car that speeds up, brakes and turns, with the noise of an odometry."""
    rng = np.random.default_rng(seed)
    x = 8 * times + 6 * np.sin(0.5 * times)
    heading = 0.3 * np.sin(0.4 * times)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :2, :2] = np.moveaxis(
        np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]), -1, 0
    )
    poses[:, 0, 3], poses[:, 1, 3] = x, 2 * np.sin(0.3 * times)
    return geometry.retract(poses, rng.normal(0, [noise / 10] * 3 + [noise] * 3, (len(times), 6)))


@pytest.mark.parametrize("rate", [1.0, 10.0])
def test_driving_is_no_jump_at_any_rate_nor_over_a_gap(rate):
    times = np.arange(0, 60, 1 / rate)
    assert len(trajectory_jumps.find(Trajectory(times, drive(times))).after) == 0
    kept = (times < 20) | (times > 21.5)
    assert len(trajectory_jumps.find(Trajectory(times[kept], drive(times[kept]))).after) == 0


@pytest.mark.parametrize(("meters", "degrees"), [(1.0, 0.0), (0.4, 1.0), (0.0, 6.0)])
def test_jumps_are_found_where_they_are(meters, degrees):
    times = np.arange(0, 30, 0.1)
    poses = drive(times)
    at = [40, 200]
    for after in at:
        jump = geometry.exp(np.array([0, 0, np.radians(degrees), 0, meters, 0]))
        poses[after + 1 :] = poses[after] @ jump @ geometry.inverse(poses[after]) @ poses[after + 1 :]
    found = trajectory_jumps.find(Trajectory(times, poses))
    assert found.after.tolist() == at
    assert found.meters == pytest.approx([meters] * 2, abs=0.1)
    # one degree is nothing special for an odometry
    assert found.degrees == pytest.approx([degrees if degrees > 1.8 else 0.0] * 2, abs=0.3)


@pytest.mark.parametrize("frames", [0, 1, 3, 5])
def test_few_frames_have_none(frames):
    times = np.arange(float(frames))
    assert len(trajectory_jumps.find(Trajectory(times, drive(times))).after) == 0
