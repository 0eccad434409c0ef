"""The variance factor of errors that planes close to each other share."""

from dataclasses import replace

import numpy as np
import plane_world
import pytest
import scipy.linalg

from lvba import geometry, trajectory
from lvba.lidar import covariance, dense_covariance, group_deletion, voxel_map
from lvba.lidar.odometry_factor import odometry_prior
from lvba.lidar.plane_feature import fit
from lvba.lidar.problem import Problem, solve
from lvba.lidar.scan import gather
from lvba.lidar.weights import observation_weights

METRIC = np.repeat([1e4, 4e2], 3)
PIECE_M = 2.0


@pytest.fixture(scope="module")
def room():
    """(features, true poses, rough poses) of some scans of rooms, in small cells."""
    points, truth, rough = plane_world.recording("rooms", scans=8, points=24000, seed=3)
    grid = voxel_map.build(gather(points), truth, (0.25,), None)
    return voxel_map.find_planes(grid, truth, np.zeros(3), voxel_map.PlaneTest()).features, truth, rough


def solved(room, shared_m=0.0, seed=0):
    """(problem, poses at its solution); each scan has all planes in a piece of space nearer or farther, by shared_m."""
    features, truth, rough = room
    fits = fit(features, truth)
    facing = np.abs(fits.normal).argmax(axis=1)
    normal = fits.normal * np.sign(np.take_along_axis(fits.normal, facing[:, None], axis=1))
    key = np.column_stack([np.floor(fits.center / PIECE_M), facing])
    unique, piece = np.unique(key, axis=0, return_inverse=True)
    shifts = np.random.default_rng(seed).normal(0.0, shared_m, (len(truth), len(unique)))
    along = np.einsum("oji,oj->oi", truth[features.scan, :3, :3], normal[features.feature])
    moved = shifts[features.scan, piece.reshape(-1)[features.feature], None] * along
    clusters = features.clusters
    features = replace(features, clusters=replace(clusters, mean=clusters.mean + moved))
    weights = observation_weights(features, truth)
    problem = Problem(features.with_weight(weights.weight), weights.sigma, odometry_prior(rough, 0.01, 0.05))
    return problem, solve(problem, truth, METRIC, steps=20, exact=False, tolerance=1e-12).world_from_scan


@pytest.fixture(scope="module")
def clean(room):
    return solved(room)


def test_moves_without_groups_against_whole_matrices(clean):
    problem, poses = clean
    group = np.random.default_rng(5).integers(0, group_deletion.GROUPS, len(problem.features))
    size = 6 * len(poses)
    motion, pick = dense_covariance.alignment(poses)
    free = np.eye(size) - motion @ np.linalg.inv(pick.T @ motion) @ pick.T

    def estimate(features):
        """What one Gauss-Newton step finds from some planes, and its covariance; both after alignment."""
        whole = Problem(features, problem.sigma, problem.prior).linearize(poses, exact=False)
        inverse = np.linalg.inv(whole.dense()[6:, 6:])
        step = np.append(np.zeros(6), -inverse @ whole.gradient.ravel()[6:])
        return free @ step, free @ scipy.linalg.block_diag(np.zeros((6, 6)), inverse) @ free.T

    found, promised = estimate(problem.features)
    moved = expected = 0.0
    for each in range(group_deletion.GROUPS):
        other, spread = estimate(problem.features.select(group != each))
        for scan in range(len(poses)):
            own = slice(6 * scan, 6 * scan + 6)
            weight = np.linalg.inv(promised[own, own] + 1e-12 * np.eye(6))
            moved += (other - found)[own] @ weight @ (other - found)[own]
            expected += np.trace(weight @ (spread - promised)[own, own])
    whole = group_deletion._Whole.of(problem, poses)
    np.testing.assert_allclose(group_deletion._moves(whole, group), (moved, expected), rtol=1e-6)


def test_noise_alone_is_as_large_as_promised(clean):
    assert 0.3 < group_deletion.variance_factor(*clean) < 1.7


def test_shared_errors_are_told_that_single_planes_do_not_show(room):
    factors, errors = [], []
    for seed in range(3):
        problem, poses = solved(room, 0.02, seed)
        known = covariance.estimate(problem, poses)
        assert known.variance_factor < 1.2
        factors.append(known.shared_factor)
        aligned = trajectory.align(poses, room[1]) @ poses
        error = geometry.log(geometry.inverse(aligned) @ room[1])
        errors.append(np.mean(error * np.linalg.solve(known.marginal, error[..., None])[..., 0]))
    assert np.mean(factors) > 2.0
    assert 0.5 < np.mean(errors) / np.mean(factors) < 2.0


def test_windows_of_many_scans_hold_their_planes_alone(clean, monkeypatch):
    problem, poses = clean
    whole = group_deletion.variance_factor(problem, poses)
    monkeypatch.setattr(group_deletion, "MOST_SCANS", 3)
    windows = list(group_deletion._windows(problem, poses))
    assert [len(part) for _, part in windows] == [3, 3, 3]
    window, part = windows[1]
    feature = problem.features.feature
    inside = (problem.features.scan >= 2) & (problem.features.scan < 5)
    many = np.bincount(feature[inside], minlength=len(problem.features)) >= 2
    assert len(window.features) == many.sum()
    np.testing.assert_array_equal(window.features.scan, problem.features.scan[inside & many[feature]] - 2)
    np.testing.assert_allclose(
        window.cost(part), 0.5 * fit(window.features, part).cost / problem.sigma**2 + window.prior.cost(part)
    )
    assert 0.3 * whole < group_deletion.variance_factor(problem, poses) < 3.0 * whole


def test_two_windows_are_enough_where_no_scan_is_outside_of_them(clean, monkeypatch):
    problem, poses = clean
    monkeypatch.setattr(group_deletion, "MOST_SCANS", 5)
    windows = list(group_deletion._windows(problem, poses))
    np.testing.assert_array_equal(windows[0][1], poses[:5])
    np.testing.assert_array_equal(windows[1][1], poses[3:])
    assert len(windows) == 2


def test_without_odometry_or_with_few_pieces_nothing_is_told(clean, monkeypatch):
    problem, poses = clean
    assert group_deletion.variance_factor(Problem(problem.features, problem.sigma, None), poses) == 1.0
    monkeypatch.setattr(group_deletion, "PIECE_M", 1000.0)
    assert group_deletion.variance_factor(problem, poses) == 1.0
