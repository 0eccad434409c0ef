"""Times of poses in files: whichever unit they are in, they come to the clock of the scans, or are refused."""

import sys

import numpy as np
import pytest
import surveys

from lvba.errors import InputError
from lvba.simulate import raw
from lvba.simulate.raw import Sensors
from lvba.sources.importing import own_odometry, pose_clock
from lvba.sources.importing.importer import import_source
from lvba.sources.importing.options import ImportOptions

STEP = 100_000_000
UNITS = {"seconds": 9, "milliseconds": 6, "microseconds": 3, "nanoseconds": 0}


def surveyed(first):
    return surveys.survey(first + STEP * np.arange(5))


def text(nanoseconds, digits):
    """A decimal number with so many digits of ns behind the point."""
    sign, value = "-" * (nanoseconds < 0), abs(nanoseconds)
    whole, rest = divmod(value, 10**digits)
    return f"{sign}{whole}" + (f".{rest:0{digits}}" if digits else "")


def write(path, stamps, digits):
    path.write_text(
        "".join(f"{text(int(stamp), digits)} {i} 0 0 0 0 0 1\n" for i, stamp in enumerate(stamps))
    )
    return str(path)


@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize("first", [1_700_000_000_123_456_789, 2_000_000_000, -250_000_001])
def test_times_of_a_file_are_read_in_their_unit_with_all_digits(tmp_path, unit, first):
    survey = surveyed(first)
    stamps = first - STEP // 2 + STEP * np.arange(7)
    track, notes = pose_clock.of_file(write(tmp_path / "poses.txt", stamps, UNITS[unit]), survey)
    np.testing.assert_allclose(track.times, -0.05 + 0.1 * np.arange(7), atol=2e-7 if first < 0 else 1e-9)
    assert notes == (() if unit == "seconds" else (f"poses.txt: times of poses are {unit}.",))
    pose_clock.check(track, survey, "poses.txt", {})


@pytest.mark.parametrize("first", [0, -200_000_000, 5_000_000_000_000_000_000_000])
def test_poses_of_another_clock_are_refused(tmp_path, first):
    survey = surveyed(1_700_000_000_000_000_000)
    path = write(tmp_path / "poses.txt", [first + STEP * i for i in range(7)], 9)
    track, notes = pose_clock.of_file(path, survey)
    assert notes == ()
    with pytest.raises(
        InputError, match=r"poses.txt: 0 scans lie inside of its poses.*give poses of the same clock"
    ):
        pose_clock.check(track, survey, path, {})


def test_poses_that_an_option_shifts_onto_the_scans_are_of_their_clock(tmp_path):
    survey = surveyed(1_700_000_000_000_000_000)
    path = write(tmp_path / "poses.txt", survey.scan_stamps + 5_000_000_000, 9)
    track, _ = pose_clock.of_file(path, survey)
    pose_clock.check(track, survey, path, {"time": "-5"})
    with pytest.raises(InputError, match="0 scans lie inside"):
        pose_clock.check(track, survey, path, {"time": "end"})


def test_a_program_may_write_nanoseconds(tmp_path):
    survey = surveyed(1_700_000_000_000_000_000)
    path = write(tmp_path / "made.txt", survey.scan_stamps, 0)
    command = f"{sys.executable} -c \"import shutil; shutil.copy('{path}', '{{out}}') or '{{bag}}'\""
    track, notes = own_odometry.of_command(command, "bag", survey, lambda *_: None)
    np.testing.assert_allclose(track.times, 0.1 * np.arange(5), atol=1e-6)
    assert notes == (f"{sys.executable}: times of poses are nanoseconds.",)


def test_an_import_with_poses_of_another_clock_ends_in_one_line(tmp_path):
    sensors = Sensors(points=500, width=64, height=48)
    source, _ = raw.simulate_raw("courtyard", seconds=1.0, sensors=sensors)
    path = write(tmp_path / "poses.txt", [STEP * i - 200_000_000 for i in range(12)], 9)
    with pytest.raises(InputError, match="0 scans lie inside of its poses"):
        import_source(source, tmp_path / "out", ImportOptions(image="none", odometry=path))
