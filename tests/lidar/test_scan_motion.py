"""The part of the motion left in scans, from planes: against its definition, and against a plain least squares."""

from dataclasses import replace

import numpy as np
import pytest

from lvba import geometry
from lvba.lidar import scan_evidence, scan_motion
from lvba.lidar.plane import PlanePoints, Planes
from lvba.lidar.point_times import PointClock
from lvba.lidar.scan import gather
from lvba.lidar.scan_evidence import View
from lvba.lidar.scan_motion import MotionLeft

SCANS, PLANES, EACH = 4, 7, 60
SWEEP = 0.1


def made(part, seed=0, noise=1e-4, scan_count=SCANS, growth=0.0):
    """Scans of random planes with a part of the motion in them, at their true poses; planes as they are seen there.

    growth: standard deviation of how much the motion grows over a sweep, rad/s and m/s
    """
    rng = np.random.default_rng(seed)
    poses = geometry.exp(rng.normal(size=(scan_count, 6)) * [0.3, 0.3, 0.3, 1, 1, 1])
    twist = rng.normal(size=(scan_count, 6)) * [0.2, 0.2, 0.2, 1, 1, 1]
    grows = growth * np.random.default_rng([seed, 1]).normal(size=(scan_count, 6))
    axes = np.linalg.qr(rng.normal(size=(PLANES, 3, 3)))[0]
    center = rng.uniform(-5, 5, (PLANES, 3))
    points, tau, labels = [], [], np.tile(np.repeat(np.arange(PLANES), EACH), scan_count)
    world = []
    for scan in range(scan_count):
        flat = (
            rng.uniform(-1, 1, (PLANES * EACH, 3)) * [0, 1, 1] + rng.normal(size=(PLANES * EACH, 3)) * noise
        )
        on = center[labels[: PLANES * EACH]] + np.einsum("nij,nj->ni", axes[labels[: PLANES * EACH]], flat)
        when = rng.uniform(-0.1, 0, len(on))
        true = geometry.transform_points(geometry.inverse(poses[scan]), on)
        for amount, tangent in ((part * when, twist[scan]), (when**2 / SWEEP, grows[scan])):
            back = geometry.exp(-amount[:, None] * tangent)
            true = np.einsum("nij,nj->ni", back[:, :3, :3], true) + back[:, :3, 3]
        points.append(true)
        tau.append(when)
        world.append(geometry.transform_points(poses[scan], points[-1]))
    count = np.full(PLANES, scan_count * EACH)
    planes = Planes(
        center=center,
        normal=axes[:, :, 0],
        eigenvalues=np.tile([1e-4, 0.3, 0.3], (PLANES, 1)),
        axes=axes,
        count=count,
        scans=np.full(PLANES, scan_count, np.int32),
        size=np.ones(PLANES),
        sigma_offset=np.full(PLANES, 1e-3),
        unevenness=np.zeros(PLANES),
    )
    scans = gather(points)
    points_world = np.concatenate(world).astype(np.float32)
    labels = PlanePoints(points_world, labels.astype(np.int32), scans.offsets)
    return View.of(scans, poses, planes, labels), np.concatenate(tau), twist


def least_squares(view, tau, twist, rough, taken_out):
    """The same from one dense system of poses, planes and the parts, point by point; what was taken out is put back."""
    parts, rows, distances = [*scan_motion.motions(twist, rough), taken_out], [], []
    count = len(parts)
    for scan in range(SCANS):
        pose = view.world_from_scan[scan]
        for index in range(view.scans.offsets[scan], view.scans.offsets[scan + 1]):
            plane, point = view.labels.plane[index], view.scans.points[index].astype(float)
            normal, center, scale = view.planes.normal[plane], view.planes.center[plane], 100.0
            local = pose[:3, :3].T @ normal
            distance = normal @ (pose[:3, :3] @ point + pose[:3, 3] - center)
            cosine = local @ point / np.linalg.norm(point)
            met = point - distance * point / np.linalg.norm(point) / (
                np.sign(cosine) * max(abs(cosine), scan_evidence._GRAZING)
            )
            by_pose = np.concatenate([np.cross(met, local), local])
            across = view.planes.axes[plane][:, 1:].T @ (pose[:3, :3] @ met + pose[:3, 3] - center)
            row = np.zeros(6 * SCANS + 3 * PLANES + count)
            row[6 * scan : 6 * scan + 6] = by_pose
            row[6 * SCANS + 3 * plane :][:3] = [1.0, *across]
            row[-count:] = [tau[index] * by_pose @ part[scan] for part in parts]
            rows.append(scale * row)
            distances.append(scale * distance)
    poses = np.tile(1 / scan_evidence.POSE_SIGMA, SCANS)
    prior = np.diag(np.concatenate([poses, np.zeros(3 * PLANES + count)]))
    rows, distances = np.array(rows), np.array(distances)
    normal = rows.T @ rows + prior**2
    follow = -np.linalg.solve(normal[:-count, :-count], normal[:-count, -count:])
    turned = rows @ np.concatenate([follow, np.eye(count)])
    back = rows[:, :-1].T @ (distances - rows[:, -1])
    change = np.append(-np.linalg.solve(normal[:-1, :-1], back)[1 - count :], -1.0)
    # planes follow, poses stay: gradients of planes are of the poses so far
    at = rows[:, 6 * SCANS : 6 * SCANS + 3 * PLANES]
    away = distances - at @ np.linalg.lstsq(at, distances, rcond=None)[0]
    pulls = turned[:, :-1] * (away + turned @ change)[:, None]
    own = np.stack([np.bincount(view.labels.plane, pull, PLANES) for pull in pulls.T], axis=1)
    there = own @ np.linalg.inv(normal[:-1, :-1])[1 - count :, 1 - count :]
    return change[:-1], np.sqrt((there**2).sum(axis=0))


def alone(view, tau, twist):
    """What is known of the fraction of the whole motion, if scans were not deskewed by rough poses."""
    return scan_motion.evidence(view, tau, twist, twist, 0 * twist).of(slice(0, 1))


@pytest.mark.parametrize("seed", [0, 1])
def test_evidence_is_that_of_all_unknowns_together(seed):
    view, tau, twist = made(0.3, seed)
    rng = np.random.default_rng(seed)
    rough, taken_out = twist + rng.normal(0, 0.2, twist.shape), rng.normal(0, 0.1, twist.shape)
    scene = view, tau, twist, rough, taken_out
    seen = scan_motion.evidence(*scene)
    change, sigma = least_squares(*scene)
    np.testing.assert_allclose(seen.change, change, rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(seen.sigma, sigma, rtol=2e-3)
    assert alone(view, tau, twist).change[0] == pytest.approx(0.3, rel=0.05)


def test_what_was_taken_out_already_counts():
    """All at once, or half of it and the other half again."""
    view, tau, twist = made(0.3)
    seen = scan_motion.evidence(view, tau, twist, twist, -0.2 * twist).of(slice(0, 1))
    assert seen.change[0] == pytest.approx(alone(view, tau, twist).change[0] - 0.2)


def test_nothing_left_is_found_within_its_deviation():
    changes = [alone(*made(0.0, seed, noise=0.01)) for seed in range(20)]
    normalized = np.array([each.change[0] / each.sigma[0] for each in changes])
    assert 0.5 < np.sqrt(np.mean(normalized**2)) < 1.7
    together = sum(changes[1:], changes[0])
    assert abs(together.change[0]) < 3.5 * together.sigma[0]


def test_how_far_points_are_from_planes_is_their_mean_one_by_one():
    view, _, _ = made(1.0, noise=0.02)
    plane = view.labels.plane.copy()
    plane[::7] = -1
    view = replace(view, labels=replace(view.labels, plane=plane))
    squares = []
    for scan in range(SCANS):
        for index in range(view.scans.offsets[scan], view.scans.offsets[scan + 1]):
            world = geometry.transform_points(
                view.world_from_scan[scan], view.scans.points[index].astype(float)
            )
            away = view.planes.normal[plane[index]] @ (world - view.planes.center[plane[index]])
            squares.append(9.0 if plane[index] < 0 else min((away / 0.03) ** 2, 9.0))
    assert view.thickness == pytest.approx(0.01)
    assert view.away(0.03) == pytest.approx(np.mean(squares), rel=1e-9)
    assert min(squares) < 1 < max(squares)


def test_no_planes_no_evidence():
    view, tau, twist = made(0.3)
    none = replace(view.labels, plane=np.full_like(view.labels.plane, -1))
    assert alone(replace(view, labels=none), tau, twist).sigma[0] == np.inf
    still = alone(view, tau, 0 * twist)
    assert still.change[0] == 0
    assert still.sigma[0] == np.inf


def test_scans_that_move_as_no_path_says_tell_it_themselves():
    """Points that were moved by the wrong motion: each scan's own is found; noise is drawn to zero."""
    view, tau, twist = made(1.0, scan_count=12)
    found, _ = scan_motion.most_likely(scan_motion.deviations(view, tau, SWEEP))
    np.testing.assert_allclose(found[:, :6], twist, atol=0.1)
    assert not found[:, 6:].any(), "steady motions explain all"
    view, tau, _ = made(0.0, noise=0.01, scan_count=12)
    known = scan_motion.deviations(view, tau, SWEEP)
    alone = np.linalg.solve(known.information[0], known.gradient[0][..., None])[..., 0]
    assert np.abs(scan_motion.most_likely(known)[0]).mean() < 0.5 * np.abs(alone).mean()
    assert not any(each.any() for each in scan_motion.most_likely(scan_motion.Deviations.unseen(12)))


def test_a_scan_of_which_the_path_tells_less_tells_more_itself():
    """Beside scans that move as the path says, whose points are left as they are."""
    (view, tau, _), (moving, its_tau, twist) = (made(part, noise=2e-3, scan_count=12) for part in (0.0, 1.0))
    known, other = scan_motion.deviations(view, tau, SWEEP), scan_motion.deviations(moving, its_tau, SWEEP)
    for mine, its in zip(
        (known.information, known.gradient), (other.information, other.gradient), strict=True
    ):
        mine[:, 0] = its[:, 0]
    wider = np.zeros((12, 2))
    wider[0] = 0.3, 1.5
    found, covariance = scan_motion.most_likely(known, wider)
    assert np.linalg.norm(found[0, :6] - twist[0]) < 0.4 * np.linalg.norm(twist[0])
    assert np.linalg.norm(found[1:, :6], axis=1).max() < 0.2 * np.linalg.norm(twist[0])
    assert not np.linalg.norm(scan_motion.most_likely(known)[0][0]) > 0.1 * np.linalg.norm(twist[0])
    error = known.by_motion[0][:, :6] @ (found[0, :6] - twist[0])
    assert error @ np.linalg.solve(covariance[0], error) / 6 < 4


def test_a_scan_that_moves_far_from_the_path_may_have_changed_its_motion_during_the_sweep():
    view, tau, twist = made(1.0, noise=2e-3, scan_count=12)
    known = scan_motion.deviations(view, tau, SWEEP)
    near, narrow = np.zeros((12, 2)), np.zeros((12, 2))
    near[0], narrow[0] = 10 * np.abs(twist[0]).max(), 0.3 * np.abs(twist[0]).max()
    as_expected, beyond = (
        scan_motion.most_likely(replace(known, gradient=known.gradient * only_first(12)), wider)[1][0]
        for wider in (near, narrow)
    )
    growth = known.by_motion[0][:, 6:]
    assert (
        np.trace(beyond - as_expected) > 0.3 * np.abs(twist[0]).max() ** 2 * np.trace(growth @ growth.T) / 6
    )


def only_first(count):
    """(1, count, 1): of deviations, those of the first scan."""
    return (np.arange(count) == 0)[None, :, None]


def test_poses_are_as_uncertain_as_the_motion_that_was_taken_out():
    """A scan whose points were moved by a motion that is a little off is turned and shifted by half a sweep of it."""
    seen, errors, promised = [], [], []
    for seed in range(3):
        view, tau, twist = made(1.0, seed, noise=0.01, scan_count=16)
        known = scan_motion.deviations(view, tau, SWEEP)
        found, covariance = scan_motion.most_likely(known)
        seen.append(known.by_motion)
        assert not found[:, 6:].any()
        errors.append(np.einsum("sij,sj->si", known.steady.by_motion, found[:, :6] - twist))
        promised.append(covariance)
    # tau is spread evenly over -0.1 s to 0: poses follow the motion backwards at its mean
    mean = np.mean(np.concatenate(seen), axis=0)
    np.testing.assert_allclose(mean[:, :6], 0.05 * np.eye(6), atol=0.01)
    np.testing.assert_allclose(mean[:, 6:], -SWEEP / 3 * np.eye(6), atol=0.01)
    error, covariance = np.concatenate(errors), np.concatenate(promised)
    nees = np.einsum("si,si->s", error, np.linalg.solve(covariance, error[..., None])[..., 0]).mean() / 6
    assert 0.4 < nees < 2.5


def test_a_motion_that_grows_during_a_sweep_is_taken_out_of_it():
    """Beside a steady one it would leave poses off by a sixth of its growth over the sweep."""
    view, tau, twist = made(1.0, noise=1e-3, scan_count=40, growth=0.6)
    grows = 0.6 * np.random.default_rng([0, 1]).normal(size=(40, 6))
    known = scan_motion.deviations(view, tau, SWEEP)
    found, covariance = scan_motion.most_likely(known)
    np.testing.assert_allclose(found[:, 6:9], grows[:, :3], atol=0.3)
    off = found - np.concatenate([twist, grows], axis=1)
    error = np.einsum("sij,sj->si", known.by_motion, off)
    steady = np.concatenate([known.steady.information[0], known.steady.gradient[0][..., None]], axis=2)
    alone = np.linalg.solve(steady[..., :6], steady[..., 6:])[..., 0] - twist
    left = known.by_motion @ np.concatenate([alone, -grows], axis=1)[..., None]
    assert np.sqrt(np.mean(error**2)) < 0.4 * np.sqrt(np.mean(left**2))
    nees = np.einsum("si,si->s", error, np.linalg.solve(covariance, error[..., None])[..., 0]).mean() / 6
    assert nees < 4


def test_deviations_taken_out_of_points_count_with_what_is_left():
    view, tau, twist = made(1.0, noise=1e-3, scan_count=6, growth=0.2)
    known = scan_motion.deviations(view, tau, SWEEP)
    half = np.concatenate([0.5 * twist, np.zeros_like(twist)], axis=1)
    there = known.beside(half)
    change = np.linalg.solve(known.information[0], known.gradient[0][..., None])[..., 0]
    whole = np.linalg.solve(there.information[0], there.gradient[0][..., None])[..., 0]
    np.testing.assert_allclose(whole, change + half, atol=1e-6)


def test_halves_of_the_planes_are_what_all_of_them_are():
    view, tau, _ = made(0.4, noise=0.01)
    known = scan_motion.deviations(view, tau, SWEEP)
    weak = scan_evidence.POSE_SIGMA * 1e6
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scan_motion, "POSE_SIGMA", weak)
        free = scan_motion.deviations(view, tau, SWEEP)
    assert (np.linalg.eigvalsh(known.information[0] - free.information[0]) > -1e-6).all(), (
        "poses that may move less"
    )
    for scan in range(SCANS):
        points = view.labels.plane[view.scans.offsets[scan] : view.scans.offsets[scan + 1]]
        half = scan_motion._halves(np.sort(points))
        assert set(half) == {0, 1}
        assert abs(np.mean(half) - 0.5) <= 0.5 / PLANES + 1e-9
        assert all(len(set(half[np.sort(points) == plane])) == 1 for plane in range(PLANES))


def test_errors_that_planes_do_not_share_are_no_motion():
    """Surfaces that are bent, as a depth camera bends them, look like motion; other planes of the scan contradict it."""
    motions = []
    for bend in (0.0, 0.02):
        view, tau, _ = made(0.0, noise=2e-3, scan_count=24)
        scans = np.repeat(np.arange(24), PLANES * EACH)
        rng = np.random.default_rng(3)
        slope = rng.normal(0, bend, (24, PLANES))[scans, view.labels.plane] * (tau + 0.05) / 0.05
        pose, plane = view.world_from_scan[scans], view.labels.plane
        normal = np.einsum("nij,ni->nj", pose[:, :3, :3], view.planes.normal[plane])
        bent = (view.scans.points + slope[:, None] * normal).astype(np.float32)
        bent_view = replace(view, scans=replace(view.scans, points=bent))
        known = scan_motion.deviations(bent_view, tau, SWEEP)
        sure, _ = scan_motion._drawn_to_zero(known.steady.information[0], known.steady.gradient[0])
        motions.append([np.abs(each).mean() for each in (scan_motion.most_likely(known)[0][:, :6], sure)])
    clean, there = motions
    assert clean[0] < 0.02
    assert there[1] > 0.1, "as if points were independent"
    assert there[0] < 0.3 * there[1]


def test_points_move_as_the_sensor_did():
    rng = np.random.default_rng(0)
    points, tau = rng.uniform(-30, 30, (50, 3)).astype(np.float32), rng.uniform(-0.1, 0.0, 50)
    motion = np.array([0.3, -0.5, 0.4, 2.0, 1.0, -3.0])
    expected = geometry.exp(tau[:, None] * motion)
    exact = np.einsum("nij,nj->ni", expected[:, :3, :3], points) + expected[:, :3, 3]
    np.testing.assert_allclose(scan_motion.moved(points, tau, motion), exact, atol=1e-5)
    growing = np.array([3.0, 2.0, -4.0, 5.0, -3.0, 1.0])
    first = geometry.exp(0.5 * tau[:, None] ** 2 * growing)
    bent = np.einsum("nij,nj->ni", first[:, :3, :3], points) + first[:, :3, 3]
    exact = np.einsum("nij,nj->ni", expected[:, :3, :3], bent) + expected[:, :3, 3]
    np.testing.assert_allclose(scan_motion.moved(points, tau, motion, growing), exact, atol=1e-5)


def test_facts_bring_it_back():
    clock = PointClock(1e-6, 0.1, -0.1, True)
    motion = MotionLeft(
        clock=clock,
        fraction=0.5,
        sigma=1e-3,
        motion=np.arange(12.0).reshape(2, 6),
        acceleration=np.ones((2, 6)),
    )
    facts = {
        "clock": {"unit": 1e-6, "sweep": 0.1, "begin": -0.1, "absolute": True},
        "fraction": 0.5,
        "sigma": 1e-3,
        "motion": motion.motion.tolist(),
        "acceleration": motion.acceleration.tolist(),
    }
    found = MotionLeft.of_facts(facts)
    assert found is not None
    assert found.clock == motion.clock
    np.testing.assert_array_equal(found.motion, motion.motion)
    np.testing.assert_array_equal(found.acceleration, motion.acceleration)
    assert MotionLeft.of_facts(facts | {"acceleration": [[0.0] * 6]}) is None, "of another count"
    older = MotionLeft.of_facts({name: value for name, value in facts.items() if name != "acceleration"})
    assert older is not None
    assert not older.acceleration.size, "results of 0.2 have none"
    named = {"part" if name == "fraction" else name: value for name, value in facts.items()}
    assert MotionLeft.of_facts(named).fraction == 0.5, "as results before 0.3 have it"
    assert MotionLeft.of_facts({"motion": []}) is None
    assert MotionLeft.of_facts(None) is None
