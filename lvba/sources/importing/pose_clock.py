"""Poses of a file on the clock of the scans: in which unit their times are, and whether they are of the same clock."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from lvba.errors import InputError
from lvba.io import tum
from lvba.sources.importing.survey import Survey
from lvba.sources.importing.track import MAX_GAP_S, Track
from lvba.trajectory import Trajectory

_DIGITS = {"seconds": 9, "milliseconds": 6, "microseconds": 3, "nanoseconds": 0}
"""Digits of a time behind the point that are whole nanoseconds, by unit."""
_NEAR_S = 1.0
"""Poses that end, or begin, within so much of the scans may still be of the same clock: offsets are found later."""
_LATEST_NS = 2**62


def of_file(path: str, survey: Survey) -> tuple[Track, tuple[str, ...]]:
    """The poses of a TUM file, times in s since the survey's zero, and notes, one sentence each.

    Times are in seconds, or in the unit by which they overlap with the scans.
    Raises InputError: as `tum.read_pose_file`; in no unit do they overlap.
    """
    file = tum.read_pose_file(path)
    unit = _unit(file.times, survey)
    stamps = np.array([_nanoseconds(text, _DIGITS[unit]) for text in file.times], np.int64)
    notes = () if unit == "seconds" else (f"{Path(path).name}: times of poses are {unit}.",)
    return Track(survey.seconds(stamps), file.trajectory.world_from_sensor), notes


def of_trajectory(poses: Trajectory, survey: Survey, where: str) -> tuple[Track, tuple[str, ...]]:
    """As `of_file`, of poses that a program wrote; where: names it."""
    unit = _unit([f"{time:.9f}" for time in poses.times.tolist()], survey)
    digits = _DIGITS[unit]
    stamps = np.round(poses.times * 10.0**digits).astype(np.int64)
    notes = () if unit == "seconds" else (f"{where}: times of poses are {unit}.",)
    return Track(survey.seconds(stamps), poses.world_from_sensor), notes


def check(odometry: Track, survey: Survey, where: str, said: Mapping[str, str]) -> None:
    """Passes if poses overlap with the scans. where: names them; said: answers that options give, by question

    Raises InputError: they do not.
    """
    first, last = survey.seconds(survey.scan_stamps[[0, -1]])
    near = _NEAR_S + abs(float(time) if _is_seconds(time := said.get("time", "")) else 0.0)
    if odometry.times[0] > last + near or odometry.times[-1] < first - near:
        raise outside(odometry, survey, where, 0)


def outside(odometry: Track, survey: Survey, where: str, inside: int) -> InputError:
    """That too few scans, `inside`, lie between the poses. where: names these"""
    first, last = survey.seconds(survey.scan_stamps[[0, -1]])
    return InputError(
        where,
        f"{inside} scans lie inside of its poses, which are from {odometry.times[0]:.1f} to "
        f"{odometry.times[-1]:.1f} s, counted from the first scan; scans from {first:.1f} to {last:.1f} s",
        "give poses of the same clock, at most 0.5 s apart, and check --from and --to",
    )


def _is_seconds(text: str) -> bool:
    return text not in ("", "begin", "middle", "end")


def _unit(texts: list[str], survey: Survey) -> str:
    """Of ascending times: seconds where poses are as close as they must be, else by which most of both times overlap."""
    scans = (int(survey.scan_stamps[0]), int(survey.scan_stamps[-1]))
    overlaps, step = {}, 0.0
    for unit, digits in _DIGITS.items():
        stamps = [_nanoseconds(text, digits) for text in texts]
        both = min(stamps[-1], scans[1]) - max(stamps[0], scans[0])
        overlaps[unit] = both / max(stamps[-1] - stamps[0], scans[1] - scans[0], 1)
        if unit == "seconds":
            step = (stamps[-1] - stamps[0]) / max(len(stamps) - 1, 1) * 1e-9
    if overlaps["seconds"] > 0 and step <= MAX_GAP_S:
        return "seconds"
    unit = max(overlaps, key=overlaps.__getitem__)
    return unit if overlaps[unit] > 0 else "seconds"


def _nanoseconds(text: str, digits: int) -> int:
    """Whole ns of a decimal number, `digits` of which behind the point are whole ns; what is behind these is cut.

    What no clock counts is the latest time there is.
    """
    whole, _, decimals = text.lstrip("-").partition(".")
    value: int = int(whole) * 10**digits + int(f"{decimals[:digits]:0<{digits}}" or 0)
    return min(value, _LATEST_NS) * (-1 if text.startswith("-") else 1)
