"""Points that move: scans before and after see through them."""

import naive_moving_points as naive
import numpy as np
import pytest

from lvba import geometry
from lvba.kernels import range_images
from lvba.lidar import moving_points

HALF = np.array([6.0, 5.0, 3.0])
RADIUS_M = 0.5
SCANS, RATE_HZ = 60, 5.0
TIMES = np.arange(SCANS) / RATE_HZ
SENSOR = np.array([0.1, -0.2, 0.3])


def directions(count, rng):
    """Unit directions (count, 3) all over the sphere."""
    drawn = rng.normal(size=(count, 3))
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def meet_room(origin, rays):
    """Distances to the walls of a room."""
    with np.errstate(divide="ignore"):
        return (np.where(rays > 0, HALF - origin, -HALF - origin) / rays).min(1)


def meet_ball(origin, rays, center):
    """Distances to a ball, inf where it is not met."""
    along = rays @ (center - origin)
    short = along**2 - ((center - origin) ** 2).sum() + RADIUS_M**2
    with np.errstate(invalid="ignore"):
        return np.where((short > 0) & (along > 0), along - np.sqrt(short), np.inf)


class Room:
    """Scans of a room with a ball, the true poses, and which points are the ball's. path: where the ball is (SCANS, 3)"""

    def __init__(self, path, beams=16000):
        rng = np.random.default_rng(0)
        tangents = np.zeros((SCANS, 6))
        tangents[:, 2] = 0.8 * np.sin(TIMES)
        tangents[:, 3] = -2 + 0.2 * TIMES
        self.poses, self.scans, self.on_ball = geometry.exp(tangents), [], []
        for pose, center in zip(self.poses, path, strict=True):
            rays, sensor = directions(beams, rng), geometry.transform_points(pose, SENSOR[None])[0]
            world = rays @ pose[:3, :3].T
            ball, wall = meet_ball(sensor, world, center), meet_room(sensor, world)
            noise = rng.normal(0, 0.02, beams)
            self.scans.append((SENSOR + (np.minimum(ball, wall) + noise)[:, None] * rays).astype(np.float32))
            self.on_ball.append(ball < wall)

    def moving(self, *poses):
        every = range(SCANS)
        return moving_points.moving_points(
            lambda scan: self.scans[scan], poses or (self.poses,), TIMES, SENSOR, every
        )


@pytest.fixture(scope="module")
def walking():
    """The ball goes through the room at 1 m/s."""
    return Room(np.stack([np.full(SCANS, 2.5), TIMES - 5, np.zeros(SCANS)], 1))


def test_kernels_do_as_their_plain_twins():
    rng = np.random.default_rng(1)
    ranges = np.where(rng.random(2400) < 0.1, 2.0, 6.0) + rng.normal(0, 0.2, 2400)
    points = (directions(2400, rng) * ranges[:, None]).astype(np.float32)
    points[:3] = [[0, 0, 0], [np.inf, 0, 0], [2, 2, 2]]
    images = np.stack([range_images.range_image(points[k::4], 12) for k in range(4)])
    for k in range(4):
        np.testing.assert_array_equal(images[k], naive.range_image(points[k::4], 12))
    poses = geometry.exp(rng.normal(0, 0.05, (4, 6)))[:, :3].astype(np.float32)
    seen = range_images.seen_through(points[3:], images, poses)
    np.testing.assert_array_equal(seen, naive.seen_through(points[3:], images, poses))
    assert 10 < seen.sum() < 500


def test_what_walks_through_a_room_is_seen_and_the_room_is_not(walking):
    moving, ball = (np.concatenate(of) for of in (walking.moving(), walking.on_ball))
    assert ball.sum() > 1000
    assert moving[ball].mean() > 0.8
    assert moving[~ball].mean() < 2e-3


def test_what_stands_in_a_room_does_not_move():
    standing = Room(np.tile([2.5, 1.0, 0.0], (SCANS, 1)))
    moving, ball = (np.concatenate(of) for of in (standing.moving(), standing.on_ball))
    assert ball.sum() > 2000
    assert moving.mean() < 1e-4


def test_of_a_scan_that_fits_no_other_nothing_is_said(walking):
    """Others see through most of it, and it is the scan that is wrong."""
    scans = list(walking.scans)
    scans[30] = (SENSOR + 0.5 * (scans[30] - SENSOR)).astype(np.float32)
    moving = moving_points.moving_points(scans.__getitem__, [walking.poses], TIMES, SENSOR, range(25, 35))
    assert [bool(each.any()) for each in moving] == [number != 30 for number in range(25, 35)]


def test_a_point_counts_at_all_poses_alike(walking):
    wrong = walking.poses.copy()
    wrong[30:, :3, 3] += [0.0, 0.0, 0.6]
    alone, both = walking.moving(), walking.moving(walking.poses, wrong)
    assert all((b <= a).all() for a, b in zip(alone, both, strict=True))
    assert np.concatenate(both).sum() > 0


def test_scans_a_few_seconds_off_look_each_once():
    assert moving_points.looking(TIMES, 30) == [20, 40, 10, 50, 25, 35, 15, 45, 27, 32]
    assert moving_points.looking(TIMES, 2) == [12, 22, 7, 17, 4]
    slow = np.array([0.0, 3.0, 6.0])
    assert moving_points.looking(slow, 1) == [0, 2]
    assert moving_points.looking(slow[:1], 0) == []


def test_a_scan_that_nobody_looks_at_keeps_all_its_points():
    scan = np.ones((5, 3), np.float32)
    [mask] = moving_points.moving_points(
        lambda _: scan, [np.eye(4)[None]], np.zeros(1), np.zeros(3), range(1)
    )
    assert not mask.any()
    no_points = moving_points.moving_points(
        lambda _: scan[:0], [np.tile(np.eye(4), (3, 1, 1))], np.arange(3.0), np.zeros(3), range(3)
    )
    assert [len(each) for each in no_points] == [0, 0, 0]


def test_cells_are_twice_as_wide_as_points_are_apart():
    rng = np.random.default_rng(2)
    for count in (100_000, 200_000):
        spacing = np.sqrt(4 * np.pi / count)
        cells = moving_points.cells_of_face([directions(count, rng)])
        assert np.sqrt(4 * np.pi / (6 * cells**2)) == pytest.approx(2 * spacing, rel=0.1)
    # not narrower than poses are good for, not wider than a person
    assert moving_points.cells_of_face([directions(2_000_000, rng)]) == 208
    assert moving_points.cells_of_face([directions(100, rng)]) == 56
