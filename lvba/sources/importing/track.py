"""Poses of an odometry over time."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lvba import geometry, trajectory
from lvba.arrays import Poses, Times

MAX_GAP_S = 0.5
"""Poses further apart are not interpolated between."""
_CONTINUED, _CONTINUED_S = 0.1, 0.02
"""Part of the usual time from pose to pose, and most, s, by which the motion continues beyond the first and last pose."""


@dataclass(frozen=True)
class Track:
    """times: (N,) float64, s since the survey's zero, strictly ascending; poses: (N, 4, 4), world from what moves."""

    times: np.ndarray
    poses: np.ndarray

    def __len__(self) -> int:
        return len(self.times)

    @cached_property
    def ends(self) -> tuple[float, float]:
        """s: when the motion begins and ends, a little before the first pose and after the last."""
        steps = np.diff(self.times)
        if not len(steps):
            return float(self.times[0]), float(self.times[0])
        more = min(_CONTINUED * float(np.median(steps)), _CONTINUED_S)
        before, after = (more if step <= MAX_GAP_S else 0.0 for step in (steps[0], steps[-1]))
        return float(self.times[0] - before), float(self.times[-1] + after)

    def at(self, times: Times) -> np.ndarray:
        """Poses (Q, 4, 4) at times (Q,) s, on the screw motion between neighbors, that continues until `ends`."""
        before, _ = trajectory.bracket(self.times, times)
        after = np.minimum(before + 1, len(self) - 1)
        start, step = self.times[before], self.times[after] - self.times[before]
        fraction = (np.clip(times, *self.ends) - start) / np.where(step > 0, step, 1.0)
        return geometry.interpolate(self.poses[before], self.poses[after], fraction)

    def apart(self, seconds: float) -> np.ndarray:
        """(M,) int64: numbers of poses that are at least so many seconds apart, the first among them."""
        kept = [0]
        for number, time in enumerate(self.times):
            if time - self.times[kept[-1]] >= seconds:
                kept.append(number)
        return np.array(kept)

    def covers(self, first: float, last: float) -> bool:
        """Whether there are poses around and between two times (s), no gap of which is too long."""
        if self.outside(first, last):
            return False
        low = max(int(np.searchsorted(self.times, first, side="right")) - 1, 0)
        high = int(np.searchsorted(self.times, last, side="left"))
        return bool((np.diff(self.times[low : high + 1]) <= MAX_GAP_S).all())

    def outside(self, first: float, last: float) -> float:
        """s by which the time from first to last (s) lies before the first or after the last pose; 0 within `ends`."""
        if self.ends[0] <= first and last <= self.ends[1]:
            return 0.0
        return max(float(self.times[0]) - first, last - float(self.times[-1]))


def made(times: Times, poses: Poses) -> Track:
    """A track of poses (N, 4, 4) at times (N,) s in any order; of several at one time, the first."""
    order = np.argsort(times, kind="stable")
    times, poses = times[order], poses[order]
    keep = np.concatenate([[True], np.diff(times) > 0])
    return Track(times[keep], poses[keep])
