"""Poses of an odometry over time, ."""

from dataclasses import dataclass

import numpy as np

from lvba import geometry, trajectory
from lvba.arrays import Poses, Times

MAX_GAP_S = 0.5
"""Poses further apart are not interpolated between."""


@dataclass(frozen=True)
class Track:
    """times: (N,) float64, s since the survey's zero, strictly ascending; poses: (N, 4, 4), world from what moves."""

    times: np.ndarray
    poses: np.ndarray

    def __len__(self) -> int:
        return len(self.times)

    def at(self, times: Times) -> np.ndarray:
        """Poses (Q, 4, 4) at times (Q,) s, on the screw motion between neighbors; the first and last beyond the ends."""
        before, fraction = trajectory.bracket(self.times, times)
        after = np.minimum(before + 1, len(self) - 1)
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
        if not (self.times[0] <= first and last <= self.times[-1]):
            return False
        low = max(int(np.searchsorted(self.times, first, side="right")) - 1, 0)
        high = int(np.searchsorted(self.times, last, side="left"))
        return bool((np.diff(self.times[low : high + 1]) <= MAX_GAP_S).all())


def made(times: Times, poses: Poses) -> Track:
    """A track of poses (N, 4, 4) at times (N,) s in any order; of several at one time, the first."""
    order = np.argsort(times, kind="stable")
    times, poses = times[order], poses[order]
    keep = np.concatenate([[True], np.diff(times) > 0])
    return Track(times[keep], poses[keep])
