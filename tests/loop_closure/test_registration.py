"""Places seen twice are found and aligned; places that only look alike are refused."""

import numpy as np
import place_world
import plane_world
import pytest
from place_world import along, candidate, part

from lvba import geometry
from lvba.loop_closure import candidates, registration
from lvba.loop_closure.candidates import CandidateConfig
from lvba.loop_closure.registration import RegisterConfig

MOVED = [0.05, 0.02, 0.6, 3.0, -2.0, 1.0]
"""The later part's own world frame."""


def error(loop, poses, others):
    """mm and degrees, of a loop between scans of two parts."""
    truth = geometry.inverse(poses[loop.first_scan]) @ others[loop.second_scan - 1000]
    off = geometry.inverse(truth) @ loop.first_from_second
    return 1e3 * np.linalg.norm(off[:3, 3]), float(geometry.rotation_angle_deg(off))


@pytest.fixture(scope="module")
def yard():
    poses = plane_world.path("courtyard", 40)
    first, second = poses[:8], poses[34:]
    world = plane_world.courtyard()
    return first, second, part(world, first, 0), part(world, second, 1000, seed=5, moved_by=MOVED)


@pytest.fixture(scope="module")
def rooms():
    poses = plane_world.path("rooms", 60)
    first, second = poses[:10], poses[14:24]
    world = plane_world.rooms()
    return first, second, part(world, first, 0), part(world, second, 1000, seed=5, moved_by=MOVED)


@pytest.mark.parametrize(
    "off", [[0] * 6, [0.02, -0.02, 0.04, 1.0, 0.8, -0.3], [0.0, 0.02, -0.04, -1.1, 0.9, 0.4]]
)
def test_ends_that_miss_each_other_by_more_than_a_meter_are_brought_together(yard, off):
    first, second, a, b = yard
    loop = registration.register(a, b, candidate(first, second, 2, 3, off))
    assert loop.accepted, loop.reason
    meters, degrees = error(loop, first, second)
    assert meters < 4
    assert degrees < 0.03
    assert loop.open_directions == 0
    assert loop.overlap > 0.5


def test_rooms_are_found_too(rooms):
    first, second, a, b = rooms
    loop = registration.register(a, b, candidate(first, second, 8, 0, [0.02, -0.02, 0.04, 0.7, 0.5, -0.3]))
    assert loop.accepted, loop.reason
    meters, degrees = error(loop, first, second)
    assert meters < 8
    assert degrees < 0.15


def test_certainty_of_a_loop_is_honest_and_holds_that_of_its_scans(yard):
    first, second, a, b = yard
    loop = registration.register(a, b, candidate(first, second, 2, 3))
    truth = geometry.inverse(first[2]) @ second[3]
    off = geometry.log(geometry.inverse(truth) @ loop.first_from_second)
    assert off @ loop.information @ off < 22.5
    doubt = part(plane_world.courtyard(), first, 0, covariance=1e-4)
    unsure = registration.register(doubt, b, candidate(first, second, 2, 3))
    assert np.linalg.eigvalsh(loop.information - unsure.information).min() > 0
    assert np.linalg.inv(unsure.information)[3, 3] > 1e-4


def test_another_yard_of_the_same_shape_is_refused(yard):
    first, second, a, _ = yard
    other = part(plane_world.courtyard(seed=7), second, 1000, seed=5, moved_by=MOVED)
    loop = registration.register(a, other, candidate(first, second, 2, 3))
    assert not loop.accepted
    assert "seen through" in loop.reason
    np.testing.assert_array_equal(loop.information, 0)


def test_the_room_behind_the_wall_is_refused():
    poses = plane_world.path("rooms", 60)
    first, second = poses[2:8], poses[26:32]
    world = plane_world.rooms()
    a, b = part(world, first, 0), part(world, second, 1000, seed=5)
    off = np.zeros(6)
    off[3:] = -(geometry.inverse(first[5]) @ second[1])[:3, 3]
    loop = registration.register(a, b, candidate(first, second, 5, 1, off, sigma_m=1.5))
    assert not loop.accepted


def test_beyond_what_the_odometry_may_be_off_nothing_is_believed(yard):
    first, second, a, b = yard
    loop = registration.register(a, b, candidate(first, second, 2, 3, [0, 0, 0, 2.0, 0, 0], sigma_m=0.5))
    assert not loop.accepted
    assert "may be off" in loop.reason


def test_a_corridor_is_measured_across_and_left_open_along():
    world = place_world.corridor()
    first, second = along([0, 0, 1.5], [6, 0, 1.5], 8), along([3, 0.2, 1.4], [9, 0.1, 1.5], 8)
    a, b = part(world, first, 0), part(world, second, 1000, seed=5, moved_by=MOVED)
    loop = registration.register(a, b, candidate(first, second, 4, 2, [0.01, 0.01, 0.02, 0.5, 0.3, 0.1]))
    assert loop.accepted, loop.reason
    assert loop.open_directions == 1
    values, vectors = np.linalg.eigh(loop.information)
    assert values[0] == pytest.approx(0.0, abs=1e-6 * values[-1])
    corridor_in_second = second[2][:3, :3].T @ [1.0, 0, 0]
    assert abs(vectors[3:, 0] @ corridor_in_second) > 0.99
    truth = geometry.inverse(first[4]) @ second[2]
    off = (geometry.inverse(truth) @ loop.first_from_second)[:3, 3]
    across = off - corridor_in_second * (off @ corridor_in_second)
    assert np.linalg.norm(across) < 0.03
    # where the odometry may be off by more, the next corridor could be meant
    unsure = registration.register(a, b, candidate(first, second, 4, 2, sigma_m=4.0))
    assert not unsure.accepted
    assert "looks alike" in unsure.reason


@pytest.fixture(scope="module")
def terrace():
    """Two walks through a street of houses that are all alike, with reliefs deep enough to be seen."""
    world = place_world.terrace(relief=1.5)
    first, second = along([50, 0, 1.7], [58, 0, 1.7], 8), along([53, 0.5, 1.7], [60, 0.2, 1.7], 8)
    return first, second, part(world, first, 0), part(world, second, 1000, seed=5, moved_by=MOVED)


def test_look_alike_houses_are_told_apart_while_the_odometry_does(terrace):
    first, second, a, b = terrace
    loop = registration.register(a, b, candidate(first, second, 4, 2, [0, 0, 0.02, 0.8, 0.3, 0.1]))
    assert loop.accepted, loop.reason
    assert loop.open_directions == 0
    assert error(loop, first, second)[0] < 20


@pytest.mark.parametrize("off", [0.0, 3.0, 5.8])
def test_a_false_closing_on_look_alike_houses_is_refused(terrace, off):
    first, second, a, b = terrace
    loop = registration.register(a, b, candidate(first, second, 4, 2, [0, 0, 0.02, off, 0.3, 0], sigma_m=4.0))
    assert not loop.accepted
    assert "looks like others" in loop.reason


def test_something_of_its_own_tells_look_alike_houses_apart():
    world = place_world.terrace(relief=1.5, ends=True)
    first, second = along([8, 0, 1.7], [16, 0, 1.7], 8), along([11, 0.5, 1.7], [18, 0.2, 1.7], 8)
    a, b = part(world, first, 0), part(world, second, 1000, seed=5, moved_by=MOVED)
    loop = registration.register(a, b, candidate(first, second, 4, 2, [0, 0, 0.02, 2.8, 0.3, 0], sigma_m=4.0))
    assert loop.accepted, loop.reason
    assert error(loop, first, second)[0] < 10


def test_too_little_in_common_is_refused():
    world = place_world.terrace()
    first, second = along([10, 0, 1.7], [16, 0, 1.7], 6), along([100, 0, 1.7], [106, 0, 1.7], 6)
    a, b = part(world, first, 0), part(world, second, 1000)
    config = RegisterConfig(radius=15.0)
    loop = registration.register(a, b, candidate(first, second, 3, 3, sigma_m=1.0), config)
    assert not loop.accepted


def ring(scans=120, radius=20.0, turns=1.0):
    angle = 2 * np.pi * turns * np.arange(scans) / scans
    xyz = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], -1)
    return geometry.from_rotation_translation(np.eye(3), xyz)


def parts_of(scans, size, overlap):
    return tuple(np.arange(k, min(k + size, scans)) for k in range(0, scans - overlap, size - overlap))


def test_candidates_are_parts_that_come_near_each_other_again():
    parts = parts_of(120, 24, 4)
    found = candidates.candidates(ring(), parts, CandidateConfig(reach=5.0))
    assert [(pair.first, pair.second) for pair in found] == [(0, 5)]
    pair = found[0]
    assert pair.first_scan == 0
    assert pair.second_scan == 119
    assert pair.distance == pytest.approx(2 * 20 * np.sin(np.pi / 120), rel=1e-6)
    assert pair.path == pytest.approx(119 * pair.distance, rel=1e-6)
    assert pair.sigma_m > 0.01 * pair.path


def test_the_drift_allowed_for_grows_with_the_path():
    poses, parts = ring(), parts_of(120, 24, 4)
    poses[100:, 0, 3] += 6.0
    near = CandidateConfig(reach=1.0, drift=0.0, drift_deg=0.0)
    assert candidates.candidates(poses, parts, near) == ()
    far = CandidateConfig(reach=1.0, drift=0.03, drift_deg=0.0)
    assert (0, 5) in [(pair.first, pair.second) for pair in candidates.candidates(poses, parts, far)]


def test_pairs_of_a_part_are_bounded():
    parts = parts_of(600, 24, 4)
    found = candidates.candidates(ring(600, turns=6.0), parts, CandidateConfig(pairs_per_part=3))
    assert 0 < max(np.bincount([pair.second for pair in found])) <= 3
    shared = [np.intersect1d(parts[pair.first], parts[pair.second]) for pair in found]
    assert all(len(scans) == 0 for scans in shared)
