"""Between the poses of an odometry: a gyroscope, and smoothing, against a motion that is known."""

import numpy as np
import pytest
from scipy.interpolate import make_smoothing_spline
from scipy.spatial.transform import Rotation

from lvba import geometry
from lvba.sources.importing import smoothing, smoothing_spline
from lvba.sources.importing import turning as turnings
from lvba.sources.importing.survey import ImuReadings
from lvba.sources.importing.track import Track
from lvba.sources.importing.turning import TurningTrack

IMU_FROM_LIDAR = geometry.exp(np.array([0.3, -0.2, 1.0, 0.1, 0.0, 0.0]))


def world_from_imu(times):
    """A hand that walks: a slow turn, and a swing of 1 degree at 2.5 Hz."""
    swing = np.radians(1.0) * np.sin(2 * np.pi * 2.5 * times)
    angles = np.stack([0.5 * times, swing, -0.5 * swing], axis=-1)
    position = np.stack([times, np.zeros(len(times)), np.zeros(len(times))], axis=-1)
    return geometry.from_rotation_translation(Rotation.from_euler("ZYX", angles).as_matrix(), position)


def gyroscope(first, last, bias=0.0):
    times = np.arange(first, last, 5e-3)
    step = 1e-4
    turned = geometry.log(geometry.inverse(world_from_imu(times - step)) @ world_from_imu(times + step))
    return ImuReadings(times, turned[:, :3] / (2 * step) + bias, np.zeros((len(times), 3)))


def off(track, times):
    """(Q,) degrees."""
    true = world_from_imu(times) @ IMU_FROM_LIDAR
    return geometry.rotation_angle_deg(geometry.inverse(true) @ track.at(times))


@pytest.fixture
def plain():
    times = np.arange(0.0, 5.0, 0.1)
    return Track(times, world_from_imu(times) @ IMU_FROM_LIDAR)


def test_between_poses_the_track_turns_as_the_gyroscope_says(plain):
    queries = np.linspace(0.0, 4.9, 500)
    turned = TurningTrack(
        plain.times, plain.poses, turnings.turning(gyroscope(-0.2, 5.2, bias=0.02), IMU_FROM_LIDAR)
    )
    assert off(plain, queries).max() > 0.2
    assert off(turned, queries).max() < 0.01
    # poses themselves stay, and so do positions
    np.testing.assert_allclose(turned.at(plain.times), plain.poses, atol=1e-12)
    np.testing.assert_array_equal(turned.at(queries)[:, :3, 3], plain.at(queries)[:, :3, 3])


def test_where_the_gyroscope_has_a_gap_the_poses_count_alone(plain):
    readings = gyroscope(1.0, 4.0)
    keep = (readings.times < 2.02) | (readings.times > 2.08)
    holed = ImuReadings(readings.times[keep], readings.rates[keep], readings.forces[keep])
    turned = TurningTrack(plain.times, plain.poses, turnings.turning(holed, IMU_FROM_LIDAR))
    for first, last in ((0.0, 0.9), (2.0, 2.1), (4.0, 4.9)):
        queries = np.linspace(first + 1e-6, last - 1e-6, 50)
        np.testing.assert_array_equal(turned.at(queries), plain.at(queries))
    queries = np.concatenate([np.linspace(1.1, 1.9, 50), np.linspace(2.2, 3.8, 50)])
    assert off(turned, queries).max() < 0.01


def test_without_its_axes_a_gyroscope_says_nothing():
    assert turnings.turning(gyroscope(0.0, 1.0), None) is None
    assert turnings.turning(None, IMU_FROM_LIDAR) is None


def bend(track):
    """m: root mean square of the error of the motion within sweeps of 0.1 s, 10 m away."""
    begins = np.arange(0.35, 4.5, 0.1)
    squares = []
    for begin in begins:
        times = begin + np.array([0.0, 0.05, 0.1])
        true = world_from_imu(times) @ IMU_FROM_LIDAR
        within = geometry.inverse(track.at(times[:1])) @ track.at(times)
        error = geometry.inverse(geometry.inverse(true[:1]) @ true) @ within
        squares.append(
            (error[:, :3, 3] ** 2).sum(axis=1) + np.radians(10 * geometry.rotation_angle_deg(error)) ** 2
        )
    return np.sqrt(np.mean(squares))


def test_noise_of_single_poses_is_smoothed_out_as_far_as_it_is_noise(plain):
    rng = np.random.default_rng(0)
    noise = rng.normal(size=(len(plain), 6)) * np.repeat([np.radians(0.05), 0.01], 3)
    noisy = Track(plain.times, plain.poses @ geometry.exp(noise))
    turning = turnings.turning(gyroscope(-0.2, 5.2, bias=0.02), IMU_FROM_LIDAR)
    with_gyroscope = TurningTrack(noisy.times, noisy.poses, turning)
    smooth = smoothing.smooth(noisy, turning)
    assert bend(smooth) < 0.25 * bend(with_gyroscope)
    # poses without noise stay where they are, but for what a swing of 2.5 Hz has in common with noise
    exact = smoothing.smooth(plain, turning)
    assert bend(exact) < 2e-3
    np.testing.assert_allclose(exact.at(plain.times)[:, :3, 3], plain.poses[:, :3, 3], atol=3e-3)


def swaying(plain):
    """As poses of an odometry that registers scans which it has bent itself."""
    sway = np.zeros((len(plain), 6))
    sway[:, 2] = np.radians(0.6) * np.sin(2 * np.pi * plain.times / 0.5)
    return Track(plain.times, plain.poses @ geometry.exp(sway))


def test_what_changes_too_fast_for_the_drift_of_a_gyroscope_is_no_turn(plain):
    """No cross-validation takes it for noise."""
    poses = swaying(plain)
    turning = turnings.turning(gyroscope(-0.2, 5.2, bias=0.02), IMU_FROM_LIDAR)
    followed = smoothing.smooth(poses, turning)
    drifting = smoothing.smooth(poses, turnings.unbiased(turning, poses), 3.0)
    assert bend(drifting) < 0.1 * bend(followed)
    assert off(drifting, plain.times[10:-10]).max() < 0.1


@pytest.mark.parametrize(("jump_deg", "most"), [(0.0, 4e-3), (8.0, 9e-3)])
def test_a_constant_bias_shows_in_what_poses_turn_over_seconds(plain, jump_deg, most):
    poses = swaying(plain).poses
    poses[20:] = geometry.exp(np.radians([0.0, 0.0, jump_deg, 0, 0, 0])) @ poses[20:]
    readings = gyroscope(-0.2, 5.2, bias=0.02)
    turning = turnings.turning(readings, IMU_FROM_LIDAR)
    bias = turning.rates - turnings.unbiased(turning, Track(plain.times, poses)).rates
    np.testing.assert_allclose(bias, np.broadcast_to(bias[0], bias.shape), atol=1e-12)
    true = IMU_FROM_LIDAR[:3, :3].T @ np.full(3, 0.02)
    assert np.linalg.norm(bias[0] - true) < most
    # of a second of poses nothing is known
    few = Track(plain.times[:12], poses[:12])
    assert turnings.unbiased(turning, few) is turning


def test_a_gyroscope_with_a_gap_smooths_nothing(plain):
    readings = gyroscope(-0.2, 5.2)
    keep = (readings.times < 2.02) | (readings.times > 2.2)
    holed = turnings.turning(
        ImuReadings(readings.times[keep], readings.rates[keep], readings.forces[keep]), IMU_FROM_LIDAR
    )
    assert smoothing.smooth(plain, holed) is None
    late = turnings.turning(gyroscope(0.25, 5.2), IMU_FROM_LIDAR)
    assert smoothing.smooth(plain, late).times[0] == pytest.approx(0.3)


@pytest.mark.parametrize("stiffness", [1e-3, 1.0, 1e5])
def test_a_smoothing_spline_and_its_freedom_are_those_of_their_definition(stiffness):
    rng = np.random.default_rng(0)
    times, values = np.cumsum(rng.uniform(0.5, 1.5, 40)), rng.normal(size=(40, 2))
    bands = smoothing_spline._Bands.of(times)
    factor = bands.factor(stiffness)
    off = bands.left(stiffness, factor, values)
    plain = [make_smoothing_spline(times, column, lam=stiffness)(times) for column in values.T]
    np.testing.assert_allclose(values - off, np.stack(plain, axis=1), rtol=0, atol=1e-9)
    hat = [make_smoothing_spline(times, column, lam=stiffness)(times) for column in np.eye(40)]
    freedom = stiffness * smoothing_spline._traces(factor[None], bands.qq)[0]
    assert freedom == pytest.approx(40 - np.trace(hat), rel=1e-9)


def test_each_column_is_as_smooth_as_leaving_out_its_samples_asks_for():
    rng, times = np.random.default_rng(1), np.arange(300.0)
    noise = 0.1 * rng.normal(size=(300, 2))
    true = np.stack([np.sin(times / 20), np.sin(times / 2)], axis=1)
    left = smoothing_spline.fit(times, true + noise)(times) - true
    crossed = make_smoothing_spline(times, (true + noise)[:, 0])(times) - true[:, 0]
    assert np.sqrt(np.mean(left[:, 0] ** 2)) < 1.05 * np.sqrt(np.mean(crossed**2)) < 0.05
    assert np.sqrt(np.mean(left[:, 1] ** 2)) < 0.09


def test_of_swings_at_the_slowest_no_more_than_half_remains():
    times = np.arange(400.0)
    for slower, most in ((1.0, 0.51), (3.0, 0.02)):
        swing = np.sin(slower * times / 5.0)[:, None]
        left = smoothing_spline.fit(times, swing, 5.0)(times)[100:300]
        assert np.abs(left).max() < most
    # stiffer than any that is tried without a limit
    slow = np.sin(times / 1000.0)[:, None]
    assert np.abs(smoothing_spline.fit(times, swing + slow, 300.0)(times) - slow)[50:350].max() < 0.05
    np.testing.assert_allclose(smoothing_spline.fit(times, swing)(times), swing, rtol=0, atol=1e-3)
