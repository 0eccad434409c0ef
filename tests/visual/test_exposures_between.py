"""Exposures between keyframes: interpolated, and as uncertain as they are seen to change."""

import numpy as np
import pytest

from lvba.visual import exposures_between


def walk(rate, seed=0, images=4001, every=4, dt=0.05):
    """Times, keyframes and log exposures of a random walk of so much variance a second."""
    rng = np.random.default_rng(seed)
    times = 100.0 + dt * np.arange(images)
    steps = np.sqrt(rate * dt) * rng.normal(size=images - 1)
    return times, np.arange(0, images, every), np.r_[0.0, np.cumsum(steps)]


def test_images_between_are_off_by_as_much_as_is_said():
    times, keyframes, truth = walk(0.002)
    exposed, sigma = exposures_between.of_all(
        times, keyframes, truth[keyframes], np.full(len(keyframes), 1e-3)
    )
    np.testing.assert_array_equal(exposed[keyframes], truth[keyframes])
    np.testing.assert_array_equal(sigma[keyframes], 1e-3)
    for place in (1, 2, 3):
        off, said = (exposed - truth)[place::4], sigma[place::4]
        assert np.sqrt(np.mean(off**2)) == pytest.approx(np.sqrt(np.mean(said**2)), rel=0.1)


def test_the_rate_of_change_is_that_of_the_walk():
    for every in (1, 4):
        times, keyframes, truth = walk(0.003, 1, every=every)
        assert exposures_between.change_rate(times[keyframes], truth[keyframes]) == pytest.approx(
            0.003, rel=0.1
        )


def test_an_exposure_that_changes_steadily_is_known_between():
    times = np.arange(20.0)
    exposed, sigma = exposures_between.of_all(times, np.arange(0, 20, 3), 0.1 * times[::3], np.full(7, 1e-3))
    np.testing.assert_allclose(exposed[:19], 0.1 * times[:19], atol=1e-12)
    np.testing.assert_allclose(sigma[:19], 1e-3, rtol=1e-9)


def test_beyond_the_last_keyframe_an_exposure_may_go_anywhere():
    times, keyframes, truth = walk(0.002, images=401)
    keyframes = keyframes[5:-5]
    _, sigma = exposures_between.of_all(times, keyframes, truth[keyframes], np.zeros(len(keyframes)))
    rate = exposures_between.change_rate(times[keyframes], truth[keyframes])
    assert sigma[0] == pytest.approx(np.sqrt(rate * 20 * 0.05))
    assert sigma[-1] == pytest.approx(np.sqrt(rate * 20 * 0.05))
    assert sigma[0] > sigma[10] > sigma[19] > sigma[20] == 0.0


def test_few_keyframes_and_exposures_that_nothing_ties():
    times = np.arange(5.0)
    exposed, sigma = exposures_between.of_all(times, np.array([2]), np.array([0.3]), np.array([0.01]))
    np.testing.assert_array_equal(exposed, np.zeros(5))
    np.testing.assert_allclose(sigma, 0.01)
    _, sigma = exposures_between.of_all(times, np.array([0, 4]), np.array([0.0, 0.2]), np.zeros(2))
    assert sigma[2] == pytest.approx(np.sqrt(0.01 * 1.0))
    # one that is not known says nothing of how exposures change
    log_exposure, known = np.array([0.0, 5.0, 0.0, 0.0]), np.array([1e-3, np.inf, 1e-3, 1e-3])
    _, sigma = exposures_between.of_all(np.arange(7.0), np.array([0, 2, 4, 6]), log_exposure, known)
    assert sigma[5] == pytest.approx(1e-3)
    assert np.isinf(sigma[2])


@pytest.mark.parametrize("told", [np.inf, 0.2])
def test_a_keyframe_that_little_tells_of_is_taken_from_its_neighbors(told):
    times, sigma = np.arange(9.0), np.full(9, 1e-3)
    walked = np.array([0.0, 0.2, 0.2, 0.3, 0.4, 0.6, 0.6, 0.7, 0.8])
    own = walked.copy()
    own[[4, 8]] = 5.0
    sigma[[4, 8]] = told
    exposed, said = exposures_between.of_all(times, np.arange(9), own, sigma)
    np.testing.assert_allclose(exposed, [0.0, 0.2, 0.2, 0.3, 0.45, 0.6, 0.6, 0.7, 0.7], atol=1e-12)
    np.testing.assert_array_equal(said[[0, 1, 2, 3, 5, 6, 7]], 1e-3)
    if np.isinf(told):
        assert np.isinf(said[[4, 8]]).all()
    else:
        assert 0.02 < said[4] < said[8] < told
    sigma[[3, 5]] = told
    exposed, _ = exposures_between.of_all(times, np.arange(9), own, sigma)
    np.testing.assert_array_equal(exposed[:8], own[:8], "three tell of each other")


def test_a_keyframe_that_its_neighbors_do_not_contradict_stays():
    times, sigma = np.arange(9.0), np.full(9, 1e-3)
    own = np.array([0.0, 0.5, 0.0, 0.5, 0.1, 0.5, 0.0, 0.5, 0.0])
    sigma[4] = 0.02
    exposed, said = exposures_between.of_all(times, np.arange(9), own, sigma)
    np.testing.assert_array_equal(exposed, own)
    np.testing.assert_array_equal(said, sigma)


def test_keyframes_of_which_nothing_is_known_stay_as_they_are():
    own = np.array([0.0, 0.3, 0.1, 0.2])
    exposed, said = exposures_between.of_all(np.arange(4.0), np.arange(4), own, np.full(4, np.inf))
    np.testing.assert_array_equal(exposed, own)
    assert np.isinf(said).all()


def test_the_line_is_as_good_as_the_walk_lets_it_be():
    rng = np.random.default_rng(3)
    times = np.arange(4001.0)
    walk = np.cumsum(rng.normal(0, 0.02, 4001))
    off = exposures_between.off_line(times[::4], walk[::4], times)
    between = off > 0
    line = np.interp(times, times[::4], walk[::4])
    assert np.std((walk - line)[between] / off[between]) == pytest.approx(1, abs=0.1)
    np.testing.assert_array_equal(off[::4], 0.0)
