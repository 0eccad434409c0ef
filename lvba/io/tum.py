"""Trajectories as text, one pose a line: t tx ty tz qx qy qz qw (the TUM format)."""

import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lvba import geometry
from lvba.errors import InputError
from lvba.io import files
from lvba.trajectory import Trajectory

logger = logging.getLogger(__name__)

_COLUMNS = "t tx ty tz qx qy qz qw"
_NORM_TOLERANCE = 1e-2
"""A quaternion written with 3 decimals is off by less; a matrix row or Euler angles are not this close by chance."""
_HEADER_WORDS = {"t", "time", "timestamp", "stamp"}
_SAME_POSE = 1e-6
_MANY_FOR_ONE_TIME = 3
"""Poses with the time of another one from which times have too few digits: no line is there by mistake."""
_MAX_POSITION = 1e8
_MAX_COMMENTS = 100
_PLAIN = re.compile(r"[0-9]+(\.[0-9]*)?")


@dataclass(frozen=True)
class PoseFile:
    """What a TUM file holds.

    trajectory: the poses, in time order
    stamps: their times with all digits on file, "" where these are no plain decimal number
    comments: the comment lines before the first pose, without '#'
    warnings: one sentence about each thing that was mended
    """

    trajectory: Trajectory
    stamps: tuple[str, ...]
    comments: tuple[str, ...]
    warnings: tuple[str, ...]

    @property
    def times(self) -> list[str]:
        """Decimal numbers, s: the stamps, or the times to a nanosecond where there are none."""
        known = zip(self.stamps, self.trajectory.times.tolist(), strict=True)
        return [stamp or f"{time:.9f}" for stamp, time in known]


def read_trajectory(path: str | Path) -> Trajectory:
    """The poses of a TUM file, in time order; what was mended is logged as a warning.

    Raises: InputError with the line number.
    """
    trajectory, warnings = read_trajectory_and_warnings(path)
    for warning in warnings:
        logger.warning(warning)
    return trajectory


def read_trajectory_and_warnings(path: str | Path) -> tuple[Trajectory, tuple[str, ...]]:
    """The poses of a TUM file, in time order, and one sentence about each thing that was mended.

    Raises: as `read_pose_file`
    """
    file = read_pose_file(path)
    return file.trajectory, file.warnings


def read_pose_file(path: str | Path) -> PoseFile:
    """The poses of a TUM file with its comments.

    Blank lines and comments (#) are skipped, commas are as good as spaces, quaternions are normalized, a pose that is
    there twice is taken once, and unsorted poses are sorted.
    Raises: InputError with the line number: not 8 numbers, no finite value, no unit quaternion, two poses for one time.
    """
    text = files.read_text(path)
    rows, numbers = _rows(path, text)
    if not len(rows):
        raise InputError(path, "holds no poses", f"write one pose a line: {_COLUMNS}")
    _check_values(path, rows, numbers)
    warnings = []
    if np.any(np.diff(rows[:, 0]) < 0):
        order = np.argsort(rows[:, 0], kind="stable")
        rows, numbers = rows[order], numbers[order]
        warnings.append(f"{path}: the poses were not in time order, and were sorted.")
    keep = _first_of_each_time(path, rows, numbers)
    if not keep.all():
        warnings.append(f"{path}: {np.count_nonzero(~keep)} repeated poses were left out.")
    rows, numbers = rows[keep], numbers[keep]
    poses = geometry.from_quaternion_translation(rows[:, 4:], rows[:, 1:4])
    lines = text.split("\n")
    stamps = tuple(_stamp(lines[number - 1]) for number in numbers)
    return PoseFile(Trajectory(rows[:, 0].copy(), poses), stamps, _comments(text), tuple(warnings))


def _stamp(line: str) -> str:
    """The time on a line of poses as it is written, if that is a plain decimal number."""
    word = line.replace(",", " ").split()[0]
    return word if _PLAIN.fullmatch(word) else ""


def _comments(text: str) -> tuple[str, ...]:
    """The comments before the first pose."""
    comments = []
    for line in text.split("\n", _MAX_COMMENTS)[:_MAX_COMMENTS]:
        line = line.strip()
        if line and not line.startswith("#"):
            break
        comments.append(line.lstrip("#").strip())
    return tuple(comments)


def write_trajectory(path: str | Path, trajectory: Trajectory, digits: int = 9) -> None:
    """Writes a TUM file; times read back are the same floats.

    digits: after the point, of positions (m); quaternions get 3 more.
    Raises: InputError if the file cannot be written.
    """
    files.write_text(path, trajectory_text(trajectory, digits))


def trajectory_text(
    trajectory: Trajectory, digits: int = 9, comment: str = "", stamps: Sequence[str] = ()
) -> str:
    """The content of a TUM file.

    comment: its first line; stamps: what to write for the times, none: their shortest text
    """
    quaternions = geometry.quaternion(trajectory.world_from_sensor) if len(trajectory) else np.zeros((0, 4))
    lines = [f"# {comment}\n"] if comment else []
    times = stamps or [time_text(time) for time in trajectory.times]
    for time, pose, quaternion in zip(times, trajectory.world_from_sensor, quaternions, strict=True):
        position = " ".join(f"{value:.{digits}f}" for value in pose[:3, 3])
        rotation = " ".join(f"{value:.{digits + 3}f}" for value in quaternion)
        lines.append(f"{time} {position} {rotation}\n")
    return "".join(lines)


def time_text(time: float) -> str:
    """The shortest decimal that reads back as the same `time` (s), with 6 digits or more after the point."""
    return np.format_float_positional(time, unique=True, min_digits=6)


def padded(stamp: str) -> str:
    """A decimal number with 6 digits or more after the point."""
    whole, _, decimals = stamp.partition(".")
    return f"{whole}.{decimals:0<6}"


def _rows(path: str | Path, text: str) -> tuple[np.ndarray, np.ndarray]:
    """(N, 8) float64 and the line number (N,) of each."""
    rows: list[list[float]] = []
    numbers: list[int] = []
    for number, line in enumerate(text.split("\n"), 1):
        words = line.split("#", 1)[0].replace(",", " ").split()
        if not words or (not rows and words[0].lower() in _HEADER_WORDS):
            continue
        if len(words) > 8 and _has_decimal_commas(line):
            raise InputError(f"{path}:{number}", "has decimal commas", "write decimal points")
        rows.append(_row(path, number, words))
        numbers.append(number)
    return np.array(rows, float).reshape(-1, 8), np.array(numbers, np.int64)


def _row(path: str | Path, number: int, words: list[str]) -> list[float]:
    if len(words) != 8:
        raise InputError(f"{path}:{number}", f"{len(words)} values instead of 8", f"write {_COLUMNS}")
    values = [_float(word) for word in words]
    if None in values:
        raise InputError(
            f"{path}:{number}", f"{words[values.index(None)][:40]!r} is no number", f"write {_COLUMNS}"
        )
    return values  # type: ignore[return-value]


def _has_decimal_commas(line: str) -> bool:
    """Whether a line holds eight numbers between spaces, with commas where points should be."""
    words = line.split("#", 1)[0].split()
    return len(words) == 8 and all(_float(word.replace(",", ".", 1)) is not None for word in words)


def _float(word: str) -> float | None:
    try:
        return None if "_" in word else float(word)  # Python reads 1_0 as 10
    except ValueError:
        return None


def _check_values(path: str | Path, rows: np.ndarray, numbers: np.ndarray) -> None:
    bad = ~np.isfinite(rows).all(axis=1)
    if bad.any():
        raise InputError(f"{path}:{numbers[bad.argmax()]}", "a value is not finite", "remove the line")
    bad = np.abs(rows[:, 1:4]).max(axis=1) > _MAX_POSITION
    if bad.any():
        raise InputError(
            f"{path}:{numbers[bad.argmax()]}", "a position is not on this planet", "write meters"
        )
    norms = np.linalg.norm(rows[:, 4:], axis=1)
    bad = ~(np.abs(norms - 1) <= _NORM_TOLERANCE)
    if bad.any():
        row = bad.argmax()
        raise InputError(
            f"{path}:{numbers[row]}",
            f"qx qy qz qw is no rotation: its length is {norms[row]:.6g} instead of 1",
            f"write {_COLUMNS} with a unit quaternion",
        )


def _first_of_each_time(path: str | Path, rows: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """(N,) bool: rows to keep of those in time order."""
    same_time = np.diff(rows[:, 0]) == 0
    same_position = np.abs(np.diff(rows[:, 1:4], axis=0)).max(axis=1, initial=0.0) < _SAME_POSE
    cosine = np.abs((rows[1:, 4:] * rows[:-1, 4:]).sum(1))
    others = same_time & ~(same_position & (np.abs(cosine - 1) < 2 * _NORM_TOLERANCE))
    if np.count_nonzero(others) >= _MANY_FOR_ONE_TIME:
        raise InputError(
            path,
            f"{np.count_nonzero(others)} of {len(rows)} poses have the time of another pose",
            "write the times with all their digits",
        )
    for row in np.flatnonzero(others)[:1] + 1:
        raise InputError(
            f"{path}:{numbers[row]}",
            f"another pose than line {numbers[row - 1]} for the same time {time_text(rows[row, 0])}",
            "remove one of the lines",
        )
    return np.append(True, ~same_time)
