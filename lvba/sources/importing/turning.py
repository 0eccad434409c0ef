"""How a gyroscope says that the sensor turned between poses of an odometry, which it is drawn to at each of them."""

from dataclasses import dataclass

import numpy as np
from scipy import optimize
from scipy.spatial.transform import Rotation

from lvba import trajectory
from lvba.arrays import Pose, Times, Vectors
from lvba.sources.importing.survey import ImuReadings
from lvba.sources.importing.track import Track

_MAX_GAP_S = 0.03
"""Readings further apart say nothing of what is between."""
_FEWEST = 10
_SPAN_S, _FEWEST_SPANS = 1.0, 3
"""Poses of odometries sway within half a second; a gyroscope drifts slowly."""


@dataclass(frozen=True)
class Turning:
    """times: (N,) float64, s, ascending; turned: (N, 4), quaternions xyzw: LiDAR at the first time from LiDAR then.

    rates: (N, 3), rad/s, LiDAR axes
    """

    times: np.ndarray
    turned: np.ndarray
    rates: np.ndarray

    def at(self, times: Times) -> Rotation:
        """How far it has turned until times (Q,) s."""
        before, _ = trajectory.bracket(self.times, times)
        step = (times - self.times[before])[:, None]
        return Rotation.from_quat(self.turned[before]) * Rotation.from_rotvec(self.rates[before] * step)

    def sum(self, times: Times) -> np.ndarray:
        """(Q, 3) rad: rates summed up until times (Q,) s, as if turns about different axes added up."""
        sums = np.cumsum(self.rates[:-1] * np.diff(self.times)[:, None], axis=0)
        sums = np.concatenate([np.zeros((1, 3)), sums])
        return np.stack([np.interp(times, self.times, column) for column in sums.T], axis=-1)

    def covers(self, first: Times, last: Times) -> np.ndarray:
        """(Q,) bool: whether there are readings all the way from first (Q,) to last (Q,) s."""
        gaps = np.concatenate([[0], np.cumsum(np.diff(self.times) > _MAX_GAP_S)])
        low = np.searchsorted(self.times, first, side="right") - 1
        high = np.minimum(np.searchsorted(self.times, last, side="left"), len(self.times) - 1)
        inside = (low >= 0) & (last <= self.times[-1])
        return np.asarray(inside & (gaps[high] == gaps[np.maximum(low, 0)]))


@dataclass(frozen=True)
class TurningTrack(Track):
    """A track that turns between its poses as a gyroscope says, and moves as before.

    What the gyroscope is off from one pose to the next (bias, noise, and what the poses are off) is spread evenly.
    """

    turning: Turning

    def at(self, times: Times) -> np.ndarray:
        """Poses (Q, 4, 4) at times (Q,) s; as `Track.at` where the gyroscope has gaps."""
        poses = super().at(times)
        before, fraction = trajectory.bracket(self.times, times)
        after = np.minimum(before + 1, len(self) - 1)
        first, last = self.times[before], self.times[after]
        known = np.flatnonzero(self.turning.covers(first, last) & (fraction > 0) & (fraction < 1))
        if not len(known):
            return poses
        first, last, before, after = first[known], last[known], before[known], after[known]
        start = self.turning.at(first).inv()
        whole, part = start * self.turning.at(last), start * self.turning.at(times[known])
        rotation = Rotation.from_matrix(self.poses[before, :3, :3])
        off = (whole.inv() * rotation.inv() * Rotation.from_matrix(self.poses[after, :3, :3])).as_rotvec()
        turned = rotation * part * Rotation.from_rotvec(fraction[known, None] * off)
        poses[known, :3, :3] = turned.as_matrix()
        return poses


def turning(imu: ImuReadings | None, imu_from_lidar: Pose | None) -> Turning | None:
    """What a gyroscope says of the LiDAR; None where there is none, or its axes are not known.

    imu_from_lidar: (4, 4)
    """
    if imu is None or imu_from_lidar is None or len(imu.times) < _FEWEST:
        return None
    keep = np.concatenate([[True], np.diff(imu.times) > 0])
    rates = imu.rates[keep] @ imu_from_lidar[:3, :3]
    # between two readings, their mean
    rates = np.concatenate([0.5 * (rates[1:] + rates[:-1]), rates[-1:]])
    return _summed(imu.times[keep], rates)


def _summed(times: Times, rates: Vectors) -> Turning:
    """times: (N,) float64, s, ascending; rates: (N, 3) float64, rad/s, from each time to the next"""
    steps = np.minimum(np.diff(times), _MAX_GAP_S)
    turned = Rotation.from_rotvec(np.concatenate([np.zeros((1, 3)), rates[:-1] * steps[:, None]])).as_quat()
    reach = 1
    while reach < len(turned):  # products of ever longer runs
        product = Rotation.from_quat(turned[:-reach]) * Rotation.from_quat(turned[reach:])
        turned = np.concatenate([turned[:reach], product.as_quat()])
        reach *= 2
    return Turning(times, turned, rates)


def unbiased(turning: Turning, lidar: Track) -> Turning:
    """The same without the constant bias of the gyroscope, by what poses of the LiDAR turn over a second and more.

    A constant bias turns about with the sensor, and would be no slow drift of the world. Steps of poses that are off as
    few are do not count as much. The same where poses say nothing.
    """
    moments = lidar.times[lidar.apart(_SPAN_S)]
    known = turning.covers(moments[:-1], moments[1:])
    if np.count_nonzero(known) < _FEWEST_SPANS:
        return turning
    first, last = moments[:-1][known], moments[1:][known]
    truly = (_rotation(lidar, first).inv() * _rotation(lidar, last)).inv()
    off = (truly * turning.at(first).inv() * turning.at(last)).as_rotvec()
    by_bias = _by_bias(turning, first, last)
    scale = max(float(np.median(np.abs(off))), 1e-6)
    solved = optimize.least_squares(
        lambda bias: (by_bias @ bias - off).ravel(),
        np.zeros(3),
        jac=lambda _: by_bias.reshape(-1, 3),
        loss="soft_l1",
        f_scale=scale,
    )
    return _summed(turning.times, turning.rates - solved.x)


def _rotation(lidar: Track, times: Times) -> Rotation:
    return Rotation.from_matrix(lidar.at(times)[:, :3, :3])


def _by_bias(turning: Turning, first: Times, last: Times) -> np.ndarray:
    """(Q, 3, 3) s: how far a bias of 1 rad/s about each axis turns from first (Q,) to last (Q,) s, axes of the last."""
    rotations = Rotation.from_quat(turning.turned).as_matrix()
    steps = np.diff(turning.times, append=turning.times[-1])
    sums = np.cumsum(rotations * steps[:, None, None], axis=0)
    whole = sums[np.searchsorted(turning.times, last)] - sums[np.searchsorted(turning.times, first)]
    return np.asarray(np.swapaxes(turning.at(last).as_matrix(), 1, 2) @ whole)
