"""Times by the rows of depth images: found by the order of points, for any way that the camera is mounted."""

import numpy as np
import pytest

from lvba import geometry
from lvba.lidar import row_times
from lvba.lidar.range_errors import Beams
from lvba.simulate import lidar

READOUT = 0.02


def scans(pattern="depth_camera", count=5000, holes=0.2):
    """Points of some scans, sensor frame, in the order of the beams; with parts that nothing came back from."""
    rng = np.random.default_rng(2)
    made = []
    for _ in range(6):
        beams = lidar.PATTERNS[pattern](count, rng)
        seen = np.ones(len(beams), bool)
        seen[: int(holes * rng.uniform() * len(beams))] = False
        made.append(beams[seen] * rng.uniform(1, 4, (seen.sum(), 1)))
    return made


def clock_of(points, axes, position=(0.0, 0.0, 0.0)):
    return row_times.find_rows(points, Beams.of(points, np.array(position), axes), axes)


@pytest.mark.parametrize("turn", [[0, 0, 0], [-np.pi / 2, 0, -np.pi / 2], [0.3, -0.2, 0.5], [0, 0, np.pi]])
def test_rows_have_their_times_however_the_camera_is_mounted(turn):
    mounting = geometry.exp(np.array([*turn, 0.1, -0.2, 0.3]))
    points = scans()
    placed = [geometry.transform_points(mounting, each) for each in points]
    clock = clock_of(placed, mounting[:3, :3], mounting[:3, 3])
    assert clock is not None
    np.testing.assert_allclose(clock.down, mounting[:3, :3] @ [0, 0, -1], atol=1e-9)
    directions = points[0] / np.linalg.norm(points[0], axis=1, keepdims=True)
    expected = lidar.row_times(directions, clock.sweep)
    given = clock.from_stamp(placed[0], None, 1e9)
    inside = np.abs(expected) < 0.48 * clock.sweep
    np.testing.assert_allclose(given[inside], expected[inside], atol=0.02 * clock.sweep)
    assert clock.begin == -clock.sweep / 2


def test_a_camera_upside_down_reads_its_first_row_first():
    points = [each[::-1] for each in scans()]
    clock = clock_of(points, np.eye(3))
    np.testing.assert_allclose(clock.down, [0, 0, 1], atol=1e-9)


def test_columns_are_rows_of_a_camera_on_its_side():
    rng = np.random.default_rng(0)
    points = [each[np.argsort(each[:, 1] / each[:, 0], kind="stable")] for each in scans()]
    assert abs(clock_of(points, np.eye(3)).down @ [0, 1, 0]) > 0.99
    shuffled = [rng.permutation(each) for each in points]
    assert clock_of(shuffled, np.eye(3)) is None


@pytest.mark.parametrize("pattern", ["spinning", "non_repetitive"])
def test_other_patterns_have_no_rows(pattern):
    assert clock_of(scans(pattern), np.eye(3)) is None


def test_points_behind_and_few_points_have_no_time():
    clock = clock_of(scans(), np.eye(3))
    assert not clock.from_stamp(np.array([[-1.0, 0, 0.3], [0, 0, 0]]), None, 0.0).any()
    assert clock_of([each[:50] for each in scans()], np.eye(3)) is None
    assert clock_of([], np.eye(3)) is None
