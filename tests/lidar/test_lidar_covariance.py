"""The covariance of the poses against its formula written with whole matrices."""

import numpy as np
import plane_world
import pytest
import scipy.linalg

from lvba import geometry
from lvba.lidar import covariance, dense_covariance, noise_information, plane_factor, voxel_map
from lvba.lidar.odometry_factor import odometry_prior
from lvba.lidar.plane_feature import fit
from lvba.lidar.problem import Problem
from lvba.lidar.scan import gather

SIGMA = 0.005
"""m, less than the noise of the points: so the spread of the gradients tells that more is promised than kept."""


@pytest.fixture(scope="module")
def yard():
    """(poses, problem) of some scans, with an odometry prior."""
    scans, truth, rough = plane_world.recording("courtyard", scans=9, points=3200, seed=3)
    grid = voxel_map.build(gather(scans), truth, (0.5, 1.0), None)
    features = voxel_map.find_planes(grid, truth, np.zeros(3), voxel_map.PlaneTest()).features
    return truth, Problem(features, SIGMA, odometry_prior(rough, 0.01, 0.05))


def dense(problem, poses, with_noise):
    """(marginal, conditional, in_map, step, variance_factor) by whole matrices."""
    scans = len(poses)
    fits = fit(problem.features, poses)
    information = problem.linearize(poses, exact=False, fits=fits).dense()
    planes = plane_factor.linearize(problem.features, poses, SIGMA, fits, exact=False).dense()
    odometry = (information - planes)[6:, 6:]
    spread = covariance._gradient_spread(problem, poses, fits).dense()[6:, 6:] + odometry
    inverse = np.linalg.inv(information[6:, 6:])
    variance_factor = max(1.0, np.trace(inverse @ spread) / len(inverse))
    whole = scipy.linalg.block_diag(np.zeros((6, 6)), variance_factor * inverse)
    step = []
    for i in range(scans - 1):
        by_both = np.zeros((6, 6 * scans))
        by_both[:, 6 * i : 6 * i + 6] = -geometry.adjoint(geometry.inverse(poses[i + 1]) @ poses[i])
        by_both[:, 6 * i + 6 : 6 * i + 12] = np.eye(6)
        step.append(by_both @ whole @ by_both.T)
    if with_noise:
        noise = noise_information.linearize(problem.features, fits, poses, SIGMA).dense()[6:, 6:]
        certain = noise_information.certain(planes[6:, 6:], noise, odometry)
        whole[6:, 6:] = np.linalg.inv(certain / variance_factor + odometry)
    aligned = []
    for lever_m in (None, covariance.MAP_M):
        motion, pick = dense_covariance.alignment(poses, lever_m)
        free = np.eye(6 * scans) - motion @ np.linalg.inv(pick.T @ motion) @ pick.T
        aligned.append(free @ whole @ free.T)
    own = scipy.linalg.block_diag(
        *(np.linalg.inv(information[6 * i : 6 * i + 6, 6 * i : 6 * i + 6]) for i in range(scans))
    )
    conditional = variance_factor * own

    def blocks(matrix):
        return [matrix[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i in range(scans)]

    return blocks(aligned[0]), blocks(conditional), blocks(aligned[1]), step, variance_factor


@pytest.mark.parametrize("with_noise", [False, True])
def test_covariance_against_whole_matrices(yard, with_noise, monkeypatch):
    poses, problem = yard
    monkeypatch.setattr(covariance, "MOST_NOISE_SCANS", len(poses) if with_noise else 0)
    got = covariance.estimate(problem, poses)
    marginal, conditional, in_map, step, variance_factor = dense(problem, poses, with_noise)
    assert got.variance_factor == pytest.approx(variance_factor, rel=1e-9)
    assert variance_factor > 1.0, "or it is not seen to be multiplied in"
    assert len(got.odometry_dependence) == (len(poses) - 1 if with_noise else 0)
    for name, found, want in (
        ("marginal", got.marginal, marginal),
        ("conditional", got.conditional, conditional),
        ("in_map", got.in_map, in_map),
        ("step", got.step, step),
    ):
        np.testing.assert_allclose(found, want, atol=1e-7 * np.abs(want).max(), err_msg=name)


def test_inverse_of_more_rows_than_are_mirrored_at_once():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(600, 600))
    matrix = root @ root.T + 60.0 * np.eye(600)
    kept = matrix.copy()
    inverse = dense_covariance.inverse(matrix)
    np.testing.assert_allclose(inverse @ kept, np.eye(600), atol=1e-10)
    np.testing.assert_array_equal(inverse, inverse.T)
    np.testing.assert_array_equal(matrix, kept)


def test_inverse_where_rounding_made_an_eigenvalue_negative():
    rng = np.random.default_rng(1)
    turn = np.linalg.qr(rng.normal(size=(5, 5)))[0]
    matrix = turn @ np.diag([4.0, 3.0, 2.0, 1.0, -1e-12]) @ turn.T
    inverse = dense_covariance.inverse(matrix)
    assert turn[:, 0] @ inverse @ turn[:, 0] == pytest.approx(0.25)
    assert turn[:, 4] @ inverse @ turn[:, 4] == pytest.approx(1e9 / 4.0, rel=1e-3)


@pytest.mark.parametrize("least", [0.5, -1e-12])
def test_root_of_the_inverse_gives_the_inverse(least):
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(6, 6)))[0]
    matrix = turn @ np.diag([4.0, 3.0, 2.0, 1.0, 0.7, least]) @ turn.T
    kept = matrix.copy()
    root = dense_covariance.root_of_inverse(matrix)
    np.testing.assert_allclose(root @ root.T, dense_covariance.inverse(kept), rtol=1e-6)
    np.testing.assert_array_equal(matrix, kept)


def test_covariance_after_alignment_by_its_root():
    rng = np.random.default_rng(2)
    poses, root = geometry.exp(rng.normal(size=(4, 6))), rng.normal(size=(18, 21))
    np.testing.assert_allclose(
        dense_covariance.aligned_of_root(root, poses),
        dense_covariance.aligned(root @ root.T, poses),
        atol=1e-12,
    )


def test_who_turns_in_one_place_does_not_leave_the_map_turned():
    """A common turn moves no position there, so an alignment of positions leaves all of it; the map shows it, and what
    errors against a reference are counted after takes it out."""
    poses = geometry.exp(
        np.concatenate([np.eye(3)[[0, 1, 2, 0, 1]] * 0.4, 1e-3 * np.eye(3)[[0, 1, 2, 1, 0]]], axis=1)
    )
    rigid, _ = dense_covariance.alignment(poses)
    each = 1e-8 * np.eye(30)
    whole = (rigid @ np.diag([1e-4] * 3 + [0.0] * 3) @ rigid.T + each)[6:, 6:]
    turned, as_errors, in_map = (
        np.sqrt(np.diagonal(dense_covariance.aligned(whole, poses, lever_m), axis1=1, axis2=2)[1:, :3].max())
        for lever_m in (0.0, None, covariance.MAP_M)
    )
    assert turned > 0.05
    assert in_map < 0.05 * turned
    assert as_errors < 0.05 * turned
