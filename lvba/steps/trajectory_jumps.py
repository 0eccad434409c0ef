"""Jumps of a trajectory: motions between neighboring frames that do not continue as those before and after them do."""

from dataclasses import dataclass

import numpy as np

from lvba import geometry, spline, trajectory
from lvba.arrays import Poses, Times
from lvba.trajectory import Trajectory
from lvba.visual.result import VisualResult

_NEIGHBORS = 2
_FEWEST_STEPS = 2 * _NEIGHBORS + 1
_ORDINARY = 6.0
"""Times the typical change from one motion to the next (some nine standard deviations of noise) that is nothing special:
people and cars speed up, brake and shake."""
_ORDINARY_ALONG = 13.0
"""The same along one axis: as many standard deviations."""
LEAST_M, LEAST_DEG = 0.15, 1.8
"""Smaller ones are within three standard deviations of what is expected of an odometry from frame to frame."""
CONFIRMED_M, CONFIRMED_DEG = 0.03, 1.0
"""By how much images may differ from a motion that they confirm: that of scans is interpolated at their times."""
_FAST = 0.9
"""Part of the motions that are slower than the speed at which a sensor is turned now and then: jumps are fewer."""


_PAUSE_S = 5.0
"""Speeds say where a sensor is for seconds. What it did while nothing was recorded for longer, as when it was put down,
they do not."""


@dataclass(frozen=True)
class Jumps:
    """after: (J,) int64, frames after which the trajectory jumps; meters, degrees: (J,) by how much, 0 where that alone
    would be no jump"""

    after: np.ndarray
    meters: np.ndarray
    degrees: np.ndarray

    def without(self, confirmed: np.ndarray) -> "Jumps":
        """Those that are no true motion. confirmed: (K,) int64, frames after which the trajectory is as it was"""
        kept = ~np.isin(self.after, confirmed)
        return Jumps(self.after[kept], self.meters[kept], self.degrees[kept])


def find(trajectory: Trajectory) -> Jumps:
    """The jumps of a trajectory; a gap in time is none as long as the speed fits, nor is a pause of the recording."""
    meters, degrees = unexpected(trajectory)
    if len(meters) < _FEWEST_STEPS:
        return Jumps(np.zeros(0, np.int64), np.zeros(0), np.zeros(0))
    interval = np.diff(trajectory.times)
    jumps = []
    judged = slice(_NEIGHBORS, len(meters) - _NEIGHBORS)
    for size, least in ((meters, LEAST_M), (degrees, np.maximum(LEAST_DEG, _swings(trajectory)))):
        ordinary = _ORDINARY * np.median((size / interval)[judged]) * interval
        jumps.append(np.where((size > np.maximum(ordinary, least)) & ~pauses(interval), size, 0.0))
    jumps[0] = np.where(_aside(trajectory) & ~pauses(interval), meters, jumps[0])
    after = np.flatnonzero((jumps[0] > 0) | (jumps[1] > 0))
    return Jumps(after, jumps[0][after], jumps[1][after])


def _aside(trajectory: Trajectory) -> np.ndarray:
    """(N - 1,) bool: motions to the next frame that are extraordinary along an axis along which there is little.

    Whoever walks or drives speeds up and turns, but hardly goes up or down: a jump of a meter that is nothing special in
    between sparse frames still shows, unless it goes where the sensor goes.
    """
    poses, interval = trajectory.world_from_sensor, np.diff(trajectory.times)
    off = np.einsum("nij,nj->ni", poses[:-1, :3, :3], _unusual(trajectory)[:, 3:])
    inner = off[_NEIGHBORS:-_NEIGHBORS]
    size = np.linalg.norm(inner, axis=1)
    # each counts as far as a typical one, so that a jump makes no axis its own
    bounded = inner * np.minimum(1.0, np.median(size) / np.maximum(size, 1e-12))[:, None]
    axes = np.linalg.eigh(bounded.T @ bounded)[1]
    along = np.abs(off @ axes)
    ordinary = _ORDINARY_ALONG * np.median(along[_NEIGHBORS:-_NEIGHBORS], axis=0)
    return np.asarray(
        (along * interval[:, None] > np.maximum(ordinary * interval[:, None], LEAST_M)).any(axis=1)
    )


def pauses(interval: np.ndarray) -> np.ndarray:
    """(N - 1,) bool: times between frames in which the recording stood still. interval: (N - 1,) float64, s"""
    return np.asarray(interval > max(_PAUSE_S, _ORDINARY * float(np.median(interval))))


def _swings(trajectory: Trajectory) -> np.ndarray:
    """(N - 1,), degrees: the turn to the next frame less the one expected, of a sensor that swings round.

    Turning takes no run-up as going does: what turns at some speed may turn as fast the other way in the next moment, and
    between sparse frames nothing shows how it came to.
    """
    poses, interval = trajectory.world_from_sensor, np.diff(trajectory.times)
    turned = geometry.rotation_angle_deg(geometry.steps(poses))
    return np.asarray(2.0 * np.quantile(turned / interval, _FAST) * interval)


def expected(trajectory: Trajectory) -> np.ndarray:
    """(N - 1, 4, 4): motions to the next frame by the median speed of the two before and the two after; as they are of
    the first two and the last two, which have none on one side."""
    poses, interval = trajectory.world_from_sensor, np.diff(trajectory.times)
    steps = geometry.steps(poses)
    if len(interval) < _FEWEST_STEPS:
        return np.asarray(steps)
    usual = _usual(geometry.log(steps) / interval[:, None]) * interval[:, None]
    return geometry.retract(np.tile(np.eye(4), (len(usual), 1, 1)), usual)


def unexpected(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """How far each motion to the next frame, (N - 1,) m and degrees, is from the one that is `expected`."""
    interval = np.diff(trajectory.times)
    if len(interval) < _FEWEST_STEPS:
        return np.zeros(len(interval)), np.zeros(len(interval))
    off = _unusual(trajectory) * interval[:, None]
    return np.linalg.norm(off[:, 3:], axis=1), np.degrees(np.linalg.norm(off[:, :3], axis=1))


def _unusual(trajectory: Trajectory) -> np.ndarray:
    """(N - 1, 6), rad/s and m/s: speeds to the next frame less those that are `_usual`; 0 at both ends."""
    rate = geometry.log(geometry.steps(trajectory.world_from_sensor)) / np.diff(trajectory.times)[:, None]
    return np.asarray(rate - _usual(rate))


def _usual(rate: np.ndarray) -> np.ndarray:
    """(N, 6): the median of the two speeds before and the two after each."""
    offsets = [k for k in range(-_NEIGHBORS, _NEIGHBORS + 1) if k]
    inner = np.arange(_NEIGHBORS, len(rate) - _NEIGHBORS)
    usual = rate.copy()
    usual[inner] = np.median(rate[inner[:, None] + offsets], axis=1)
    return usual


def tied_by_images(
    scans: Trajectory,
    images: VisualResult,
    times: Times,
    most_m: float = LEAST_M,
    most_deg: float = LEAST_DEG,
) -> np.ndarray:
    """(K,) int64, scans after which the motion to the next is as images on both sides of it have it, which are of one
    group: patches of the ones are seen in the others, or each in some between.

    scans: refined; images: times (I,) s of them, and what they were refined to; most_m, most_deg: by how much the motions
        of scans and images may differ
    """
    keyframes = images.keyframes
    if not len(images.group) or len(scans) < spline.FEWEST_SAMPLES:
        return np.zeros(0, np.int64)
    moments, cameras = images.moments(times)[keyframes], images.world_from_camera[keyframes]
    before = np.searchsorted(moments, scans.times[:-1], side="right") - 1
    after = np.searchsorted(moments, scans.times[1:])
    within = np.flatnonzero((before >= 0) & (after < len(moments)) & (before < after))
    first, last = before[within], after[within]
    by_scans = spline.through(scans, moments) @ images.scan_from_camera
    off = geometry.inverse(geometry.inverse(by_scans[first]) @ by_scans[last]) @ (
        geometry.inverse(cameras[first]) @ cameras[last]
    )
    agree = np.linalg.norm(off[:, :3, 3], axis=1) < most_m
    agree &= geometry.rotation_angle_deg(off) < most_deg
    group = images.group[keyframes]
    return np.asarray(within[agree & (group[first] == group[last])])


def differ(one: Poses, other: Poses) -> np.ndarray:
    """(N - 1,) bool: motions to the next frame in which poses (N, 4, 4) differ from others (N, 4, 4) by a jump."""
    return trajectory.motions_differ(one, other, LEAST_M, LEAST_DEG)
