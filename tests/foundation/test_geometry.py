import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm, logm

from lvba import geometry

seeds = st.integers(0, 2**32 - 1)
scales = st.sampled_from([1e-9, 1e-6, 1e-3, 1.0])


def _tangent(seed: int, scale: float, shape: tuple[int, ...] = ()) -> np.ndarray:
    return np.clip(np.random.default_rng(seed).normal(size=(*shape, 6)), -1.5, 1.5) * scale


def _matrix(delta: np.ndarray) -> np.ndarray:
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = geometry.hat(delta[:3])
    matrix[:3, 3] = delta[3:]
    return matrix


def test_what_moves_without_being_made_orthonormal_is_where_the_retraction_has_it():
    rng = np.random.default_rng(2)
    poses, delta = geometry.exp(rng.normal(size=(50, 6))), rng.normal(size=(50, 6))
    np.testing.assert_allclose(poses @ geometry.exp(delta), geometry.retract(poses, delta), atol=1e-13)


@given(seeds, scales)
def test_exp_is_the_matrix_exponential(seed, scale):
    delta = _tangent(seed, scale)
    np.testing.assert_allclose(geometry.exp(delta), expm(_matrix(delta)), atol=1e-13)


def test_log_is_the_matrix_logarithm():
    delta = np.array([0.3, -0.8, 0.5, 1.0, -2.0, 3.0])
    np.testing.assert_allclose(
        _matrix(geometry.log(geometry.exp(delta))), np.real(logm(geometry.exp(delta))), atol=1e-10
    )


@given(seeds, scales)
def test_log_undoes_exp(seed, scale):
    delta = _tangent(seed, scale, (3,))
    np.testing.assert_allclose(geometry.log(geometry.exp(delta)), delta, atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-8, 0.99e-5, 1.01e-5, 9.9e-3, 1.01e-2, 2.93, 2.95, 3.14])
def test_log_undoes_exp_on_both_sides_of_the_series_limits(angle):
    delta = np.array([0, angle, 0, 0.3, -0.2, 0.7])
    np.testing.assert_allclose(geometry.log(geometry.exp(delta)), delta, atol=1e-11)


@given(seeds)
def test_what_was_made_orthonormal_again_stays_so_over_many_steps(seed):
    pose, step = geometry.exp(_tangent(seed, 1.0)), _tangent(seed + 1, 0.1)
    for _ in range(200):
        pose = geometry.retract(pose, step)
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-15)


@given(seeds)
def test_inverse_and_product_follow_the_group_axioms(seed):
    a, b, c = geometry.exp(_tangent(seed, 1.0, (3,)))
    np.testing.assert_allclose(geometry.inverse(a) @ a, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(geometry.inverse(a @ b), geometry.inverse(b) @ geometry.inverse(a), atol=1e-12)
    np.testing.assert_allclose((a @ b) @ c, a @ (b @ c), atol=1e-12)


@given(seeds)
def test_adjoint_moves_a_tangent_vector_to_the_other_side(seed):
    a, delta = geometry.exp(_tangent(seed, 1.0)), _tangent(seed + 1, 0.3)
    np.testing.assert_allclose(
        a @ geometry.exp(delta), geometry.exp(geometry.adjoint(a) @ delta) @ a, atol=1e-12
    )


@given(seeds)
def test_quaternions_go_there_and_back(seed):
    a = geometry.exp(_tangent(seed, 1.0, (4,)))
    back = geometry.from_quaternion_translation(geometry.quaternion(a), a[:, :3, 3])
    np.testing.assert_allclose(back, a, atol=1e-14)


@given(seeds, st.floats(0, 1))
def test_interpolation_is_reached_from_either_end(seed, fraction):
    a, b = geometry.exp(_tangent(seed, 0.7, (2,)))
    np.testing.assert_allclose(
        geometry.interpolate(a, b, np.array(fraction)),
        geometry.interpolate(b, a, np.array(1 - fraction)),
        atol=1e-12,
    )


def test_interpolation_ends_are_the_given_poses():
    a, b = geometry.exp(_tangent(3, 0.7, (2,)))
    np.testing.assert_allclose(geometry.interpolate(a, b, np.array([0.0, 1.0])), np.stack([a, b]), atol=1e-12)


def test_rotation_angle_is_that_of_the_tangent():
    assert geometry.rotation_angle_deg(geometry.exp(np.array([0, 0.1, 0, 5, 5, 5.0]))) == pytest.approx(
        np.degrees(0.1)
    )


def test_leading_axes_broadcast():
    a = geometry.exp(_tangent(0, 1.0, (2, 3)))
    assert a.shape == (2, 3, 4, 4)
    assert geometry.adjoint(a).shape == (2, 3, 6, 6)
    assert geometry.retract(a, np.zeros(6)).shape == (2, 3, 4, 4)


def test_what_does_not_move_stays_to_the_last_bit():
    rng = np.random.default_rng(11)
    poses = geometry.exp(rng.normal(size=(3, 6)))
    step = rng.normal(size=(3, 6))
    step[1] = 0.0
    moved = geometry.retract(poses, step)
    assert np.array_equal(moved[1], poses[1])
    np.testing.assert_allclose(moved, poses @ geometry.exp(step), atol=1e-12)


def test_a_covariance_in_turned_axes_is_that_of_turned_errors():
    rng = np.random.default_rng(12)
    rotation = geometry.exp(rng.normal(size=6))[:3, :3]
    errors = rng.normal(size=(50, 6))
    turned = np.concatenate([errors[:, :3] @ rotation.T, errors[:, 3:] @ rotation.T], axis=1)
    np.testing.assert_allclose(
        geometry.turn_tangent(errors.T @ errors, rotation), turned.T @ turned, atol=1e-10
    )


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-3, 0.3, 4.0])
def test_points_moved_along_a_tangent_are_where_its_exponentials_take_them(size):
    rng = np.random.default_rng(8)
    points, amounts = rng.normal(size=(50, 3)), rng.normal(size=50)
    tangent = np.concatenate([size * np.array([0.6, -0.5, 0.6]), rng.normal(size=3)])
    there = geometry.exp(amounts[:, None] * tangent)
    expected = np.einsum("nij,nj->ni", there[:, :3, :3], points) + there[:, :3, 3]
    np.testing.assert_allclose(geometry.moved_along(points, amounts, tangent), expected, atol=1e-12)
    moved = geometry.moved_along(points, np.ones(50), tangent)
    np.testing.assert_allclose(moved, geometry.transform_points(geometry.exp(tangent), points), atol=1e-12)
