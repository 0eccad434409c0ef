"""How far planes are off, estimated from what images say of the offsets of their points."""

from dataclasses import fields
from types import SimpleNamespace

import numpy as np
import pytest

from lvba.visual import bundle_adjustment, covariance
from lvba.visual.scene_points import ScenePoints

FLOOR = 0.001


def points_on(counts, sigma, uneven=0.0):
    """Scene points on planes that have so many each, with these standard deviations, m."""
    plane = np.repeat(np.arange(len(counts)), counts)
    known = {field.name: np.zeros(len(plane)) for field in fields(ScenePoints)}
    known |= {
        "plane": plane,
        "sigma_plane": np.asarray(sigma)[plane],
        "unevenness": np.full(len(plane), uneven),
    }
    return ScenePoints(**known)


def solved(points, shared, rng, noise=0.003):
    """Problem, offsets and information as a solve leaves them: images know each point's offset to `noise` m."""
    sigma = bundle_adjustment.offset_sigma(points, FLOOR)
    seen, prior = np.full(len(sigma), 1 / noise**2), 1 / sigma**2
    true = shared[points.plane] + points.unevenness * rng.normal(size=len(sigma))
    offset = seen / (seen + prior) * (true + noise * rng.normal(size=len(sigma)))
    return SimpleNamespace(points=points, offset_sigma=sigma), offset, seen + prior


@pytest.mark.parametrize("actual", [0.5, 1.0, 3.0])
def test_planes_of_any_size_show_how_far_they_are_off(actual):
    rng = np.random.default_rng(0)
    counts = np.concatenate([np.full(150, 12), np.full(150, 200)])
    points = points_on(counts, np.full(300, 0.002))
    shared = actual * 0.002 * rng.normal(size=300)
    assert covariance.offset_scale(*solved(points, shared, rng)) == pytest.approx(actual, rel=0.2)


def test_many_points_of_large_planes_that_agree_do_not_make_small_planes_certain():
    rng = np.random.default_rng(1)
    counts = np.concatenate([np.full(200, 15), np.full(20, 1000)])
    sigma = np.full(220, 0.002)
    shared = np.where(counts < 100, sigma, 1e-5) * rng.normal(size=220)
    found = covariance.offset_scale(*solved(points_on(counts, sigma), shared, rng))
    assert 0.6 < found < 1.2


def test_what_surfaces_are_off_planes_is_no_vote_on_planes():
    rng = np.random.default_rng(2)
    points = points_on(np.full(200, 30), np.full(200, 0.002), uneven=0.004)
    found = covariance.offset_scale(*solved(points, 0.002 * rng.normal(size=200), rng))
    assert found == pytest.approx(1.0, abs=0.2)


def test_few_planes_decide_nothing():
    rng = np.random.default_rng(3)
    points = points_on(np.full(6, 500), np.full(6, 0.002))
    assert covariance.offset_scale(*solved(points, np.full(6, 0.02), rng)) == 1.0


def test_offsets_of_a_plane_know_together_what_the_plane_is_known_to_and_unevenness_adds():
    counts = np.array([4, 100])
    points = points_on(counts, [0.002, 0.0], uneven=0.003)
    sigma = bundle_adjustment.offset_sigma(points, FLOOR, scale=1.5)
    expected = np.hypot(1.5 * np.array([0.002, FLOOR]) * np.sqrt(counts), 0.003)
    np.testing.assert_allclose(sigma, expected[points.plane])
