"""Times of a scan's points, in seconds from the scan's stamp, whatever unit and zero its driver gives them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lvba.arrays import Times, Vectors

_UNITS = (1.0, 1e-3, 1e-6, 1e-9)
_SHORTEST_S, _LONGEST_S = 0.02, 0.5
"""A sweep takes about this long; a factor of 25, so one unit fits at most."""
_OVERLAP = 1.2
"""Sweeps are not longer than this many times the time from scan to scan: they follow each other."""
_AGREEING = 0.9
"""Part of the scans whose times must be like those of the others."""
_OUTLIERS = 0.005


@dataclass(frozen=True)
class PointClock:
    """What times of points count.

    unit: s; sweep: s, from the first to the last point of a usual scan; begin: s from the stamp, of the first one
    absolute: True: times are those of the stamps' clock; False: zero is anywhere, and the middle of the sweep is taken
        for the moment of the pose
    """

    unit: float
    sweep: float
    begin: float
    absolute: bool

    def from_stamp(self, points: Vectors, time: Times | None, stamp: float) -> np.ndarray:
        """(N,) s from the `stamp` (s), of points (N, 3) of a scan that has times (N,) in its file's unit.

        Zeros where it has none, or they do not fit those of other scans.
        """
        if time is None:
            return np.zeros(len(points))
        seconds = np.asarray(time, float) * self.unit
        finite = np.isfinite(seconds)
        if not finite.any():
            return np.zeros(len(seconds))
        first, last = _extent(seconds[finite])
        if not 0.1 * self.sweep < last - first < 1.5 * self.sweep:
            return np.zeros(len(seconds))
        zero = stamp if self.absolute else (first + last) / 2
        if self.absolute and max(abs(first - stamp), abs(last - stamp)) > 2 * self.sweep:
            return np.zeros(len(seconds))
        inside = finite & (seconds >= first - self.sweep) & (seconds <= last + self.sweep)
        return np.where(inside, np.where(finite, seconds, 0.0) - zero, 0.0)


def find_clock(times: Sequence[np.ndarray | None], stamps: Times) -> PointClock | str:
    """The clock of some scans' points, or why there is none; "" where times say nothing at all.

    times: of each scan (N,) as in its file; stamps: (S,) s, of those scans
    """
    known = [
        (np.asarray(each, float)[np.isfinite(each)], stamp)
        for each, stamp in zip(times, stamps, strict=True)
        if each is not None
    ]
    known = [(each, stamp) for each, stamp in known if len(each)]
    if not known:
        return ""
    extents = np.array([_extent(each) for each, _ in known])
    lengths = extents[:, 1] - extents[:, 0]
    length = float(np.median(lengths))
    if length == 0:
        return ""
    fitting = [unit for unit in _UNITS if _SHORTEST_S <= length * unit <= _LONGEST_S]
    if not fitting:
        return f"times of points span {length:g} in their unit, which is no sweep in s, ms, us or ns"
    if np.mean(np.abs(lengths - length) < 0.5 * length) < _AGREEING:
        return "times of points span another length in every scan"
    unit = fitting[0]
    away = extents * unit - np.array([stamp for _, stamp in known])[:, None]
    absolute = bool(np.mean(np.abs(away).max(axis=1) <= 2 * length * unit) >= _AGREEING)
    begin = float(np.median(away[:, 0])) if absolute else -length * unit / 2
    return PointClock(unit, length * unit, begin, absolute)


def overlapping(clock: PointClock, stamps: Times) -> bool:
    """Whether sweeps would be longer than the time between the stamps (S,) s of all scans."""
    return len(stamps) > 1 and clock.sweep > _OVERLAP * float(np.median(np.diff(stamps)))


def _extent(seconds: np.ndarray) -> tuple[float, float]:
    """First and last of some times without outliers."""
    first, last = np.quantile(seconds, [_OUTLIERS, 1 - _OUTLIERS])
    return float(first), float(last)
