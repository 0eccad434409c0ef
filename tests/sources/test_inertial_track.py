"""Poses of an odometry with their fast part by an IMU, against a motion that is known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lvba import geometry
from lvba.sources.importing import inertial
from lvba.sources.importing import turning as turnings
from lvba.sources.importing.survey import ImuReadings
from lvba.sources.importing.track import Track

IMU_FROM_LIDAR = geometry.exp(np.array([0.3, -0.2, 1.0, 0.1, -0.05, 0.2]))
GRAVITY = np.array([0.0, 0.0, 9.81])
GYROSCOPE_BIAS, ACCELEROMETER_BIAS = np.full(3, 0.02), np.full(3, 0.05)


def world_from_imu(times):
    """A hand that walks: a slow turn, a swing of 1 degree and 10 mm at 2.5 Hz, and a path that bends."""
    swing = np.sin(2 * np.pi * 2.5 * times)
    angles = np.stack([0.5 * times, np.radians(1.0) * swing, -np.radians(0.5) * swing], axis=-1)
    position = np.stack([times, 0.8 * np.sin(0.7 * times), 0.01 * swing], axis=-1)
    return geometry.from_rotation_translation(Rotation.from_euler("ZYX", angles).as_matrix(), position)


def readings(first, last):
    times = np.arange(first, last, 5e-3)
    step = 1e-4
    before, here, after = (world_from_imu(times + by) for by in (-step, 0.0, step))
    turned = geometry.log(geometry.inverse(before) @ after)[:, :3] / (2 * step)
    accelerations = (before - 2 * here + after)[:, :3, 3] / step**2
    forces = np.einsum("nji,nj->ni", here[:, :3, :3], accelerations + GRAVITY)
    return ImuReadings(times, turned + GYROSCOPE_BIAS, forces + ACCELEROMETER_BIAS)


def track_of(poses_off, seconds=12.0):
    """With poses ten a second, off by a function of time (N,) s to tangents (N, 6)."""
    times = np.arange(0.0, seconds, 0.1)
    true = world_from_imu(times) @ IMU_FROM_LIDAR
    return Track(times, true @ geometry.exp(poses_off(times)))


def moved(poses, imu):
    return inertial.moved(poses, turnings.turning(imu, IMU_FROM_LIDAR), imu, IMU_FROM_LIDAR)


def off(track, times):
    """Degrees and m: of the motion within 0.1 s from each time, largest."""
    within = [geometry.inverse(each.at(times)) @ each.at(times + 0.1) for each in (TRUE, track)]
    error = geometry.inverse(within[0]) @ within[1]
    return geometry.rotation_angle_deg(error).max(), np.linalg.norm(error[:, :3, 3], axis=1).max()


class TRUE:
    @staticmethod
    def at(times):
        return world_from_imu(times) @ IMU_FROM_LIDAR


def sway(times):
    """0.6 degrees and 30 mm within half a second, as of an odometry that registers scans which it has bent itself."""
    swing = np.sin(4 * np.pi * times)
    return np.stack(
        [0 * times, 0 * times, np.radians(0.6) * swing, 0.03 * swing, 0 * times, 0 * times], axis=-1
    )


def exact(times):
    return np.zeros((len(times), 6))


@pytest.mark.parametrize(("poses_off", "most_deg", "most_m"), [(sway, 0.02, 6e-3), (exact, 0.02, 1e-3)])
def test_what_poses_have_wrong_within_a_second_moves_no_scan(poses_off, most_deg, most_m):
    poses = track_of(poses_off)
    track = moved(poses, readings(-0.2, 12.2))
    inside = np.arange(0.5, 11.0, 0.05)
    degrees, meters = off(track, inside)
    assert degrees < most_deg
    assert meters < most_m
    if poses_off is sway:
        assert off(poses, inside)[0] > 10 * most_deg
        assert off(poses, inside)[1] > 5 * most_m
    # the slow part is that of the poses
    apart = geometry.inverse(TRUE.at(inside)) @ track.at(inside)
    assert geometry.rotation_angle_deg(apart).max() < 0.1
    assert np.linalg.norm(apart[:, :3, 3], axis=1).max() < 0.01


def test_gravity_and_bias_bend_nothing_at_the_ends():
    track = moved(track_of(exact), readings(-0.2, 12.2))
    ends = np.array([0.0, 0.05, 0.1, 11.7, 11.75, 11.8])
    apart = geometry.inverse(TRUE.at(ends)) @ track.at(ends)
    assert np.linalg.norm(apart[:, :3, 3], axis=1).max() < 0.01


def test_beyond_its_ends_it_stands_still_and_a_gap_makes_no_track():
    poses, imu = track_of(exact), readings(-0.2, 12.2)
    track = moved(poses, imu)
    np.testing.assert_array_equal(track.at(np.array([20.0])), track.at(np.array([track.ends[1]])))
    keep = (imu.times < 5.0) | (imu.times > 5.2)
    gap = ImuReadings(imu.times[keep], imu.rates[keep], imu.forces[keep])
    assert moved(poses, gap) is None
    assert moved(Track(poses.times[:5], poses.poses[:5]), imu) is None
