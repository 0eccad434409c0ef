"""The motion of an odometry with its fast part by an IMU: what poses have wrong from scan to scan bends scans."""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import polynomial
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import CubicSpline

from lvba import geometry
from lvba.arrays import Pose, Times, Vector, Vectors
from lvba.sources.importing import smoothing, smoothing_spline
from lvba.sources.importing import turning as turnings
from lvba.sources.importing.smoothing import SmoothTrack
from lvba.sources.importing.survey import ImuReadings
from lvba.sources.importing.track import Track
from lvba.sources.importing.turning import Turning

_TURNED_S = 3.0
"""s: a gyroscope's error beside a constant bias changes more slowly. Poses of odometries sway within half a second."""
_MOVED_S = 0.25
"""s: the same of positions by an accelerometer: attitudes that are off by half a degree are 0.1 m/s^2 of gravity, 5 mm in
this time. From 0.2 to 0.7 s, the poses of twelve simulated odometries differ little."""


@dataclass(frozen=True)
class InertialTrack(Track):
    """A track whose slow part is that of poses, and whose fast part an IMU has measured.

    turned: world from LiDAR, of which only rotations count
    integrated_times, integrated: (K,) float64, s, and (K, 3) float64, m: where the IMU is by its accelerometer alone
    drift: from there to the IMU's positions by the poses, m, over times in units of `step` (s) since the first pose
    lever: (3,) float64, m, the IMU in the LiDAR's frame
    """

    turned: SmoothTrack
    integrated_times: np.ndarray
    integrated: np.ndarray
    drift: CubicSpline
    step: float
    lever: np.ndarray

    def at(self, times: Times) -> np.ndarray:
        """Poses (Q, 4, 4) at times (Q,) s; still beyond the ends."""
        inside = np.clip(times, *self.ends)
        poses = self.turned.at(inside)
        integrated = np.stack(
            [np.interp(inside, self.integrated_times, each) for each in self.integrated.T], axis=-1
        )
        poses[:, :3, 3] = integrated + self.drift((inside - self.times[0]) / self.step)
        poses[:, :3, 3] -= _turned(poses, self.lever)
        return poses


def moved(lidar: Track, turning: Turning, imu: ImuReadings, imu_from_lidar: Pose) -> InertialTrack | None:
    """The track of world from LiDAR with an IMU's fast part; None where there are too few poses, or the IMU has gaps.

    turning: by the gyroscope of the same; imu_from_lidar: (4, 4)
    Fast: what the IMU and the poses differ by is as smooth as a smoothing spline of 3 s (rotations) and 0.25 s
    (positions) has it, or smoother. Gravity and a constant bias of the accelerometer are among that.
    """
    turned = smoothing.smooth(lidar, turnings.unbiased(turning, lidar), _TURNED_S)
    if turned is None:
        return None
    times, integrated = _integrated(turned, imu, imu_from_lidar)
    lever = geometry.inverse(imu_from_lidar)[:3, 3]
    positions = turned.poses[:, :3, 3] + _turned(turned.at(turned.times), lever)
    off = positions - np.stack([np.interp(turned.times, times, each) for each in integrated.T], axis=-1)
    when = (turned.times - turned.times[0]) / turned.step
    # a natural spline does not bend at its ends, as what gravity does
    parabolas = polynomial.polyval(when, polynomial.polyfit(when, off, 2)).T
    rest = smoothing_spline.fit(when, off - parabolas, _MOVED_S / turned.step)
    drift = CubicSpline(when, parabolas + rest(when))
    return InertialTrack(
        times=turned.times,
        poses=turned.poses,
        turned=turned,
        integrated_times=times,
        integrated=integrated,
        drift=drift,
        step=turned.step,
        lever=lever,
    )


def _integrated(turned: SmoothTrack, imu: ImuReadings, imu_from_lidar: Pose) -> tuple[Times, Vectors]:
    """(K,) s, and (K, 3) m: accelerations without their mean, summed up twice, world axes."""
    first, last = np.searchsorted(imu.times, turned.ends)
    inside = slice(max(first - 1, 0), last + 1)
    times, kept = np.unique(imu.times[inside], return_index=True)
    forces = imu.forces[inside][kept] @ imu_from_lidar[:3, :3]
    accelerations = np.einsum("nij,nj->ni", turned.at(times)[:, :3, :3], forces)
    accelerations -= accelerations.mean(axis=0)
    speeds = cumulative_trapezoid(accelerations, times, axis=0, initial=0)
    return times, cumulative_trapezoid(speeds, times, axis=0, initial=0)


def _turned(poses: np.ndarray, vector: Vector) -> np.ndarray:
    """(N, 3), m: a vector (3,), m, by the rotations of poses (N, 4, 4)."""
    return np.asarray(poses[:, :3, :3] @ vector)
