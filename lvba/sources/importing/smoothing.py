"""The motion of an odometry without the noise of single poses, which would bend every scan that is deskewed by it."""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from lvba import geometry
from lvba.arrays import Times
from lvba.sources.importing import smoothing_spline
from lvba.sources.importing.track import Track
from lvba.sources.importing.turning import Turning

_FEWEST, _MOST_OF = 8, 0.8


@dataclass(frozen=True)
class SmoothTrack(Track):
    """A track along cubic smoothing splines, as smooth as leaving out single poses shows to predict them best.

    spline: of x, y, z (m) and the quaternion x, y, z, w of world from LiDAR, or with a gyroscope, of world from the
    frame in which that counts its turning; over times in units of `step` (s) since the first pose
    """

    spline: CubicSpline
    step: float
    turning: Turning | None

    def at(self, times: Times) -> np.ndarray:
        """Poses (Q, 4, 4) at times (Q,) s; still beyond the ends."""
        inside = np.clip(times, *self.ends)
        values = self.spline((inside - self.times[0]) / self.step)
        rotation = Rotation.from_quat(values[:, 3:])
        if self.turning is not None:
            rotation = rotation * self.turning.at(inside)
        return geometry.from_rotation_translation(rotation.as_matrix(), values[:, :3])


def smooth(lidar: Track, turning: Turning | None, slowest_s: float = 0.0) -> SmoothTrack | None:
    """The smooth track of world from LiDAR; None where there are too few poses, or the gyroscope has gaps.

    slowest_s: s, of `smoothing_spline.fit`, of rotations; 0: as smooth as poses ask for
    """
    if turning is not None:
        # a gyroscope that begins a little later or ends a little earlier than the poses does for all between
        inside = (lidar.times >= turning.times[0]) & (lidar.times <= turning.times[-1])
        if np.mean(inside) < _MOST_OF or np.count_nonzero(inside) < _FEWEST:
            return None
        lidar = Track(lidar.times[inside], lidar.poses[inside])
        if not turning.covers(lidar.times[:1], lidar.times[-1:])[0]:
            return None
    if len(lidar) < _FEWEST:
        return None
    rotation = Rotation.from_matrix(lidar.poses[:, :3, :3])
    if turning is not None:
        rotation = rotation * turning.at(lidar.times).inv()
    turned = rotation.as_quat()
    opposite = np.cumsum((turned[1:] * turned[:-1]).sum(axis=1) < 0) % 2 == 1
    turned[1:][opposite] *= -1.0
    step = float(np.median(np.diff(lidar.times)))
    when = (lidar.times - lidar.times[0]) / step
    moved = smoothing_spline.fit(when, lidar.poses[:, :3, 3])
    turned = smoothing_spline.fit(when, turned, slowest_s / step)(when)
    spline = CubicSpline(when, np.concatenate([moved(when), turned], axis=1), bc_type="natural")
    return SmoothTrack(lidar.times, lidar.poses, spline, step, turning)
