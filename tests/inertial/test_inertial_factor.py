"""The inertial factor: nothing to say at the truth, and what it says against plain least squares and differences."""

from dataclasses import replace

import numpy as np
import pytest
from felt_motion import DOWNWARD, measured, path
from scipy.optimize import least_squares

from lvba import geometry
from lvba.inertial import factor as inertial
from lvba.inertial.factor import DOWN, GYROSCOPE, LEVER, OFFSET, TURN
from lvba.inertial.preintegration import CONSUMER
from lvba.inertial.readings import ImuReadings


def plain(given, poses: np.ndarray, held: bool):
    """The same least squares over a flat vector by scipy: velocities, shared unknowns and, unless held, poses."""
    scans = len(poses)

    def residuals(x):
        velocity, shared = x[: 3 * scans].reshape(-1, 3), x[3 * scans : 3 * scans + 16]
        moved = poses if held else geometry.retract(poses, x[3 * scans + 16 :].reshape(-1, 6))
        rows = given._rows(moved, velocity, shared)
        return np.r_[rows.residual.ravel(), inertial._prior(shared)[0], velocity.ravel() / 100.0]

    return residuals


def moved(poses: np.ndarray, size: float = 1e-3, seed: int = 5) -> np.ndarray:
    return geometry.retract(poses, np.random.default_rng(seed).normal(0, size, (len(poses), 6)))


def test_it_has_nothing_to_say_at_the_truth_and_finds_biases_and_gravity():
    bias = np.array([0.01, -0.02, 0.005, 0.1, -0.05, 0.08])
    readings, scans, poses = measured(bias)
    given = inertial.factor(readings, scans, poses)
    state = given.solve(poses)
    assert state.squares.max() < 0.01
    assert state.shared[GYROSCOPE] == pytest.approx(bias[:3], abs=2e-4)
    sigma = np.sqrt(np.diag(state.shared_covariance))
    off = state.shared - np.r_[bias, DOWNWARD, np.zeros(7)]
    assert (np.abs(off) < 3 * sigma).all()
    assert sigma[DOWN].max() < 0.03
    speed = path()[0](scans + 1e-4)[:, :3, 3] - path()[0](scans - 1e-4)[:, :3, 3]
    assert state.velocity == pytest.approx(speed / 2e-4, abs=5e-3)


def test_an_imu_apart_and_turned_is_taken_where_it_is():
    mount = geometry.exp(np.array([0.4, -1.0, 0.3, 0.2, -0.1, 0.3]))
    readings, scans, poses = measured(mount=mount)
    assert inertial.factor(readings, scans, poses, mount).cost(poses) < 0.05
    assert inertial.factor(readings, scans, poses).cost(poses) > 1e3
    nearly = mount @ geometry.exp(np.array([0.01, 0.005, -0.01, 0.0, 0.0, 0.0]))
    nearly[:3, 3] += [0.03, -0.02, 0.04]
    state = inertial.factor(readings, scans, poses, nearly).solve(poses)
    assert state.shared[LEVER] == pytest.approx([-0.03, 0.02, -0.04], abs=0.01)
    assert state.shared[TURN] == pytest.approx([-0.01, -0.005, 0.01], abs=2e-3)


def test_cost_and_state_are_those_of_plain_least_squares():
    readings, scans, poses = measured()
    given, off = inertial.factor(readings, scans, poses), moved(poses)
    start = np.r_[np.zeros(3 * len(poses)), given.start]
    found = least_squares(plain(given, off, held=True), start, method="lm", xtol=1e-15, ftol=1e-15)
    state = given.solve(off)
    assert state.cost == pytest.approx(found.cost, rel=1e-7)
    assert state.velocity.ravel() == pytest.approx(found.x[: 3 * len(poses)], abs=1e-5)


def test_gradient_is_that_of_differences():
    readings, scans, poses = measured()
    given, off = inertial.factor(readings, scans, poses), moved(poses)
    numeric = np.zeros((len(poses), 6))
    for scan in (0, 1, 4, len(poses) - 1):
        for axis in range(6):
            step = np.zeros((len(poses), 6))
            step[scan, axis] = 1e-6
            low, high = (given.cost(geometry.retract(off, sign * step)) for sign in (-1, 1))
            numeric[scan, axis] = (high - low) / 2e-6
    analytic = given.linearize(off).gradient
    assert np.abs(analytic - numeric)[[0, 1, 4, -1]].max() < 2e-4 * np.abs(numeric).max()


def test_hessian_is_that_of_all_unknowns_with_the_others_eliminated():
    readings, scans, poses = measured()
    given = inertial.factor(readings, scans, poses)
    state, residuals = given.solve(poses), plain(given, poses, held=False)
    at = np.r_[state.velocity.ravel(), state.shared, np.zeros(6 * len(poses))]
    columns = []
    for axis in range(len(at)):
        step = np.zeros(len(at))
        step[axis] = 1e-6
        columns.append((residuals(at + step) - residuals(at - step)) / 2e-6)
    jacobian = np.stack(columns, axis=1)
    whole, inner = jacobian.T @ jacobian, 3 * len(poses) + 16
    left = whole[inner:, inner:] - whole[inner:, :inner] @ np.linalg.solve(
        whole[:inner, :inner], whole[:inner, inner:]
    )
    found = given.linearize(poses).dense()
    assert np.abs(found - left).max() < 1e-5 * np.abs(left).max()


def test_motions_of_all_scans_together_but_for_tilt_cost_nothing():
    readings, scans, poses = measured()
    given = inertial.factor(readings, scans, poses)
    world = geometry.exp(np.array([0.5, 1.0, -0.7, 3.0, 5.0, -2.0]))
    turned = inertial.factor(readings, scans, world @ poses)
    assert turned.cost(world @ poses) == pytest.approx(given.cost(poses), rel=1e-5, abs=1e-7)
    assert turned.solve(world @ poses).shared[DOWN] == pytest.approx(world[:3, :3] @ DOWNWARD, abs=0.03)


def test_a_clock_that_is_ahead_is_found():
    readings, scans, poses = measured()
    late = replace(readings, times=readings.times + 0.021)
    state = inertial.factor(late, scans, poses).solve(poses)
    assert state.shared[OFFSET] == pytest.approx(0.021, abs=1e-3)
    assert state.squares.max() < 0.1


def test_a_scan_without_readings_around_it_is_left_alone():
    readings, scans, poses = measured()
    keep = (readings.times < scans[3] + 0.01) | (readings.times > scans[5] - 0.01)
    cut = ImuReadings(readings.times[keep], readings.rates[keep], readings.forces[keep])
    given, off = inertial.factor(cut, scans, poses), poses.copy()
    off[4] = geometry.retract(poses[4], np.full(6, 0.3))
    assert given.cost(off) == pytest.approx(given.cost(poses))
    assert (
        inertial.factor(ImuReadings(*(part[:1] for part in (cut.times, cut.rates, cut.forces))), scans, poses)
        is None
    )


def test_squares_of_white_noise_are_as_many_as_they_should_be():
    noise, mean = np.sqrt(400.0) * np.array(CONSUMER), []
    for seed in range(6):
        readings, scans, poses = measured(noise=noise, seed=seed)
        given = inertial.factor(readings, scans, poses)
        allowed = given.solve(poses).squares.sum()
        given = replace(given, whitening=inertial._whitening(given.measured.motions.covariance))
        state = given.solve(poses)
        # nine a motion, less what velocities and shared unknowns take
        mean.append(state.squares.sum() / (9 * len(given.measured) - 3 * len(scans) - 16))
        # a MEMS is off by more than its noise
        assert allowed < 0.5 * state.squares.sum()
        assert given.with_variance_factors(4.0, 4.0).solve(poses).squares.sum() == pytest.approx(
            state.squares.sum() / 4, rel=0.1
        )
    assert np.mean(mean) == pytest.approx(1.0, abs=0.25)
