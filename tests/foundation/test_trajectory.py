import numpy as np
import pytest
from scipy.spatial.transform import Rotation

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


def _on_path(positions, rng, noise_deg=0.2):
    rotations = geometry.exp(np.c_[rng.normal(0, 0.5, (len(positions), 3)), np.zeros((len(positions), 3))])
    poses = rotations.copy()
    poses[:, :3, 3] = positions
    turned = poses @ geometry.exp(
        np.c_[rng.normal(0, np.radians(noise_deg), (len(poses), 3)), np.zeros((len(poses), 3))]
    )
    return poses, turned


def _umeyama_error(estimate, truth):
    """Root mean square distance after Umeyama's alignment without scale, by scipy."""
    p, q = (poses[:, :3, 3] - poses[:, :3, 3].mean(0) for poses in (estimate, truth))
    rotation, _ = Rotation.align_vectors(q, p)
    return np.sqrt(((rotation.apply(p) - q) ** 2).sum(1).mean())


def test_errors_of_a_path_are_counted_after_umeyama():
    """Orientations that are all off by the same do not tilt it."""
    rng = np.random.default_rng(1)
    along = np.linspace(0, 80, 100)
    truth, estimate = _on_path(np.c_[along, 8 * np.sin(along / 15), 2 * np.cos(along / 9)], rng)
    extrinsic = geometry.exp(np.radians([0, 0.5, 0.5, 0, 0, 0]))
    estimate = estimate @ extrinsic
    estimate[:, :3, 3] += rng.normal(0, 0.02, (100, 3))
    found = trajectory.align_for_errors(estimate, truth)
    assert found.by == "positions"
    error = trajectory.pose_error(estimate, truth, aligned=found.reference_from_estimate)
    assert error.ate_m == pytest.approx(_umeyama_error(estimate, truth), rel=1e-9)
    assert error.ate_m < trajectory.pose_error(estimate, truth).ate_m


@pytest.mark.parametrize("extent", [80.0, 0.0])
def test_errors_of_a_straight_path_and_on_the_spot_are_not_turned_by_noise(extent):
    rng = np.random.default_rng(2)
    truth, estimate = _on_path(np.linspace(0, extent, 100)[:, None] * [1.0, 0, 0], rng)
    estimate[:, :3, 3] += rng.normal(0, 0.02, (100, 3))
    motion = geometry.exp(np.array([0.4, -0.8, 1.0, 5, 6, 7]))
    found = trajectory.align_for_errors(motion @ estimate, truth)
    assert found.by == "positions and orientations"
    left = geometry.rotation_angle_deg((found.reference_from_estimate @ motion)[None])[0]
    assert left < 0.1


def test_errors_of_an_exact_copy_are_zero():
    rng = np.random.default_rng(3)
    motion = geometry.exp(np.array([0.4, -0.8, 1.0, 5, 6, 7]))
    for positions in (
        rng.normal(0, 5, (20, 3)),
        np.linspace(0, 9, 20)[:, None] * [1.0, 2, 3],
        np.zeros((20, 3)),
    ):
        truth, _ = _on_path(positions, rng)
        found = trajectory.align_for_errors(motion @ truth, truth)
        np.testing.assert_allclose(found.reference_from_estimate @ motion, np.eye(4), atol=1e-8)


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
