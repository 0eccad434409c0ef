"""Poses that are meant in another way than they are read are noticed by the scans; rough and right ones are not."""

import numpy as np
import pytest

from lvba import geometry
from lvba.errors import InputError
from lvba.io import pose_readings
from lvba.io.pose_readings import INVERSE, W_FIRST, WORLD

RNG = np.random.default_rng(5)
SCANS, POINTS = 24, 4000


def _box(center: np.ndarray, size: np.ndarray, count: int) -> np.ndarray:
    """(count, 3): points on the sides of a box, m."""
    points = RNG.uniform(-0.5, 0.5, (count, 3))
    axis = RNG.integers(0, 3, count)
    points[np.arange(count), axis] = RNG.choice([-0.5, 0.5], count)
    return center + points * size


def _hall(length: float, furnished: bool) -> np.ndarray:
    """(N, 3): surfaces of a hall along x, with crates in it if it is furnished."""
    parts = [_box(np.array([length / 2, 0, 1.5]), np.array([length, 9.0, 3.0]), 60_000)]
    for k in range(int(length) if furnished else 0):
        where = np.array([1.0 * k, RNG.choice([-3.0, 3.2]) + RNG.normal(0, 0.3), 0.5])
        parts.append(_box(where, RNG.uniform(0.4, 1.2, 3), 1500))
    return np.concatenate(parts)


HALL, CORRIDOR = _hall(24.0, True), _hall(200.0, False)


def _path(count: int = SCANS, speed: float = 0.7, turn: float = 0.16) -> np.ndarray:
    """World from scan, (count, 4, 4): along a hall, turning meanwhile, from a start that is not the origin."""
    k = np.arange(count)
    start = geometry.exp(np.array([0.1, -0.05, 0.7, 3.0, -1.0, 1.2]))
    turned = geometry.exp(np.stack([0.03 * np.sin(k), 0 * k, turn * k, 0 * k, 0 * k, 0 * k], axis=1))
    poses = start @ turned
    poses[:, :3, 3] = start[:3, 3] + np.stack([speed * k, 0.8 * np.sin(0.5 * k), 0.1 * np.cos(k)], axis=1)
    return poses


def _scans(world_from_scan: np.ndarray, surfaces: np.ndarray) -> list[np.ndarray]:
    """Points (N, 3) of each scan, in its frame: dense where they are near, as rays have it."""
    scans = []
    for pose in world_from_scan:
        ranges = np.linalg.norm(surfaces - pose[:3, 3], axis=1)
        weights = np.where(ranges < 10, 1 / np.maximum(ranges, 0.5) ** 2, 0)
        seen = RNG.choice(len(surfaces), POINTS, p=weights / weights.sum())
        points = surfaces[seen] + RNG.normal(0, 0.01, (POINTS, 3))
        scans.append(geometry.transform_points(geometry.inverse(pose), points).astype(np.float32))
    return scans


def _rough(poses: np.ndarray, degrees: float, meters: float) -> np.ndarray:
    """Poses whose motions are off by so much from scan to scan, at random."""
    steps = geometry.steps(poses)
    noise = RNG.normal(0, 1, (len(steps), 6)) * np.repeat([np.radians(degrees), meters], 3)
    rough = [poses[0]]
    for step in steps @ geometry.exp(noise):
        rough.append(rough[-1] @ step)
    return np.array(rough)


def _written_w_first(poses: np.ndarray) -> np.ndarray:
    """What is read of quaternions that were written w first."""
    xyzw = geometry.quaternion(poses)
    return geometry.from_quaternion_translation(np.roll(xyzw, 1, axis=-1), poses[:, :3, 3])


PATH = _path()
SEEN = _scans(PATH, HALL)


@pytest.mark.parametrize(
    ("written", "expected"),
    [(_written_w_first, W_FIRST), (geometry.inverse, INVERSE), (lambda poses: poses, "")],
)
@pytest.mark.parametrize("off", [(0.0, 0.0), (0.4, 0.02)])
def test_scans_tell_how_poses_are_meant(written, expected: str, off):
    poses = written(_rough(PATH, *off))
    assert pose_readings.find(poses, SEEN.__getitem__) == expected


@pytest.mark.parametrize("off", [(0.0, 0.0), (0.4, 0.02)])
def test_scans_in_the_world_frame_are_noticed(off):
    poses = _rough(PATH, *off)
    in_world = [geometry.transform_points(pose, scan) for pose, scan in zip(PATH, SEEN, strict=True)]
    assert pose_readings.find(poses, in_world.__getitem__) == WORLD


@pytest.mark.parametrize("off", [(2.0, 0.1), (8.0, 0.5), (0.0, 2.0), (60.0, 0.0)])
def test_rough_poses_are_no_other_reading(off):
    assert pose_readings.find(_rough(PATH, *off), SEEN.__getitem__) == ""


@pytest.mark.parametrize("off", [(0.0, 0.0), (3.0, 0.1), (10.0, 0.3)])
@pytest.mark.parametrize("turn", [0.0, 0.16])
def test_a_corridor_that_looks_alike_everywhere_is_no_world_frame(off, turn: float):
    path = _path(turn=turn)
    path[:, 0, 3] += 90
    scans = _scans(path, CORRIDOR)
    assert pose_readings.find(_rough(path, *off), scans.__getitem__) == ""


@pytest.mark.parametrize("off", [(0.0, 0.0), (0.1, 0.01), (1.0, 1.0)])
def test_a_sensor_that_stands_still_is_no_world_frame(off):
    """Not even where the odometry moves by meters meanwhile."""
    still = np.repeat(PATH[:1], SCANS, axis=0)
    scans = _scans(still, HALL)
    assert pose_readings.find(_rough(still, *off), scans.__getitem__) == ""
    assert pose_readings.find(PATH, scans.__getitem__) == ""


def test_right_recordings_are_read_little():
    path = _path(600, speed=0.03, turn=0.16)
    read = []

    def load(index: int) -> np.ndarray:
        read.append(index)
        return _scans(path[index : index + 1], HALL)[0]

    assert pose_readings.find(path, load) == ""
    assert len(read) <= 12


def test_few_scans_and_few_points_say_nothing():
    assert pose_readings.find(geometry.inverse(PATH[:3]), SEEN.__getitem__) == ""
    assert pose_readings.find(geometry.inverse(PATH), lambda index: SEEN[index][:20]) == ""


def test_damaged_scans_are_errors():
    def load(index: int) -> np.ndarray:
        raise InputError("a.pcd", "truncated", "copy it again")

    with pytest.raises(InputError, match="truncated"):
        pose_readings.find(PATH, load)
