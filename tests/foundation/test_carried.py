import numpy as np
import pytest

from lvba import geometry, trajectory
from lvba.carried import carry
from lvba.trajectory import Trajectory

MOUNTED = geometry.exp(np.array([0.1, -0.2, 0.3, 0.2, 0.0, -0.1]))


def test_where_rough_poses_jump_another_sensor_follows_its_own_side():
    times = np.arange(12.0)
    twist = np.array([0.0, 0.02, 0.1, 0.5, 0.05, 0.0])
    true = geometry.exp(times[:, None] * twist)
    image_times = np.arange(0.3, 11.0, 0.45)
    images = geometry.exp(image_times[:, None] * twist) @ MOUNTED
    jump = geometry.exp(np.array([0.0, 0.0, 0.05, 0.6, -0.7, 0.2]))
    moment = 5.5
    rough = Trajectory(times, np.where((times > moment)[:, None, None], jump @ true, true))
    others = Trajectory(image_times, np.where((image_times > moment)[:, None, None], jump @ images, images))
    carried = carry(rough, true, others, MOUNTED)
    assert carried.by_rough.all()
    assert np.abs(carried.world_from_sensor - images).max() < 1e-9
    straight = trajectory.interpolate_corrections(rough, true, image_times) @ others.world_from_sensor
    assert np.abs(straight - images).max() > 0.1


def test_where_nothing_jumps_another_sensor_moves_by_the_interpolated_correction():
    times = np.arange(8.0)
    true = geometry.exp(times[:, None] * np.array([0.0, 0.02, 0.1, 0.5, 0.05, 0.0]))
    rough = Trajectory(times, true @ geometry.exp(0.008 * np.sin(times)[:, None] * np.ones(6)))
    others = Trajectory(times[:-1] + 0.4, true[:-1])
    straight = trajectory.interpolate_corrections(rough, true, others.times) @ others.world_from_sensor
    assert np.array_equal(carry(rough, true, others, np.eye(4)).world_from_sensor, straight)


def _walk(times):
    """Poses of a sensor that turns and sways a little as it walks."""
    along = np.stack(
        [0.1 * np.sin(times), 0.05 * times, 0.2 * np.cos(times / 3), times, np.sin(times / 2), 0 * times], 1
    )
    return geometry.exp(along)


def _lost(times, image_times, size, seed=3):
    """Rough poses of scans and images that an odometry gives whose motions are wrong, each by so many m and 3 deg/m."""
    rng = np.random.default_rng(seed)
    ends = np.sort(np.concatenate([times, image_times]))
    wrong = rng.normal(size=(len(ends), 6)) * np.repeat([np.radians(3) * size, size], 3)
    drift = np.cumsum(wrong, axis=0)
    scans, images = (geometry.exp(drift[np.searchsorted(ends, each)]) for each in (times, image_times))
    return Trajectory(times, scans @ _walk(times)), Trajectory(
        image_times, images @ _walk(image_times) @ MOUNTED
    )


def test_where_the_odometry_was_lost_another_sensor_follows_a_spline_through_the_refined_scans():
    times = np.arange(0.0, 12.0, 0.5)
    image_times = times[:-1] + 0.27
    rough, others = _lost(times, image_times, 0.3)
    carried = carry(rough, _walk(times), others, MOUNTED)
    true = _walk(image_times) @ MOUNTED
    off = np.linalg.norm((carried.world_from_sensor - true)[:, :3, 3], axis=1)
    straight = trajectory.interpolate_corrections(rough, _walk(times), image_times) @ others.world_from_sensor
    by_eq1 = np.linalg.norm((straight - true)[:, :3, 3], axis=1)
    assert np.median(by_eq1) > 0.15
    by_spline = ~carried.by_rough[:, 1]
    assert by_spline.any()
    assert np.median(off) < np.median(by_eq1) / 3
    assert off[by_spline].max() < 0.03


def test_between_scans_far_apart_the_odometry_turns_another_sensor_though_its_positions_are_wrong():
    """Hands turn a sensor by 12 degrees to and fro between scans, which no spline through these knows."""
    times = np.arange(0.0, 24.0, 1.6)

    def true(at):
        turn = np.radians(12) * np.sin(2 * np.pi * at / 1.6)[:, None] * np.eye(6)[2]
        poses = geometry.exp(turn)
        poses[:, 0, 3] = 0.8 * at
        return poses

    image_times = times[:-1] + 0.4
    ends = np.sort(np.concatenate([times, image_times]))
    drift = np.cumsum(
        np.random.default_rng(3).normal(size=(len(ends), 6)) * ([0.002] * 3 + [0.2] * 3), axis=0
    )
    scans, images = (geometry.exp(drift[np.searchsorted(ends, each)]) for each in (times, image_times))
    rough = Trajectory(times, scans @ true(times))
    others = Trajectory(image_times, images @ true(image_times) @ MOUNTED)
    carried = carry(rough, true(times), others, MOUNTED)
    off = geometry.log(geometry.inverse(true(image_times) @ MOUNTED) @ carried.world_from_sensor)
    there = carried.wrong[:, 1] > 0.1
    assert there.sum() > 8
    assert carried.by_rough[there, 0].all()
    assert not carried.by_rough[there, 1].all()
    assert np.degrees(np.linalg.norm(off[there, :3], axis=1)).max() < 0.5
    assert np.linalg.norm(off[~carried.by_rough[:, 1], 3:], axis=1).max() < 0.1


@pytest.mark.parametrize("scale", [1.3, 0.7])
def test_an_odometry_whose_motion_is_wrong_evenly_is_interpolated_as_where_none_is(scale):
    times = np.arange(0.0, 12.0, 0.5)
    image_times = times[:-1] + 0.2
    stretch = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    rough = Trajectory(times, geometry.exp(scale * times[:, None] * stretch))
    others = Trajectory(image_times, geometry.exp(scale * image_times[:, None] * stretch) @ MOUNTED)
    carried = carry(rough, geometry.exp(times[:, None] * stretch), others, MOUNTED)
    assert carried.by_rough.all()
    assert (
        np.abs(carried.world_from_sensor - geometry.exp(image_times[:, None] * stretch) @ MOUNTED).max()
        < 1e-9
    )


def test_two_scans_tell_as_little_as_eq_1_does():
    rough = Trajectory(np.array([0.0, 1.0]), geometry.exp(np.array([np.zeros(6), [0, 0, 0, 3.0, 0, 0]])))
    refined = geometry.exp(np.array([np.zeros(6), [0, 0, 0, 1.0, 0, 0]]))
    others = Trajectory(
        np.array([0.5, 2.0]), geometry.exp(np.array([[0, 0, 0, 1.5, 0, 0], [0, 0, 0, 3.0, 0, 0]]))
    )
    carried = carry(rough, refined, others, np.eye(4))
    assert carried.by_rough.all()
    np.testing.assert_allclose(carried.world_from_sensor[:, 0, 3], [0.5, 1.0], atol=1e-12)
