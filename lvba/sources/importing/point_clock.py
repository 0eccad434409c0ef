"""When points were measured, from the field of times that their driver writes: unit and zero, by the data."""

from dataclasses import dataclass

import numpy as np

from lvba.lidar import point_times

_AGREEING = 0.9
_FAR_SWEEPS = 1.5
_ABOUT = 0.03
"""Part of a sweep that its first and last points are from its begin and end."""
_UNIT_NAMES = {1.0: "s", 1e-3: "ms", 1e-6: "us", 1e-9: "ns"}


@dataclass(frozen=True)
class ScanClock:
    """What times of points count.

    unit: s, 0: there are no times that can be used; sweep: s; begin: s from the stamp to the first point of a usual scan
    zero: "stamp": times count from the stamp of the scan; "clock": they are of the clock of the stamps; "first": their
        zero is unknown, and the first point is taken for the moment of the stamp
    problem: why there are no times, "" where there are
    """

    unit: float
    sweep: float
    begin: float
    zero: str
    problem: str = ""

    def of_times(self, times: np.ndarray | None, stamp: int, count: int) -> np.ndarray:
        """(N,) float64, s from a scan's stamp to each of its points, NaN where its time is none; zeros without times.

        times: (N,) int64 or float64, in the driver's unit and from its zero, `unit` s; stamp: ns; count: N
        """
        if not self.unit or times is None:
            return np.zeros(count)
        if self.zero == "clock":
            counted = _since(times, stamp, self.unit)
        else:
            counted = times.astype(float) * self.unit
        if self.zero == "first":
            counted = counted - _first(counted)
        inside = np.abs(counted - self.begin - self.sweep / 2) < _FAR_SWEEPS * self.sweep
        return np.where(inside, counted, np.nan)

    @property
    def words(self) -> str:
        """What was found, for people."""
        if not self.unit:
            return self.problem or "there are no times"
        since = {"stamp": "from the stamp of the scan", "clock": "absolute", "first": "from the first point"}
        return f"{_UNIT_NAMES[self.unit]}, {since[self.zero]}"


def find(times: list[np.ndarray | None], stamps: np.ndarray, period: float) -> ScanClock:
    """The clock of points.

    times: of some scans, (N,) each, as the driver has them; stamps: (S,) int64 ns, of those; period: s, from scan to scan
    """
    known = [
        (each, int(stamp))
        for each, stamp in zip(times, stamps, strict=True)
        if each is not None and len(each)
    ]
    clock = point_times.find_clock([each for each, _ in known], np.zeros(len(known)))
    if isinstance(clock, str):
        return ScanClock(0.0, 0.0, 0.0, "stamp", clock or "scans have no times of points")
    unit = clock.unit
    extents = np.array([_extent(each.astype(float)) * unit for each, _ in known])
    length = float(np.median(extents[:, 1] - extents[:, 0]))
    sweep = period if abs(length - period) < _ABOUT * period else length
    if _near(extents, sweep):
        return ScanClock(unit, sweep, _begin(extents, sweep), "stamp")
    absolute = np.array([_extent(_since(each, stamp, unit)) for each, stamp in known])
    if _near(absolute, sweep):
        return ScanClock(unit, sweep, _begin(absolute, sweep), "clock")
    return ScanClock(unit, sweep, 0.0, "first")


def _begin(extents: np.ndarray, sweep: float) -> float:
    """s from the stamp to the start of a sweep, by first and last times (S, 2), s; the first point is a little later."""
    begin = float(np.median(extents.mean(axis=1))) - sweep / 2
    usual = min((0.0, -sweep / 2, -sweep), key=lambda value: abs(value - begin))
    return usual if abs(usual - begin) < _ABOUT * sweep else begin


def _since(times: np.ndarray, stamp: int, unit: float) -> np.ndarray:
    """(N,) float64, s from a stamp, ns, of times (N,) since the same zero: whole numbers stay exact."""
    if np.issubdtype(times.dtype, np.integer):
        tick = round(unit * 1e9)
        return (times.astype(np.int64) - stamp // tick) * unit - (stamp % tick) * 1e-9
    whole = stamp * 1e-9 / unit
    return np.asarray((times.astype(float) - whole) * unit)


def _near(extents: np.ndarray, sweep: float) -> bool:
    """Whether first and last times (S, 2), s, are within about a sweep of zero."""
    return bool(np.mean(np.abs(extents).max(axis=1) < _FAR_SWEEPS * sweep) >= _AGREEING)


def _extent(values: np.ndarray) -> np.ndarray:
    """(2,): first and last; without the outermost points where these are far off the others."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return np.array([np.nan, np.nan])
    inner, outer = np.quantile(finite, [0.005, 0.995]), np.array([finite.min(), finite.max()])
    return outer if outer[1] - outer[0] < 1.05 * (inner[1] - inner[0]) else inner


def _first(values: np.ndarray) -> float:
    return float(_extent(values)[0])
