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
    directions,
)
from lvba.lidar.range_uncertainty import EVERYWHERE, USUAL, Response, by_grazing
from tests.lidar.test_range_errors import AHEAD, AROUND, room


@pytest.mark.parametrize("beams", [AHEAD, AROUND])
def test_planes_and_scans_move_as_those_that_are_solved_for_anew(beams):
    """Points moved by an error, against poses and planes of least squares with that error given."""
    view = room(beams, {}, noise=0.002)
    _, moved = scan_evidence.evidence_and_moved(view, by_errors(beams), len(beams.names))
    planes, scans, size = len(view.planes.center), len(view.world_from_scan), len(beams.names)
    rows = [scan_evidence.terms(view, scan, by_errors(beams)) for scan in range(scans)]
    square, right = np.zeros((6 * scans + 3 * planes,) * 2), np.zeros((6 * scans + 3 * planes, size))
    for scan, (plane, x, y, _) in enumerate(rows):
        jacobian = np.zeros((len(plane), len(square)))
        jacobian[:, 6 * scan : 6 * scan + 6] = x[:, :6]
        for axis in range(3):
            jacobian[np.arange(len(plane)), 6 * scans + 3 * plane + axis] = -y[:, axis]
        square += jacobian.T @ jacobian
        right -= jacobian.T @ x[:, 6:]
    square[np.diag_indices(6 * scans)] += np.tile(scan_evidence.POSE_SIGMA**-2.0, scans)
    square[np.diag_indices(len(square))] += np.r_[np.zeros(6 * scans), np.full(3 * planes, 1e-6)]
    solved = np.linalg.solve(square, right)
    np.testing.assert_allclose(moved.scans, solved[: 6 * scans].reshape(scans, 6, size), rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(moved.planes, solved[6 * scans :: 3], rtol=1e-4, atol=1e-7)


def test_beams_that_go_too_high_put_a_level_camera_as_far_below_as_they_lower_the_floor():
    """And nowhere else: walls stay where they are."""
    view = room(AROUND, {}, noise=0.002, tilt=0.02)
    _, moved = scan_evidence.evidence_and_moved(view, by_errors(AROUND), 3)
    response = range_uncertainty.response(view, moved, EVERYWHERE)
    wrong = 0.002 * (np.array(AROUND.names) == ELEVATION)
    off = np.sqrt(np.diagonal(response.off(np.outer(wrong, wrong))))
    level = np.abs(view.planes.normal[:, 2]) > 0.9
    lowered = 0.002 * np.abs(moved.planes[level][:, AROUND.names.index(ELEVATION)])
    assert lowered.min() > 2e-3
    # walls that lean in are lowered less
    assert 0.8 * lowered.min() < off[5] < lowered.max()
    assert off[[3, 4]].max() < 0.2 * off[5]
    assert off[:3].max() < 2e-4


def test_a_camera_moves_with_the_planes_that_it_sees():
    """Ranges that are too long put walls outward: a camera that looks at one of them, nearer to it by so much; one that
    sees all around, nowhere."""
    view = room(AROUND, {}, noise=0.002, tilt=0.02)
    _, moved = scan_evidence.evidence_and_moved(view, by_errors(AROUND), 3)
    wrong = 0.01 * (np.array(AROUND.names) == OFFSET)
    ahead = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    sees = range_uncertainty.sight(ahead, math.radians(20))
    assert sees.ahead == pytest.approx([1, 0, 0])
    forward, around = (
        np.sqrt(np.diagonal(range_uncertainty.response(view, moved, each).off(np.outer(wrong, wrong))))
        for each in (sees, EVERYWHERE)
    )
    assert forward[3] == pytest.approx(0.01, rel=0.15)
    assert around[3:5].max() < 0.003


def test_responses_add_up_and_no_scan_is_off_by_nothing():
    one = Response(np.eye(3), 0.01 * np.ones((3, 3)), 0.02 * np.ones((6, 3)), 1)
    none = range_uncertainty.none(3)
    for same in (one + none, one + one):
        np.testing.assert_allclose(same.off(np.eye(3)), one.off(np.eye(3)), rtol=1e-9)
    assert not none.off(np.eye(3)).any()


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


def test_cameras_off_by_an_error_are_as_far_off_as_is_said():
    """Of many rooms with an error each, by what is measured of it: the root mean square of what is left, over what is
    said of that."""
    rng, ratios = np.random.default_rng(3), []
    for seed in range(12):
        error = {ELEVATION: math.radians(0.2) * rng.normal()}
        view = room(AROUND, error, seed=seed, noise=0.02)
        known, moved = scan_evidence.evidence_and_moved(view, by_errors(AROUND), 3)
        none = np.zeros(3)
        moment = range_uncertainty.moment(
            range_uncertainty.usual(AROUND), known.change, known.covariance, none
        )
        truth = np.array([error.get(name, 0.0) for name in AROUND.names])
        response = range_uncertainty.response(view, moved, EVERYWHERE)
        ratios.append(response.off(np.outer(truth, truth))[5, 5] / response.off(moment)[5, 5])
    assert 0.5 < np.sqrt(np.mean(ratios)) < 1.5


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
