"""Sweeps of a LiDAR with the moments of their points, and how the sensor moves during one."""

from dataclasses import dataclass

import numpy as np

from lvba import geometry
from lvba.arrays import CloudPoints, Tangents, Times, Vectors
from lvba.sources import placing


@dataclass(frozen=True)
class Sweep:
    """One scan as it was measured.

    time: s, the moment that its pose will be of
    points: (N, 3) float32, m, LiDAR frame, each measured from where the sensor was at its own moment
    offsets: (N,) float64, s from `time`; zeros: the points have no times
    """

    time: float
    points: CloudPoints
    offsets: Times

    @property
    def extent(self) -> tuple[float, float]:
        """Moments of its first and last point, s."""
        return self.time + float(self.offsets.min()), self.time + float(self.offsets.max())

    @staticmethod
    def of_middle(points: CloudPoints, times: Times) -> "Sweep":
        """A sweep whose pose is that of the middle between its first and last point. times: (N,) s."""
        middle = (float(times.min()) + float(times.max())) / 2
        return Sweep(middle, points, times - middle)


def deskewed(sweep: Sweep, velocity: Tangents) -> np.ndarray:
    """Points (N, 3) float64, m, as the sensor would have measured them at `sweep.time`.

    velocity: (6,), rad/s and m/s in the LiDAR's own axes, taken to be the same during the sweep
    """
    points = np.asarray(sweep.points, float)
    if not sweep.offsets.any():
        return points
    moments = np.linspace(sweep.offsets.min(), sweep.offsets.max(), _PIECES)
    moved = geometry.retract(np.broadcast_to(np.eye(4), (_PIECES, 4, 4)), moments[:, None] * velocity)
    return placing.place(points, moments, moved, sweep.offsets)


_PIECES = 33
"""Poses along a sweep: at 1 rad/s, 3 mrad from one to the next."""


@dataclass(frozen=True)
class Inertial:
    """Readings of an IMU in the LiDAR's axes.

    times: (N,) float64, s, ascending; rates: (N, 3) float64, rad/s; forces: (N, 3) float64, m/s^2, accelerations and what
    holds against gravity, or None
    """

    times: Times
    rates: Vectors
    forces: Vectors | None = None

    def turn(self, begin: float, end: float, bias: np.ndarray) -> np.ndarray | None:
        """Rotation (3,) rad, as a rotation vector in the axes at `begin`, from one moment to another.

        begin, end: s; bias: (3,) float64, rad/s, subtracted from the rates
        None where there are too few readings between them.
        """
        if begin > end:
            back = self.turn(end, begin, bias)
            return None if back is None else -back
        poses = self._turned(begin, end, bias)
        return None if poses is None else np.asarray(geometry.log(poses[-1])[:3])

    def force(self, begin: float, end: float, bias: np.ndarray) -> np.ndarray | None:
        """Mean force (3,), m/s^2, between two moments, in the axes at `begin`; None where it is not known.

        begin, end: s; bias: (3,) float64, rad/s, subtracted from the rates
        """
        if self.forces is None:
            return None
        poses = self._turned(begin, end, bias)
        if poses is None:
            return None
        first = int(np.searchsorted(self.times, begin))
        forces = self.forces[first : first + len(poses) - 1]
        return np.asarray(np.einsum("nij,nj->ni", poses[:-1, :3, :3], forces).mean(axis=0))

    def _turned(self, begin: float, end: float, bias: np.ndarray) -> np.ndarray | None:
        """Poses (K + 1, 4, 4) without translation, from the axes at `begin`: before each reading, and at the end."""
        first, last = np.searchsorted(self.times, [begin, end])
        if last - first < 3 or self.times[first] - begin > _GAP_S or end - self.times[last - 1] > _GAP_S:
            return None
        edges = np.r_[begin, (self.times[first : last - 1] + self.times[first + 1 : last]) / 2, end]
        steps = np.zeros((last - first, 6))
        steps[:, :3] = (self.rates[first:last] - bias) * np.diff(edges)[:, None]
        poses = np.empty((len(steps) + 1, 4, 4))
        poses[0] = np.eye(4)
        for index, step in enumerate(steps):
            poses[index + 1] = geometry.retract(poses[index], step)
        return poses


_GAP_S = 0.05
"""Without readings for longer, what the IMU says of a motion is not used."""
