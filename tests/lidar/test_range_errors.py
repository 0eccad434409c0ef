"""Errors of the range sensor: derivatives against differences, elimination, and points that go back where they belong."""

import itertools
import json
from dataclasses import replace

import numpy as np
import pytest

from lvba import geometry
from lvba.dataset import Scan
from lvba.lidar import range_errors, scan_evidence
from lvba.lidar.bundle_adjustment import refine
from lvba.lidar.plane import PlanePoints, Planes
from lvba.lidar.point_times import PointClock
from lvba.lidar.range_errors import (
    BRIGHTNESS,
    DIRECTION,
    DISTORTION,
    ELEVATION,
    INCIDENCE,
    OFFSET,
    Beams,
    RangeErrors,
)
from lvba.lidar.scan import gather
from lvba.lidar.scan_errors import ScanErrors
from lvba.lidar.scan_evidence import ScanEvidence, View
from lvba.lidar.scan_motion import MotionLeft
from lvba.steps import report_data
from lvba.steps.lidar import with_errors

AHEAD = Beams(np.array([0.1, -0.2, 0.3]), np.array([1.0, 0.0, 0.0]), True, up=np.array([0.0, 0.0, 1.0]))
AROUND = Beams(np.array([0.1, -0.2, 0.3]), np.array([0.0, 0.0, 1.0]), False)
MATT = Beams(np.array([0.1, -0.2, 0.3]), np.array([0.0, 0.0, 1.0]), False, usual=40.0)
NORMALS = np.linalg.qr(np.random.default_rng(1).normal(size=(6, 3, 3)))[0][:, :, 0]


def measured(beams, errors, rays, distance, normal, bright=1.0):
    """What a sensor with errors makes of beams (N, 3) that meet a surface at a distance: by the definitions alone.

    bright: of the surface, times the usual
    """
    factor, directions = 1.0, rays
    bias = errors.get(OFFSET, 0.0) + errors.get(BRIGHTNESS, 0.0) * (bright - 1)
    if INCIDENCE in errors:
        bias = bias + errors[INCIDENCE] * (1 - np.abs(np.einsum("ni,ni->n", rays, normal)))
    if DISTORTION in errors:
        factor = 1 + errors[DISTORTION] * np.tan(np.arccos(rays @ beams.axis)) ** 2
    if DIRECTION in errors:
        factor = 1 + errors[DIRECTION] * np.abs(rays[:, 0])
    if ELEVATION in errors:
        elevation = np.arcsin(rays[:, 2]) - errors[ELEVATION]
        azimuth = np.arctan2(rays[:, 1], rays[:, 0])
        directions = np.stack(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], 1
        )
    return beams.position + directions * (distance * factor + bias)[:, None]


def room(beams, errors, seed=0, noise=0.0, bright=None, tilt=0.5):
    """Scans of the walls of a convex room, taken with errors; planes and poses are the true ones.

    bright: (12,), times the usual, of the walls; tilt: rad, of the scans, one standard deviation
    """
    rng = np.random.default_rng(seed)
    normals, offsets = np.concatenate([NORMALS, -NORMALS]), np.full(2 * len(NORMALS), 8.0)
    poses = geometry.exp(rng.normal(size=(8, 6)) * [tilt, tilt, 0.5, 1.5, 1.5, 1.5])
    points, labels = [], []
    for pose in poses:
        rays = rng.normal(size=(6000, 3)) * [1, 1, 0.3]
        rays /= np.linalg.norm(rays, axis=1)[:, None]
        rays = rays[rays[:, 0] > 0.75] if beams.narrow else rays
        origin = pose[:3, :3] @ beams.position + pose[:3, 3]
        speed = rays @ pose[:3, :3].T @ normals.T
        reach = np.where(speed > 0, (offsets - normals @ origin) / np.maximum(speed, 1e-9), np.inf)
        hit, distance = np.argmin(reach, axis=1), reach.min(axis=1)
        distance = distance + noise * rng.normal(size=len(distance))
        shine = 1.0 if bright is None else bright[hit]
        points.append(measured(beams, errors, rays, distance, normals[hit] @ pose[:3, :3], shine))
        labels.append(hit)
    axes = [np.linalg.svd(normal[None])[2].T for normal in normals]
    planes = Planes(
        center=normals * 8.0,
        normal=normals,
        eigenvalues=np.tile([1e-4, 1.0, 1.0], (len(normals), 1)),
        axes=np.stack([np.c_[n, a[:, 1:]] for n, a in zip(normals, axes, strict=True)]),
        count=np.ones(len(normals), np.int64),
        scans=np.full(len(normals), 8, np.int32),
        size=np.ones(len(normals)),
        sigma_offset=np.full(len(normals), 1e-3),
        unevenness=np.zeros(len(normals)),
    )
    scans, plane = gather(points), np.concatenate(labels).astype(np.int32)
    return View.of(scans, poses, planes, PlanePoints(scans.points, plane, scans.offsets), beams.position)


@pytest.mark.parametrize(
    ("beams", "name", "value"),
    [
        (AROUND, INCIDENCE, 0.02),
        (AROUND, ELEVATION, 0.005),
        (AHEAD, DISTORTION, 0.02),
        (AHEAD, ELEVATION, 0.005),
        (AROUND, OFFSET, 0.02),
        (MATT, BRIGHTNESS, 0.02),
    ],
)
def test_points_go_back_where_they_belong(beams, name, value):
    rays = np.random.default_rng(2).normal(size=(400, 3)) * [1, 1, 0.4]
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    rays = rays[rays[:, 0] > 0.75]
    normal = np.tile([-0.8, 0.6, 0.0], (len(rays), 1))
    distance, bright = np.full(len(rays), 7.0), np.linspace(0.2, 2.0, len(rays))
    true, off = (measured(beams, errors, rays, distance, normal, bright) for errors in ({}, {name: value}))
    cosine = np.abs(np.einsum("ni,ni->n", rays, normal))
    back = RangeErrors(beams, {name: value}, {name: 1e-3}, (name,)).points(off, cosine, 40 * bright * cosine)
    assert np.abs(off - true).max() > 5e-3
    np.testing.assert_allclose(back, true, atol=0.06 * np.abs(off - true).max())


def test_angles_that_are_known_later_move_points_to_where_they_would_have_been():
    rng = np.random.default_rng(3)
    points = (rng.normal(size=(300, 3)) * 8).astype(np.float32)
    guessed, true = rng.uniform(0.1, 1.0, (2, 300))
    errors = RangeErrors(AROUND, {INCIDENCE: 0.03, ELEVATION: 0.002}, {}, (INCIDENCE, ELEVATION))
    moved = errors.met_at(errors.points(points, guessed), guessed, true)
    np.testing.assert_allclose(moved, errors.points(points, true), atol=1e-4)
    other = RangeErrors(AROUND, {ELEVATION: 0.002}, {}, (ELEVATION,))
    assert other.met_at(points, guessed, true) is points
    assert other.cosines(points) is None


@pytest.mark.parametrize("beams", [AROUND, AHEAD, MATT])
def test_derivatives_against_differences(beams):
    view = room(beams, {})
    step = 1e-2  # points are float32, and move in proportion
    cosine = range_errors.cosines_on_planes(view, beams)
    intensity = np.random.default_rng(4).uniform(10, 90, 12)[view.labels.plane] * cosine
    brighter = range_errors.brighter_on_planes(view, beams, intensity, cosine)
    for number, name in enumerate(beams.names):
        ends = []
        for sign in (1, -1):
            moved = RangeErrors(beams, {name: sign * step}, corrected=(name,))
            ends.append(moved.points(view.scans.points.astype(float), cosine, intensity).astype(float))
        _, x, _, _ = scan_evidence.terms(view, 3, range_errors.by_errors(beams, brighter))
        plane, chosen = view.on_planes(3)
        turn, normal = view.world_from_scan[3][:3, :3], view.planes.normal[plane]
        by_difference = np.einsum("ni,ij,nj->n", normal, turn, (ends[0] - ends[1])[chosen]) / (2 * step)
        np.testing.assert_allclose(x[:, 6 + number] * 0.01, by_difference, atol=2e-3)


@pytest.mark.parametrize(
    ("beams", "errors"),
    [
        (AROUND, {INCIDENCE: 0.01, ELEVATION: 0.002}),
        (AHEAD, {INCIDENCE: -0.01, DISTORTION: 0.004}),
        (AHEAD, {ELEVATION: 0.004}),
        (AROUND, {}),
    ],
)
def test_errors_are_found_within_their_deviations(beams, errors):
    view = room(beams, errors, noise=0.01)
    known = scan_evidence.evidence(view, range_errors.by_errors(beams), len(beams.names))
    expected = np.array([errors.get(name, 0.0) for name in beams.names])
    # the change is linear: errors turn with themselves by up to some percent
    assert (np.abs(known.change - expected) < 4 * known.sigma + 0.05 * np.abs(expected)).all()
    # seen by a sensor that looks ahead, an offset is much like incidence
    like, angle = (4e-2, 1e-3) if beams.narrow else (5e-3, 5e-4)
    most = {INCIDENCE: like, DISTORTION: angle, ELEVATION: angle, OFFSET: like}
    assert (known.sigma < [most[name] for name in beams.names]).all()


@pytest.mark.parametrize("errors", [{}, {BRIGHTNESS: 0.01, OFFSET: -0.004}, {INCIDENCE: 0.01}])
def test_brightness_offset_and_incidence_are_told_apart(errors):
    bright = np.random.default_rng(6).uniform(0.2, 1.8, 12)
    view = room(MATT, errors, noise=0.01, bright=bright)
    cosine = range_errors.cosines_on_planes(view, MATT)
    intensity = 40 * bright[view.labels.plane] * cosine
    brighter = range_errors.brighter_on_planes(view, MATT, intensity, cosine)
    np.testing.assert_allclose(brighter, bright[view.labels.plane] - 1, atol=1e-9)
    known = scan_evidence.evidence(view, range_errors.by_errors(MATT, brighter), 4)
    expected = np.array([errors.get(name, 0.0) for name in MATT.names])
    assert (np.abs(known.change - expected) < 4 * known.sigma + 0.05 * np.abs(expected)).all()
    assert known.sigma[3] < 2e-3


def test_brightness_is_that_of_planes_and_bounded():
    """Points of another surface on a plane do not count; reflectors and points without intensity are not believed."""
    view = room(MATT, {})
    cosine = range_errors.cosines_on_planes(view, MATT)
    intensity = np.where(np.arange(len(cosine)) % 10 == 0, 4000.0, 80.0 * cosine)
    intensity[5] = np.nan
    np.testing.assert_allclose(range_errors.brighter_on_planes(view, MATT, intensity, cosine), 1.0)
    np.testing.assert_allclose(MATT.brighter(np.ones(3), np.array([4e3, 0.0, np.nan])), [2.0, -1.0, 0.0])
    assert range_errors.usual_brightness(None, np.ones(3)) is None
    assert range_errors.usual_brightness(np.full(9, 5.0), np.ones(9)) is None
    assert range_errors.usual_brightness(np.array([1.0, 4.0, 6.0]), np.full(3, 0.5)) == 8.0


@pytest.mark.parametrize("errors", [{OFFSET: 0.004}, {}])
def test_without_intensities_there_is_no_brightness(errors):
    view = room(AROUND, errors, noise=0.01)
    assert BRIGHTNESS not in AROUND.names
    known = scan_evidence.evidence(view, range_errors.by_errors(AROUND), 3)
    assert abs(known.change[2] - errors.get(OFFSET, 0.0)) < 4 * known.sigma[2]


@pytest.mark.parametrize(
    ("errors", "by_direction"),
    [({}, False), ({ELEVATION: 0.003}, False), ({DIRECTION: 0.01}, True)],
)
def test_what_depends_on_the_direction_in_another_way_is_told_apart(errors, by_direction):
    """A sensor that turns: beams that go higher, or ranges that are too long ahead and behind."""
    view = room(AROUND, errors, noise=0.01)
    own, others = range_errors.by_errors(AROUND), range_errors.by_directions(AROUND)
    known = scan_evidence.evidence(view, lambda each: np.concatenate([own(each), others(each)], axis=1), 11)
    alone = scan_evidence.evidence(view, own, 3)
    np.testing.assert_allclose(known.of(slice(0, 3)).change, alone.change, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(known.of(slice(0, 3)).covariance, alone.covariance, rtol=1e-6)
    assert (known.chance(slice(3, 11)) < range_errors.CHANCE) == by_direction
    assert by_direction or known.chance(slice(3, 11)) > 1e-3


def test_nothing_is_told_by_chance_where_nothing_tells():
    assert scan_evidence.nothing(3).chance(slice(1, 3)) == 1.0


def test_elimination_takes_out_what_may_be_chance():
    least, most = np.array([1e-3, 1e-4]), np.array([0.05, 0.02])
    covariance = np.diag([1e-3, 1e-4]) ** 2
    kept, values = range_errors.significant(np.array([0.02, 2e-4]), covariance, least, most)
    np.testing.assert_array_equal(kept, [True, False])
    np.testing.assert_allclose(values, [0.02, 0.0])
    assert not range_errors.significant(np.array([5e-3, 5e-4]), covariance, least, most)[0].any()
    # what is significant but too small to matter, or too large to be believed, is none
    assert not range_errors.significant(np.array([9e-4, 0.0]), covariance * 1e-4, least, most)[0].any()
    alike = np.array([[1e-4, 0.99e-5], [0.99e-5, 1e-6]])
    kept, values = range_errors.significant(np.array([0.116, 0.0135]), alike * 1e-3, least, most)
    np.testing.assert_array_equal(kept, [False, True])
    assert values[1] == pytest.approx(0.0135 - 0.099 * 0.116)


def test_beams_are_known_by_where_points_are():
    rng = np.random.default_rng(3)
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    around, ahead = rng.normal(size=(900, 3)) * [1, 1, 0.2], rng.normal(size=(900, 3)) * 0.2 + [1, 0, 0]
    position = np.array([0.3, 0.1, -0.2])
    spinning = Beams.of([around @ axes.T + position], position, axes)
    assert spinning.names == (INCIDENCE, ELEVATION, OFFSET)
    np.testing.assert_allclose(np.abs(spinning.axis @ axes[:, 2]), 1.0)
    camera = Beams.of([ahead @ axes.T + position], position, axes)
    assert camera.names == (INCIDENCE, DISTORTION, ELEVATION, OFFSET)
    np.testing.assert_allclose(camera.axis, axes[:, 0], atol=1e-12)
    np.testing.assert_allclose(camera.up, axes[:, 2], atol=1e-12)
    optical = Beams.of([ahead[:, [1, 2, 0]] @ axes.T + position], position, axes)
    np.testing.assert_allclose(optical.axis, axes[:, 2], atol=1e-12)
    np.testing.assert_allclose(optical.up, -axes[:, 1], atol=1e-12)
    assert Beams.of([rng.normal(size=(900, 3))], np.zeros(3), np.eye(3)).names == (INCIDENCE, OFFSET)
    assert Beams.of([], np.zeros(3), np.eye(3)).axis is None


def test_what_shows_late_falls_from_where_it_was_first_seen():
    rounds = np.array([[0.0, 0.0, 0.0], [4.0, 0.0, 3.0], [4.5, 2.0, 0.0], [4.6, 2.4, 2.0]])
    assert range_errors.falls(rounds).tolist() == [True, True, False]
    assert range_errors.falls(rounds[:2]).tolist() == [False, True, False]


@pytest.mark.parametrize("beams", [MATT, replace(AHEAD, usual=40.0)])
def test_facts_bring_errors_back(beams):
    values = {INCIDENCE: 0.002, ELEVATION: 0.003, BRIGHTNESS: 0.004}
    ranges = RangeErrors(beams, values, {ELEVATION: 1e-4}, (ELEVATION, BRIGHTNESS))
    clock = PointClock(1.0, 0.1, -0.1, True)
    motion = MotionLeft(clock=clock, fraction=0.5, sigma=1e-3, motion=np.ones((2, 6)))
    errors = ScanErrors(ranges, motion)
    facts = json.loads(json.dumps(report_data.plain(report_data.of_scan_errors(errors))))
    again = ScanErrors.of_facts(facts)
    rng = np.random.default_rng(5)
    points, intensity = rng.normal(size=(60, 3)).astype(np.float32), rng.uniform(5, 60, 60).astype(np.float32)
    scan = Scan(points, intensity, np.linspace(0, 0.1, 60))
    np.testing.assert_array_equal(again.points(scan, 1, 0.1), errors.points(scan, 1, 0.1))
    assert np.abs(again.points(scan, 1, 0.1) - scan.points).max() > 1e-3
    assert ScanErrors.of_facts({}) is None
    assert ScanErrors.of_facts({"range_errors": {"corrected": [ELEVATION]}}) is None
    still = RangeErrors(AROUND, {INCIDENCE: 0.002}, {INCIDENCE: 0.01})
    assert still.points(scan.points) is scan.points
    assert report_data.warnings_of_errors(errors)[0].startswith("Beams go 0.17 degrees higher")


def test_what_planes_leave_open_is_taken_to_be_as_large_as_expected():
    """One number known to 0.001, one to 1: estimates of 0.02 and 3, expected to be off by 0.01."""
    own = np.diag([1e3, 1.0])
    evidence = ScanEvidence(
        np.diag([1e6, 1.0]), np.array([2e4, 3.0]), own, np.zeros((2, 2, 2)), np.zeros((2, 2))
    )
    spread = evidence.covariance
    expected = 1e-4 * np.linalg.solve(1e-4 * np.eye(2) + spread, evidence.change)
    np.testing.assert_allclose(evidence.likely(slice(0, 2), 0.01), expected, rtol=1e-9)
    assert abs(expected[1]) < 0.01 < abs(evidence.change[1])


def test_how_far_poses_go_by_a_number_that_is_not_known_of():
    """One that moves the points of a single scan upward moves that scan downward, and no other."""
    view = room(AROUND, {}, noise=0.01)
    upward = view.world_from_scan[:, :3, :3].transpose(0, 2, 1) @ [0.0, 0.0, 1.0]

    def by_shared(points):
        return np.where(points.scan == 3, points.normal @ upward[3], 0.0)[:, None]

    turn, shift = scan_evidence.evidence(view, by_shared, 1).poses.by(np.eye(1), 0.0)
    # of eight scans, about their mean, without a common turn, of which an angle counts by what it moves a meter away,
    # and without a common scale
    place = view.world_from_scan[:, :3, 3] - view.world_from_scan[:, :3, 3].mean(axis=0)
    moved = np.zeros((8, 3))
    moved[3, 2] = 1.0
    moved -= moved.mean(axis=0)
    by_turn = np.cross(np.eye(3)[None], place[:, None]).transpose(0, 2, 1)
    turns = np.concatenate([by_turn.reshape(24, 3), np.tile(np.eye(3), (8, 1))])
    common = np.linalg.lstsq(turns, np.r_[moved.ravel(), np.zeros(24)])[0]
    moved -= by_turn @ common
    moved -= place * np.sum(place * moved) / np.sum(place**2)
    assert shift == pytest.approx(np.sqrt(np.sum(moved**2) / 8), rel=0.03)
    assert 0.7 * np.sqrt(7) / 8 < shift < np.sqrt(7) / 8
    assert turn == pytest.approx(np.linalg.norm(common), rel=0.03)
    assert scan_evidence.nothing(1).poses.by(np.eye(1), 5.0) == (0.0, 0.0)


def test_what_errors_in_the_points_make_of_poses_is_promised_and_shared_by_neighbors():
    view = room(AROUND, {}, noise=0.01)
    scans = [view.scans.points[a:b] for a, b in itertools.pairwise(view.scans.offsets)]
    plain = refine(scans, view.world_from_scan)
    left = ScanErrors(RangeErrors(AROUND, poses_off=(0.001, 0.003)), None)
    known = with_errors(plain, left, np.arange(len(scans)))
    more = known.shared_factor * (known.whole_covariance.marginal - plain.whole_covariance.marginal)
    assert np.sqrt(np.trace(more[2, 3:, 3:])) == pytest.approx(0.003)
    assert np.sqrt(np.trace(more[2, :3, :3])) == pytest.approx(0.001)
    # cameras, which see the map about a scan, could not tell
    for name in ("conditional", "in_map", "step"):
        np.testing.assert_array_equal(
            getattr(known.whole_covariance, name), getattr(plain.whole_covariance, name)
        )
    nothing_left = with_errors(plain, ScanErrors(RangeErrors(AROUND), None), np.arange(len(scans)))
    np.testing.assert_array_equal(nothing_left.covariance, plain.covariance)
