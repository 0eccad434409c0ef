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
