"""How far the path from scan to scan may be from the motion during scans: against paths of which both are known."""

import numpy as np
import pytest

from lvba import geometry
from lvba.lidar import path_motion
from lvba.lidar.point_times import PointClock

CLOCK = PointClock(unit=1.0, sweep=0.05, begin=-0.05, absolute=True)


def swaying(times, period, size=0.05):
    """Poses (n, 4, 4): a steady motion with a sway of some size, rad and m, about three axes each."""
    times = np.asarray(times, float)
    phase = np.arange(6)
    sway = size * np.sin(2 * np.pi * times[:, None] / period + phase)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, :3] = geometry.exp(np.concatenate([sway[:, :3], 0 * sway[:, :3]], axis=1))[:, :3, :3]
    poses[:, :3, 3] = sway[:, 3:] + times[:, None] * [0.5, 0.1, 0.0]
    return poses


def true_twists(times, period):
    before, after = (swaying(times + moment, period) for moment in (CLOCK.begin, CLOCK.begin + CLOCK.sweep))
    return geometry.log(geometry.inverse(before) @ after) / CLOCK.sweep


def sizes(twists):
    return np.sqrt([np.mean(twists[:, :3] ** 2), np.mean(twists[:, 3:] ** 2)])


@pytest.mark.parametrize(("period", "times_as_much"), [(1.5, 1.5), (3.0, 0.6), (6.0, 0.45)])
def test_what_the_path_misses_is_a_part_of_what_is_unpredicted(period, times_as_much):
    """Three scans in a period of the sway hardly follow it: then it is about as much."""
    times = np.arange(0, 12, 0.5)
    path = path_motion.sweep_twists(times, swaying(times, period), CLOCK)
    off = sizes((path - true_twists(times, period))[2:-2])
    most = path_motion.unpredicted(times, swaying(times, period), CLOCK)[:2]
    assert (off < times_as_much * most).all()
    assert (off > 0.5 * times_as_much * most).all()


def test_a_path_that_neighbors_foretell_leaves_little_and_grows_as_it_bends():
    times = np.arange(0, 12, 0.1)
    poses = swaying(times, 6.0)
    most = path_motion.unpredicted(times, poses, CLOCK)
    twist = true_twists(times, 6.0)
    assert (most[:2] < 0.01 * sizes(twist)).all()
    bends = 0.5 * CLOCK.sweep * sizes(np.diff(twist, axis=0) / 0.1)
    np.testing.assert_allclose(most[2:], bends, rtol=0.1)


def test_few_scans_foretell_nothing():
    times = np.arange(4) * 0.5
    assert not path_motion.unpredicted(times, swaying(times, 3.0), CLOCK).any()
    assert path_motion.unpredicted(np.arange(6) * 0.5, swaying(np.arange(6) * 0.5, 3.0), CLOCK).all()


def test_the_ends_of_a_path_tell_motions_from_one_side():
    """By as much as they are off, on average over paths: the first of sweeps before their stamps by most."""
    times, errors, told, inner = np.arange(0, 12, 0.5), [], [], []
    for start in np.arange(0, 3, 0.2):
        poses = swaying(times + start, 3.0)
        off = path_motion.sweep_twists(times, poses, CLOCK) - true_twists(times + start, 3.0)
        errors.append([sizes(off[:1]), sizes(off[-1:])])
        told.append(path_motion.beyond_ends(times, poses, CLOCK))
        inner.append(path_motion.unpredicted(times, poses, CLOCK)[:2])
    errors, told, inner = (np.sqrt(np.mean(np.square(each), axis=0)) for each in (errors, told, inner))
    assert (told[0] > 3 * inner).all()
    assert (told[0] > told[1]).all()
    np.testing.assert_allclose(errors, told, rtol=0.5)
    steady = np.arange(0, 12, 0.1)
    assert (path_motion.beyond_ends(steady, swaying(steady, 60.0), CLOCK) < 1e-3).all()
    assert not path_motion.beyond_ends(times[:4], poses[:4], CLOCK).any()


def test_jumps_of_rough_poses_are_not_what_they_have_wrong_for_seconds():
    """One step a meter off among steps of centimeters; and ten steps in a row that are decimeters off."""
    rng = np.random.default_rng(0)
    true = np.tile(np.eye(4), (60, 1, 1))
    true[:, 0, 3] = np.arange(60)
    steps = geometry.steps(true) @ geometry.exp(rng.normal(0, 0.01, (59, 6)))
    steps[20, 0, 3] += 1.0
    steps[40:50, 1, 3] += 0.3
    rough = [np.eye(4)]
    for step in steps:
        rough.append(rough[-1] @ step)
    mended = geometry.steps(path_motion.without_jumps(np.array(rough), true))
    np.testing.assert_allclose(mended[20], geometry.steps(true)[20], atol=1e-9)
    others = np.delete(np.arange(59), 20)
    np.testing.assert_allclose(mended[others], steps[others], atol=1e-9)
