"""Raw recordings: each point was measured from where the sensor was at its own time, and drivers write what they say."""

from dataclasses import replace

import numpy as np
import pytest

from lvba import geometry
from lvba.simulate import lidar, raw
from lvba.simulate.raw import Conventions, Moment, PoseOf, Sensors

FEW = Sensors(points=1500, width=64, height=48, image_hz=2.0)


def placed(truth, number, times):
    """Points of a sweep in the scene, and where the sensor was, by poses at some times."""
    poses = truth.scene_from_body(times) @ truth.rig.body_from_lidar
    points = truth.points[number].astype(float)
    return np.einsum("nij,nj->ni", poses[:, :3, :3], points) + poses[:, :3, 3], poses[:, :3, 3]


def off_surface(truth, number, times):
    """(N,) m: how far along its beam each point is from the surface that the beam meets."""
    points, centers = placed(truth, number, times)
    part, _ = truth.around.caster.cast(centers, points - centers)
    return np.abs(part - 1) * np.linalg.norm(points - centers, axis=1)


@pytest.mark.parametrize("pattern", ["spinning", "non_repetitive"])
def test_every_point_lies_on_the_surface_at_its_own_time(monkeypatch, pattern):
    monkeypatch.setattr(lidar, "RANGE_NOISE_M", 0.0)
    monkeypatch.setattr(lidar, "_MIXED", 0.0)
    sensors = Sensors(lidar=pattern, points=1500, width=64, height=48, image_hz=1.0)
    truth = raw.measure("courtyard", seconds=1.0, seed=1, sensors=sensors)
    for number in (0, 7):
        times = truth.point_times[number]
        assert len(times) == len(truth.points[number]) > 500
        begin = truth.scans[number]
        assert (
            begin < times.min() < begin + 3_000_000 < begin + 90_000_000 < times.max() <= begin + 100_000_000
        )
        # at an edge, float32 may miss the surface
        assert np.quantile(off_surface(truth, number, times), 0.998) < 1e-3
        assert np.mean(off_surface(truth, number, np.full(len(times), times.min()))) > 1e-2


@pytest.fixture(scope="module")
def truth():
    return raw.measure("courtyard", seconds=1.0, sensors=FEW)


@pytest.mark.parametrize("header", list(Moment))
@pytest.mark.parametrize("absolute", [False, True])
def test_times_of_points_are_as_the_driver_counts_them(truth, header, absolute):
    conventions = Conventions(header=header, absolute=absolute, unit=1e-6, time_type="float64")
    scans = [record for stream, record in raw.written(truth, conventions).items if stream == raw.LIDAR]
    for scan, begin, times in zip(scans, truth.scans, truth.point_times, strict=True):
        assert (
            scan.stamp
            == begin + {Moment.BEGIN: 0, Moment.MIDDLE: 50_000_000, Moment.END: 100_000_000}[header]
        )
        zero = 0 if absolute else scan.stamp
        np.testing.assert_allclose(scan.times, (times - zero) * 1e-3, atol=0.3 if absolute else 1e-6)


@pytest.mark.parametrize("pose_of", list(PoseOf))
@pytest.mark.parametrize("inverse", [False, True])
def test_poses_of_the_odometry_are_of_what_they_are_said(truth, pose_of, inverse):
    quiet = Sensors(odometry_noise=0.0, odometry_noise_deg=0.0)
    conventions = Conventions(pose_of=pose_of, inverse=inverse, pose_moment=Moment.END, odometry_delay=0.01)
    source = raw.written(truth, conventions, quiet)
    poses = [record for stream, record in source.items if stream == raw.ODOMETRY]
    for pose in poses:
        body = truth.scene_from_body(np.array([pose.stamp - 10_000_000 + 100_000_000]))[0]
        child = {
            PoseOf.BODY: np.eye(4),
            PoseOf.LIDAR: truth.rig.body_from_lidar,
            PoseOf.CAMERA: geometry.inverse(truth.rig.camera_from_body),
        }[pose_of]
        given = geometry.inverse(pose.parent_from_child) if inverse else pose.parent_from_child
        np.testing.assert_allclose(given, body @ child, atol=1e-9)


def test_the_imu_turns_and_falls_as_the_body_does(truth):
    imu = [record for stream, record in raw.written(truth).items if stream == raw.IMU]
    times = np.array([sample.stamp for sample in imu])
    assert np.all(np.diff(times) == 5_000_000)
    poses = truth.scene_from_body(times)
    turned = geometry.log(geometry.inverse(poses[:-1]) @ poses[1:])[:, :3] / 5e-3
    rates = np.array([sample.gyroscope for sample in imu])
    assert np.abs(turned - 0.5 * (rates[1:] + rates[:-1])).max() < 0.02
    up = np.einsum("nij,nj->ni", poses[:, :3, :3], [sample.accelerometer for sample in imu])
    assert np.abs(up.mean(axis=0) - [0, 0, 9.81]).max() < 1.0


def test_the_same_seed_gives_the_same_source():
    def make(seed):
        source, _ = raw.simulate_raw("rooms", seconds=0.3, seed=seed, sensors=FEW)
        return [getattr(record, "points", getattr(record, "encoded", None)) for _, record in source.items]

    assert str(make(2)) == str(make(2)) != str(make(3))


def test_sensors_may_stand_still_before_they_move():
    """Odometries with an IMU take gravity from that; then the path is the same."""
    moving = raw.measure("courtyard", seconds=0.5, sensors=FEW)
    truth = raw.measure("courtyard", seconds=0.5, sensors=replace(FEW, rest_s=2.0))
    seconds = np.arange(0.0, 12.0, 0.1)
    poses = truth.motion.poses(seconds)
    speed = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) / 0.1
    np.testing.assert_allclose(poses[:20], poses[:1].repeat(20, axis=0), atol=1e-9)
    assert (np.diff(speed[20:40]) > 0).all()
    later = moving.motion.poses(seconds[50:] - 2.0 - 1.0)
    np.testing.assert_allclose(poses[50:], later, atol=1e-6)
