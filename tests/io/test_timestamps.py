import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_recording import START, walk

from lvba import geometry
from lvba.errors import InputError
from lvba.io import timestamps
from lvba.trajectory import Trajectory


@pytest.mark.parametrize(
    ("name", "time"),
    [
        ("1630577758.569490.pcd", 1630577758.569490),
        ("311.100000.jpg", 311.1),
        ("12.5.png", 12.5),
        ("0.pcd", 0.0),
        ("000123.bin", 123.0),
        ("cam0_1630577758.569490.png", 1630577758.569490),
        ("cam0_000123.png", 123.0),
        ("frame-17.png", 17.0),
        ("1630577758_569490000.png", 1630577758.569490),
        ("1630577758-569490.png", 1630577758.569490),
        ("1630577758569490000.pcd", 1630577758.569490),
        ("1630577758569490.pcd", 1630577758.569490),
        ("1630577758569.pcd", 1630577758.569),
        ("scan.pcd", None),
        (".pcd", None),
        ("９.pcd", None),
        ("9" * 240 + ".pcd", None),
        ("1e400.pcd", 400.0),
    ],
)
def test_times_in_names(name: str, time: float | None):
    found = timestamps.from_name(name)
    assert found is None if time is None else found == pytest.approx(time, abs=1e-6)


TICKS = st.lists(st.integers(0, 20) | st.integers(0, 3000), min_size=1, max_size=12, unique=True)


@given(TICKS, TICKS)
@settings(deadline=None, max_examples=200, derandomize=True)
def test_each_file_has_the_pose_that_a_plain_loop_finds(file_ticks: list[int], pose_ticks: list[int]):
    tick = 0.7e-3  # no multiple is on the edge of a tolerance
    times, pose_times = START + tick * np.sort(file_ticks), START + tick * np.sort(pose_ticks)
    rough = Trajectory(pose_times, walk(pose_times))
    expected: dict[int, tuple[float, np.ndarray]] = {}
    taken: set[int] = set()
    for index, time in enumerate(times):
        near = int(np.abs(pose_times - time).argmin())
        before, after = pose_times[pose_times <= time], pose_times[pose_times > time]
        if abs(pose_times[near] - time) < timestamps.SAME_TIME:
            if near not in taken:
                taken.add(near)
                expected[index] = (pose_times[near], rough.world_from_sensor[near])
        elif len(before) and len(after) and after[0] - before[-1] < timestamps.MAX_GAP:
            fraction = (time - before[-1]) / (after[0] - before[-1])
            first, second = walk(before[-1:])[0], walk(after[:1])[0]
            expected[index] = (time, geometry.interpolate(first, second, np.array(fraction)))
    if not expected:
        with pytest.raises(InputError, match="another clock"):
            timestamps.match(times, rough, "poses.txt")
        return
    found = timestamps.match(times, rough, "poses.txt")
    assert sorted(found.files.tolist()) == sorted(expected)
    assert (np.diff(found.poses.times) > 0).all()
    for row, index in enumerate(found.files):
        np.testing.assert_allclose(found.poses.times[row], expected[int(index)][0], atol=1e-9)
        np.testing.assert_allclose(found.poses.world_from_sensor[row], expected[int(index)][1], atol=1e-6)


def test_poses_in_another_unit_are_told():
    times = START + np.arange(5) / 10
    for unit, factor in (("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9)):
        with pytest.raises(InputError, match=f"seem to be in {unit}: write seconds"):
            timestamps.match(times, Trajectory(times * factor, walk(times)), "poses.txt")


@pytest.mark.parametrize(
    ("name", "pose", "written"),
    [
        ("1305031229.664657123", "1305031229.664657123", "1305031229.664657123"),
        ("1305031229.664657123", "1305031229.664657", "1305031229.664657123"),
        ("1305031229.664657987", "1305031229.664658", "1305031229.664657987"),
        (
            "1305031229.664657123",
            "1305031229.6646571",
            "1305031229.664657123",
        ),  # the shortest text of the float
        (
            "1305031229.664657123",
            "1305031229.664657116",
            "1305031229.664657123",
        ),  # the float to nine decimals
        ("1305031229.6647", "1305031229.664657", "1305031229.664657"),
        (
            "1305031229.664657",
            "1305031229.664657115936279297",
            "1305031229.664657",
        ),  # a float printed too long
        ("1305031229.664657", "1305031229.665100", "1305031229.665100"),  # another time, within 2 ms
        ("1305031229.664657123", "", "1305031229.664657123"),
        ("", "12.5", "12.5"),
        ("5", "5.000000", "5"),
    ],
)
def test_times_have_the_digits_of_names(name, pose, written):
    assert timestamps.merged(name, pose) == written


def test_names_in_units_are_exact_decimal_seconds():
    assert timestamps.stamp("1305031229664657123.png") == "1305031229.664657123"
    assert timestamps.stamp("1305031229_664657123.png") == "1305031229.664657123"
    assert timestamps.stamp("1305031229664657.png") == "1305031229.664657"
    assert timestamps.stamp("1305031229664.png") == "1305031229.664"
    assert timestamps.stamp("12.pcd") == "12"
