import numpy as np
import pytest

from lvba import geometry, trajectory
from lvba.trajectory import Trajectory


def _walk(count: int = 12, seed: int = 0) -> Trajectory:
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.2, 0.8, count))
    delta = np.stack(
        [0.1 * np.sin(times), 0.2 * np.cos(times / 2), times / 9, times, np.sin(times), 0 * times], 1
    )
    return Trajectory(times, geometry.exp(delta))


def test_a_common_correction_is_carried_over_unchanged():
    rough = _walk()
    correction = geometry.exp(np.array([0.01, -0.02, 0.03, 0.2, -0.1, 0.05]))
    queries = np.linspace(rough.times[0] - 1, rough.times[-1] + 1, 33)
    carried = trajectory.interpolate_corrections(rough, correction @ rough.world_from_sensor, queries)
    np.testing.assert_allclose(carried, np.broadcast_to(correction, carried.shape), atol=1e-12)


def test_a_correction_at_a_sample_is_that_sample_s():
    rough = _walk()
    refined = rough.world_from_sensor @ geometry.exp(np.random.default_rng(1).normal(size=(12, 6)) * 0.02)
    carried = trajectory.interpolate_corrections(rough, refined, rough.times)
    np.testing.assert_allclose(carried @ rough.world_from_sensor, refined, atol=1e-12)


def test_sampling_a_smooth_trajectory_is_closer_than_straight_lines():
    times = np.linspace(0, 20, 401)
    delta = np.stack([0 * times, 0 * times, 0.1 * times, times, np.sin(times), np.cos(times)], 1)
    dense = Trajectory(times, geometry.exp(delta))
    sparse = Trajectory(dense.times[::8], dense.world_from_sensor[::8])
    true, straight = dense.world_from_sensor[:, :3, 3], np.empty((401, 3))
    for axis in range(3):
        straight[:, axis] = np.interp(dense.times, sparse.times, sparse.world_from_sensor[:, axis, 3])
    error = np.linalg.norm(trajectory.sample(sparse, dense.times)[:, :3, 3] - true, axis=1).max()
    assert error < 0.1 * np.linalg.norm(straight - true, axis=1).max()


def test_alignment_finds_a_known_motion():
    poses = _walk().world_from_sensor
    motion = geometry.exp(np.array([0.4, -1.0, 0.2, 3, 4, 5.0]))
    np.testing.assert_allclose(trajectory.align(poses, motion @ poses), motion, atol=1e-12)


def test_alignment_on_a_line_takes_the_roll_from_the_orientations():
    poses = np.tile(np.eye(4), (10, 1, 1))
    poses[:, 0, 3] = np.arange(10)
    motion = geometry.exp(np.array([0.7, 0, 0, 1, 2, 3.0]))
    np.testing.assert_allclose(trajectory.align(poses, motion @ poses), motion, atol=1e-9)


def test_alignment_of_a_straight_path_is_not_rolled_by_noise():
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (100, 1, 1))
    poses[:, 0, 3], poses[:, 1, 3] = np.linspace(0, 300, 100), 0.5 * np.sin(np.arange(100))
    noise = np.concatenate([rng.normal(0, 1e-5, (100, 3)), rng.normal(0, 2e-3, (100, 3))], axis=1)
    found = trajectory.align(poses @ geometry.exp(noise), poses)
    assert geometry.rotation_angle_deg(found) < 0.001


def test_pose_error_is_zero_for_a_moved_copy_and_counts_what_differs():
    poses = _walk().world_from_sensor
    motion = geometry.exp(np.array([0.4, -1.0, 0.2, 3, 4, 5.0]))
    same = trajectory.pose_error(motion @ poses, poses)
    assert same.ate_m == pytest.approx(0, abs=1e-12)
    assert same.rotation_deg == pytest.approx(0, abs=1e-6)
    moved = trajectory.pose_error(
        poses, geometry.exp(np.array([0, 0, 0, 0.1, 0, 0])) @ poses, aligned=np.eye(4)
    )
    assert moved.ate_m == pytest.approx(0.1)
    assert moved.rpe_m == pytest.approx(0, abs=1e-12)


def test_bracket_clamps_at_the_ends():
    before, fraction = trajectory.bracket(np.array([0.0, 1, 3]), np.array([-1.0, 0, 2, 3, 9]))
    assert before.tolist() == [0, 0, 1, 1, 1]
    assert fraction.tolist() == [0, 0, 0.5, 1, 1]
