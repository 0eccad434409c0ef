"""Times of files: read from their names, and matched with a trajectory."""

import re
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path

import numpy as np

from lvba import geometry, trajectory
from lvba.errors import InputError
from lvba.trajectory import Trajectory

SAME_TIME = 2e-3
"""s; a file and a pose whose times differ by less belong together: names and poses are rounded differently."""
MAX_GAP = 0.5
"""s; poses further apart are not interpolated between."""

_DECIMAL = re.compile(r"[0-9]+\.[0-9]+")
_SECONDS_AND_FRACTION = re.compile(r"(?<![0-9])([0-9]{9,10})[_-]([0-9]{6}|[0-9]{9})(?![0-9])")
_INTEGER = re.compile(r"[0-9]+")
_LATEST = 1e12
_DECIMALS_OF_UNITS = {19: 9, 16: 6, 13: 3}
"""Whole numbers of so many digits are nano-, micro- or milliseconds since 1970 (2001 to 2286)."""


def from_name(name: str) -> float | None:
    """The time that a file name carries, s, or None."""
    text = stamp(name)
    return None if text is None else float(text)


def stamp(name: str) -> str | None:
    """The time that a file name carries, s, as a decimal number with all its digits, or None: its longest number.

    float64 holds times since 1970 to 0.2 microseconds only, so results are written with these digits.
    Understood are 1630577758.569490.pcd, image_12.5.png, 1630577758_569490000.png, and whole numbers: of 19, 16 and
    13 digits as nano-, micro- and milliseconds, others as seconds.
    """
    stem = Path(name).stem if Path(name).suffix[1:].isalpha() else name
    if decimals := _DECIMAL.findall(stem):
        text = max(decimals, key=len)
    elif match := _SECONDS_AND_FRACTION.search(stem):
        text = f"{match[1]}.{match[2]}"
    elif integers := _INTEGER.findall(stem):
        text = max(integers, key=len)
        if places := _DECIMALS_OF_UNITS.get(len(text), 0):
            text = f"{text[:-places]}.{text[-places:]}"
    else:
        return None
    return text if float(text) < _LATEST else None


def merged(name: str, pose: str) -> str:
    """The time of a frame with all digits that are known of it, from those of its name and of its pose ("": unknown).

    The name's where the pose's is that, rounded or cut, or printed from a float of it. Else the pose's: names may be
    rounded, too.
    """
    if not name or not pose:
        return name or pose
    off = abs(Decimal(name) - Decimal(pose))
    same = off <= 2 * Decimal(float(np.spacing(float(pose))))
    more = _decimals(name) - _decimals(pose)
    if more > 0 and (same or off < Decimal(1).scaleb(-_decimals(pose))):
        return name
    return name if (more == 0 and same) or float(name) == float(pose) else pose


def _decimals(text: str) -> int:
    return len(text.partition(".")[2])


@dataclass(frozen=True)
class Match:
    """Which files have a pose.

    files: (M,) int64, indices of files, in time order
    poses: of those files; their times are the pose's where the two belong together, else the file's
    own: (M,) int64, index of the pose that a file has to itself, -1: interpolated
    """

    files: np.ndarray
    poses: Trajectory
    own: np.ndarray
    interpolated: int
    """Files between two poses."""
    unused_poses: int
    """Poses that belong to no file and lie in no interpolated gap."""
    by_order: bool = False
    """The names are numbers 0, 1, 2, ... (or from 1), one per pose: matched in order."""


def match(times: np.ndarray, rough: Trajectory, where: object) -> Match:
    """The pose of each file that has one: that of the same time, or interpolated between two that are close.

    times: (F,) float64, s, ascending; where: names the pose file in errors
    Files that are numbered instead (0, 1, 2, ...) and as many as the poses have theirs in order.
    Raises: InputError if no file has one: the times are of another clock.
    """
    before, fraction = trajectory.bracket(rough.times, times)
    after = np.minimum(before + 1, len(rough) - 1)
    nearest = np.where(times - rough.times[before] <= rough.times[after] - times, before, after)
    same = np.abs(rough.times[nearest] - times) <= SAME_TIME
    inside = (rough.times[before] <= times) & (times <= rough.times[after])
    between = ~same & inside & (rough.times[after] - rough.times[before] <= MAX_GAP)
    if not (same | between).any():
        if len(times) == len(rough) and times[0] in (0, 1) and (np.diff(times) == 1).all():
            return Match(
                files=np.arange(len(times)),
                poses=rough,
                own=np.arange(len(times)),
                interpolated=0,
                unused_poses=0,
                by_order=True,
            )
        raise _another_clock(times, rough, where)
    poses = rough.world_from_sensor[nearest].copy()
    poses[between] = geometry.interpolate(
        rough.world_from_sensor[before[between]], rough.world_from_sensor[after[between]], fraction[between]
    )
    matched_times = np.where(same, rough.times[nearest], times)
    keep = same | between
    keep[1:] &= ~(same[1:] & same[:-1] & (nearest[1:] == nearest[:-1]))  # one file a pose
    kept = np.flatnonzero(keep)
    kept = kept[np.argsort(matched_times[kept], kind="stable")]
    used = np.zeros(len(rough), bool)
    used[nearest[same]] = used[before[between]] = used[after[between]] = True
    return Match(
        files=kept,
        poses=Trajectory(matched_times[kept], poses[kept]),
        own=np.where(same, nearest, -1)[kept],
        interpolated=int(np.count_nonzero(between & keep)),
        unused_poses=int(np.count_nonzero(~used)),
    )


def _another_clock(times: np.ndarray, rough: Trajectory, where: object) -> InputError:
    files_range = f"{times[0]:.3f} to {times[-1]:.3f} s"
    poses_range = f"{rough.times[0]:.3f} to {rough.times[-1]:.3f} s"
    mend = "give poses with the times that the file names carry, in seconds"
    for unit, factor in (("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9)):
        if rough.times[0] / factor <= times[-1] and times[0] <= rough.times[-1] / factor:
            mend = f"the poses seem to be in {unit}: write seconds"
    return InputError(
        where, f"poses of another clock: they are from {poses_range}, the files from {files_range}", mend
    )
