"""What errors of the range sensor may be, and what that makes of points, against definitions and samples."""

import math
from dataclasses import replace

import numpy as np
import pytest

from lvba.lidar import range_uncertainty, scan_evidence
from lvba.lidar.range_errors import (
    DISTORTION,
    ELEVATION,
    INCIDENCE,
    OFFSET,
    by_errors,
    cosines_on_planes,
    directions,
)
from lvba.lidar.range_uncertainty import USUAL, Response, by_grazing
from tests.lidar.test_range_errors import AHEAD, AROUND, room


@pytest.mark.parametrize("beams", [AHEAD, AROUND])
def test_points_are_off_by_as_much_as_correcting_an_error_moves_them(beams):
    """All points, along the normals of their planes."""
    view = room(beams, {}, noise=0.01)
    errors = dict(zip(beams.names, [0.004, 0.0002, 0.0003, -0.003][-len(beams.names) :], strict=True))
    cosine = cosines_on_planes(view, beams)
    points = view.scans.points.astype(float)
    moved = sum(value * beams.shift(name, points, cosine) for name, value in errors.items())
    pose = np.repeat(view.world_from_scan, np.diff(view.scans.offsets), axis=0)
    normal = np.einsum("nji,nj->ni", pose[:, :3, :3], view.planes.normal[view.labels.plane])
    off = np.einsum("ni,ni->n", moved, normal)
    part = off / np.linalg.norm(points - beams.position, axis=1)
    values = np.array(list(errors.values()))
    response = range_uncertainty.response(view, beams, None)
    assert 0.1 * len(points) < response.points < 0.2 * len(points)
    expected = [np.sqrt(np.mean(part**2)), np.sqrt(np.mean(off**2))]
    np.testing.assert_allclose(response.off(np.outer(values, values)), expected, rtol=0.05)


def test_responses_add_up_and_no_point_is_off_by_nothing():
    one, none = Response(np.ones((2, 3, 3)), 4), range_uncertainty.none(3)
    assert (one + none).off(np.eye(3)) == one.off(np.eye(3)) == (pytest.approx(np.sqrt(3 / 4)),) * 2
    assert (one + one).off(np.eye(3)) == one.off(np.eye(3))
    assert none.off(np.eye(3)) == (0.0, 0.0)


def test_what_is_left_of_errors_is_their_posterior_about_the_correction():
    """By samples of errors and of what is measured of them, of which those near the measured ones are kept."""
    rng = np.random.default_rng(2)
    names = (INCIDENCE, OFFSET)
    spread = np.array([[3e-5, -1.7e-5], [-1.7e-5, 2e-5]])
    estimate, corrected = np.array([0.016, -0.004]), np.array([0.0, 0.005])
    true = rng.normal(size=(4_000_000, 2)) * [USUAL[name] for name in names]
    seen = true + rng.multivariate_normal(np.zeros(2), spread, len(true))
    near = (np.abs(seen - estimate) < 0.001).all(axis=1)
    assert near.sum() > 5000
    off = (true[near] - corrected).mean(axis=0)
    known = np.cov(true[near].T)
    beyond = 1 - 2 / (off @ np.linalg.solve(known, off))
    assert 0 < beyond < 1
    moment = range_uncertainty.moment(np.array([USUAL[name] for name in names]), estimate, spread, corrected)
    np.testing.assert_allclose(moment, known + beyond * np.outer(off, off), rtol=0.1, atol=2e-6)


def test_errors_that_no_plane_tells_of_are_as_large_as_usual():
    usual = range_uncertainty.usual(AROUND)
    assert usual.tolist() == [USUAL[name] for name in AROUND.names]
    unknown = np.diag(np.full(len(usual), np.inf))
    moment = range_uncertainty.moment(usual, np.zeros(len(usual)), unknown, np.zeros(len(usual)))
    expected = np.diag(usual**2)
    np.testing.assert_allclose(moment, expected, rtol=1e-5, atol=1e-12)


def test_elevations_of_a_sensor_that_looks_ahead_are_as_good_as_data_sheets_say():
    ahead = dict(zip(AHEAD.names, range_uncertainty.usual(AHEAD), strict=True))
    expected = USUAL | {ELEVATION: math.radians(0.1)}
    assert ahead == {name: expected[name] for name in AHEAD.names}
    assert {ELEVATION, DISTORTION} <= set(ahead)


def test_an_error_that_is_well_known_leaves_nothing_of_its_usual_size():
    usual = np.array([USUAL[INCIDENCE], USUAL[OFFSET]])
    moment = range_uncertainty.moment(usual, np.array([0.02, 0.0]), 1e-8 * np.eye(2), np.array([0.02, 0.0]))
    assert np.sqrt(np.diagonal(moment)) == pytest.approx(1e-4, rel=0.01)
    kept = range_uncertainty.moment(usual, np.array([0.02, 0.0]), 1e-8 * np.eye(2), np.zeros(2))
    assert np.sqrt(kept[0, 0]) == pytest.approx(0.02, rel=0.01)


def test_planes_off_by_an_error_are_as_far_off_as_is_said():
    """Of many rooms with an error each, by what is measured of it: the root mean square of what is left, over what is
    said of that."""
    rng, ratios = np.random.default_rng(3), []
    for seed in range(12):
        error = {OFFSET: 0.01 * rng.normal()}
        view = room(AROUND, error, seed=seed, noise=0.02)
        known = scan_evidence.evidence(view, by_errors(AROUND), 3)
        none = np.zeros(3)
        moment = range_uncertainty.moment(
            range_uncertainty.usual(AROUND), known.change, known.covariance, none
        )
        truth = np.array([error.get(name, 0.0) for name in AROUND.names])
        response = range_uncertainty.response(view, AROUND, None)
        ratios.append(response.off(np.outer(truth, truth))[1] / response.off(moment)[1])
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 1.5


def test_errors_follow_ranges_that_are_too_long_at_grazing_angles(monkeypatch):
    """As far as the evidence of the same planes foretells; here at angles that the walls of a room are met at."""
    monkeypatch.setattr(range_uncertainty, "_GRAZING_COSINE", 0.8)
    view, long = room(AROUND, {}, noise=0.002), 0.02
    points = view.scans.points.astype(float)
    pose = np.repeat(view.world_from_scan, np.diff(view.scans.offsets), axis=0)
    normal = np.einsum("nji,nj->ni", pose[:, :3, :3], view.planes.normal[view.labels.plane])
    ray, _ = directions(points, AROUND.position)
    grazing = np.abs(np.einsum("ni,ni->n", ray, normal)) < 0.8
    assert 0.05 < grazing.mean() < 0.5
    moved = (points + long * ray * grazing[:, None]).astype(np.float32)
    longer = replace(view, scans=replace(view.scans, points=moved))
    terms = by_errors(AROUND), by_grazing(AROUND)
    before, after = (
        scan_evidence.evidence(each, lambda on: np.concatenate([term(on) for term in terms], axis=1), 4)
        for each in (view, longer)
    )
    own = slice(0, 3)
    by_evidence = after.of(own).change - before.of(own).change
    follows = before.follows(own, 3)
    assert (np.abs(follows) > 0).all()
    np.testing.assert_allclose(by_evidence, -long * follows, rtol=0.15, atol=2e-4)
