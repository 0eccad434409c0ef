"""What the errors of the map add to a camera's covariance."""

import numpy as np
import pytest

from lvba import geometry
from lvba.trajectory import Trajectory
from lvba.visual import covariance

TIMES = np.arange(20.0)


def scans() -> Trajectory:
    rng = np.random.default_rng(0)
    step = np.concatenate([0.1 * rng.normal(size=(20, 3)), rng.normal(size=(20, 3))], axis=1)
    return Trajectory(TIMES, geometry.exp(step))


def test_of_one_rigid_map_it_is_the_scans_own_covariance_carried_to_the_camera():
    moving = scans()
    rng = np.random.default_rng(1)
    factor = rng.normal(size=(6, 8))
    world = factor @ factor.T
    # the same error of the whole map, as every scan sees it
    carry = geometry.adjoint(geometry.inverse(moving.world_from_sensor))
    every = carry @ world @ np.swapaxes(carry, -1, -2)
    cameras = moving.world_from_sensor[[0, 7, 19]] @ geometry.exp(rng.normal(size=6))
    back = geometry.adjoint(geometry.inverse(cameras))
    got = covariance.of_map(cameras, TIMES[[0, 7, 19]], moving, every)
    assert got == pytest.approx(back @ world @ np.swapaxes(back, -1, -2), rel=1e-9)


def test_a_scan_that_knows_nothing_does_not_make_the_map_about_it_uncertain():
    moving = scans()
    sure = np.tile(1e-6 * np.eye(6), (20, 1, 1))
    vague = sure.copy()
    vague[10] = 100 * np.eye(6)
    at = moving.world_from_sensor[10:11]
    got = covariance.of_map(at, TIMES[10:11], moving, vague)
    want = covariance.of_map(at, TIMES[10:11], moving, sure)
    assert np.trace(got[0]) < 1.3 * np.trace(want[0])


def test_scans_from_outside_a_group_that_came_off_do_not_make_it_certain():
    """Eight of eleven scans are off together by 7 cm along an axis of the world; the others are known to a millimeter."""
    moving = scans()
    known = np.tile(1e-6 * np.eye(6), (20, 1, 1))
    along = np.zeros((6, 6))
    along[3, 3] = 0.07**2
    carry = geometry.adjoint(geometry.inverse(moving.world_from_sensor[8:16]))
    # about each scan's own place, axes of the world
    carry[:, 3:, :3] = 0.0
    known[8:16] += carry @ along @ np.swapaxes(carry, -1, -2)
    at = moving.world_from_sensor[11:12]
    got = covariance.of_map(at, TIMES[11:12], moving, known)
    assert np.sqrt(np.trace(got[0, 3:, 3:])) == pytest.approx(0.07, rel=0.05)


def test_what_each_scan_leaves_open_in_a_direction_of_its_own_the_others_hold():
    moving = scans()
    rng = np.random.default_rng(4)
    known = np.tile(1e-6 * np.eye(6), (20, 1, 1))
    for each in known:
        way = rng.normal(size=3)
        each[3:, 3:] += 0.2**2 * np.outer(way, way) / (way @ way)
    at = moving.world_from_sensor[10:11]
    got = covariance.of_map(at, TIMES[10:11], moving, known)
    assert np.sqrt(np.trace(got[0, 3:, 3:])) < 0.2


def test_few_scans_are_all_there_is():
    moving = Trajectory(TIMES[:3], scans().world_from_sensor[:3])
    got = covariance.of_map(moving.world_from_sensor, TIMES[:3], moving, np.tile(np.eye(6), (3, 1, 1)))
    assert got.shape == (3, 6, 6)
    assert np.isfinite(got).all()
