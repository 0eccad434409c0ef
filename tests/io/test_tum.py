from pathlib import Path

import numpy as np
import pytest
import small_recording
from hypothesis import given, settings
from hypothesis import strategies as st

from lvba import geometry
from lvba.errors import InputError
from lvba.io import exposures, tum
from lvba.io.exposures import Exposures
from lvba.trajectory import Trajectory


def _read(tmp_path: Path, text: str) -> tuple[Trajectory, tuple[str, ...]]:
    (tmp_path / "poses.txt").write_text(text)
    return tum.read_trajectory_and_warnings(tmp_path / "poses.txt")


@given(
    st.lists(st.floats(0, 2e9), min_size=1, max_size=20, unique=True),
    st.integers(0, 2**32 - 1),
)
@settings(deadline=None, max_examples=40)
def test_times_come_back_exactly_and_poses_to_nine_digits(tmp_path_factory, times, seed):
    rng = np.random.default_rng(seed)
    rough = Trajectory(np.sort(times), geometry.exp(rng.uniform(-3, 3, (len(times), 6))))
    path = tmp_path_factory.mktemp("tum") / "poses.txt"
    tum.write_trajectory(path, rough)
    back = tum.read_trajectory(path)
    np.testing.assert_array_equal(back.times, rough.times)
    np.testing.assert_allclose(back.world_from_sensor, rough.world_from_sensor, atol=2e-9)


def test_comments_blank_lines_commas_and_windows_line_ends(tmp_path: Path):
    text = "timestamp,tx,ty,tz,qx,qy,qz,qw\r\n# a comment\r\n\r\n1.5,1,2,3,0,0,0,1 # first\r\n  2.5\t4 5 6 0 0 1 0\r\n"
    found, warnings = _read(tmp_path, "\ufeff" + text)
    np.testing.assert_array_equal(found.times, [1.5, 2.5])
    np.testing.assert_array_equal(found.world_from_sensor[:, :3, 3], [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_allclose(found.world_from_sensor[1, :3, :3], np.diag([-1.0, -1, 1]), atol=1e-15)
    assert not warnings


def test_unsorted_poses_are_sorted_with_a_warning(tmp_path: Path):
    found, warnings = _read(tmp_path, "2 2 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n3 3 0 0 0 0 0 1\n")
    np.testing.assert_array_equal(found.times, [1, 2, 3])
    np.testing.assert_array_equal(found.world_from_sensor[:, 0, 3], [1, 2, 3])
    assert len(warnings) == 1
    assert "sorted" in warnings[0]


def test_a_pose_that_is_there_twice_is_taken_once_also_with_the_other_sign(tmp_path: Path):
    found, warnings = _read(tmp_path, "1 1 0 0 0 0 0.6 0.8\n1 1 0 0 0 0 -0.6 -0.8\n2 1 0 0 0 0 0 1\n")
    assert len(found) == 2
    assert "1 repeated" in warnings[0]


def test_quaternions_with_few_digits_become_rotations(tmp_path: Path):
    found, _ = _read(tmp_path, "1 0 0 0 0.577 0.577 0.577 0.01\n")
    rotation = found.world_from_sensor[0, :3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)


@pytest.mark.parametrize(
    ("text", "line", "problem"),
    [
        ("", "", "holds no poses"),
        ("# nothing\n\n", "", "holds no poses"),
        ("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 1\n", ":2", "7 values instead of 8"),
        ("1 0 0 0 0 0 0 1\n\n# c\n2 0 0 x 0 0 0 1\n", ":4", "'x' is no number"),
        ("1 0 0 0 0 0 0 1_0\n", ":1", "'1_0' is no number"),
        ("1 0 0 0 0 0 0 1\n2 0 nan 0 0 0 0 1\n", ":2", "not finite"),
        ("1 0 0 0 0 0 0 1\n2 0 inf 0 0 0 0 1\n", ":2", "not finite"),
        ("1 0 0 1e300 0 0 0 1\n", ":1", "position"),
        ("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 0\n", ":2", "no rotation: its length is 0"),
        ("1 0 0 0 0.5 0.5 0.5 0.9\n", ":1", "no rotation"),
        ("1 0 0 0 0 0 0 1\n1 5 0 0 0 0 0 1\n", ":2", "another pose than line 1"),
        ("2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n2 9 0 0 0 0 0 1\n", ":3", "another pose than line 1"),
    ],
)
def test_bad_lines_are_named(tmp_path: Path, text: str, line: str, problem: str):
    with pytest.raises(InputError) as caught:
        _read(tmp_path, text)
    assert f"poses.txt{line}: " in str(caught.value)
    assert problem in str(caught.value)


def test_exposures_come_back(tmp_path: Path):
    table = Exposures(small_recording.START + np.arange(5) / 3, np.array([1, 0.5, 2, 1.25, 0.75]))
    exposures.write_exposures(tmp_path / "exposures.csv", table)
    assert (tmp_path / "exposures.csv").read_text().startswith("timestamp,relative_exposure\n")
    back = exposures.read_exposures(tmp_path / "exposures.csv")
    np.testing.assert_array_equal(back.times, table.times)
    np.testing.assert_array_equal(back.relative, table.relative)


@pytest.mark.parametrize(
    "text", ["", "timestamp,relative_exposure\n", "1,0\n", "1,-1\n", "1,nan\n", "1\n", "1,2\n1,3\n"]
)
def test_bad_exposures_are_named(tmp_path: Path, text: str):
    (tmp_path / "exposures.csv").write_text(text)
    with pytest.raises(InputError, match=r"exposures\.csv"):
        exposures.read_exposures(tmp_path / "exposures.csv")


@pytest.mark.parametrize("times", [["0"] * 9, [f"{1703756316 + k / 9:.6e}" for k in range(9)]])
def test_times_of_too_few_digits_are_told_as_such(tmp_path: Path, times: list[str]):
    path = tmp_path / "poses.txt"
    path.write_text("".join(f"{time} {k} 0 0 0 0 0 1\n" for k, time in enumerate(times)))
    with pytest.raises(
        InputError, match="8 of 9 poses have the time of another pose; write the times with all"
    ):
        tum.read_trajectory(path)


def test_decimal_commas_are_named(tmp_path: Path):
    path = tmp_path / "poses.txt"
    path.write_text("# t\n1703756316,044 -0,5 1e-3 0,25 0 0,0 0 1,0\n")
    with pytest.raises(InputError, match=r"poses.txt:2: has decimal commas; write decimal points"):
        tum.read_trajectory(path)
    path.write_text("1, 2, 3, 4, 0, 0, 0, 1, 9\n")
    with pytest.raises(InputError, match=r"9 values instead of 8"):
        tum.read_trajectory(path)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-be"])
def test_another_encoding_is_named(tmp_path: Path, encoding: str):
    path = tmp_path / "poses.txt"
    mark = "" if encoding == "utf-16" else "\ufeff"
    path.write_bytes(f"{mark}0 0 0 0 0 0 0 1\n".encode(encoding))
    with pytest.raises(InputError, match=r"is UTF-16 text; save it as UTF-8"):
        tum.read_trajectory(path)
