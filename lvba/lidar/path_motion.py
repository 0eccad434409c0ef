"""How a sensor moves during its scans by the path from scan to scan, and how far that may be from how it does."""

import numpy as np
from scipy import ndimage

from lvba import geometry, spline
from lvba.arrays import Indices, Poses, Tangents, Times
from lvba.lidar.point_times import PointClock
from lvba.lidar.row_times import RowClock
from lvba.trajectory import Trajectory

_NEIGHBORS = 2
"""Scans on either side that a motion is predicted from."""
_JUMP, _ABOUT_JUMP = 5.0, 11
"""Times the median of so many steps about it that a step of rough poses is off at most; more is a jump."""


def sweep_twists(times: Times, world_from_scan: Poses, clock: PointClock | RowClock) -> Tangents:
    """(S, 6), rad/s and m/s, scan frames: mean motion during sweeps, by splines through poses (S, 4, 4) at (S,) s."""
    if len(times) < spline.FEWEST_SAMPLES or times[-1] - times[0] < 2 * clock.sweep:
        return np.zeros((len(times), 6))
    return _twists(Trajectory(times, world_from_scan), times + clock.begin, clock.sweep)


def unpredicted(times: Times, world_from_scan: Poses, clock: PointClock | RowClock) -> np.ndarray:
    """(4,) rad/s and m/s, root mean square over scans: by how much the motion during a scan is not what the path through
    the others says, and by how much it may grow over a sweep beside that of the path, rad/s and m/s.

    The path through the others has gaps twice as long, and is off by more than the path through all.
    times: (S,) s; world_from_scan: (S, 4, 4); zeros of fewer than five scans
    """
    inner = range(_NEIGHBORS, len(times) - _NEIGHBORS)
    twist = sweep_twists(times, world_from_scan, clock)
    if not inner or not twist.any():
        return np.zeros(4)
    every = np.arange(len(times))
    off = np.concatenate(
        [_by(np.delete(every, k), k, times, world_from_scan, clock) - twist[k] for k in inner]
    )
    grows = 0.5 * clock.sweep * np.gradient(twist, times, axis=0)
    steady = sizes(off)
    return np.concatenate([steady, np.hypot(steady, sizes(grows))])


def beyond_ends(times: Times, world_from_scan: Poses, clock: PointClock | RowClock) -> np.ndarray:
    """(2, 2) rad/s and m/s, root mean square: by how much the motions during the first and the last scan may be off,
    which the path tells from one side only.

    By what paths that begin or end at each other scan say of it: of the first of scans that were measured before their
    stamps ten times as much as of those between.
    times: (S,) s; world_from_scan: (S, 4, 4); zeros of few scans
    """
    twist, count = sweep_twists(times, world_from_scan, clock), len(times)
    if not twist.any():
        return np.zeros((2, 2))
    inner = range(_NEIGHBORS, count - _NEIGHBORS)

    def off(k: int, part: slice) -> Tangents:
        return np.asarray(_by(part, k, times, world_from_scan, clock) - twist[k])

    first = [off(k, slice(k, None)) for k in inner if count - k >= spline.FEWEST_SAMPLES]
    last = [off(k, slice(k + 1)) for k in inner if k + 1 >= spline.FEWEST_SAMPLES]
    return np.stack([sizes(np.concatenate(each)) if each else np.zeros(2) for each in (first, last)])


def without_jumps(rough: Poses, refined: Poses) -> np.ndarray:
    """(S, 4, 4): rough poses, with the motions of refined ones from scan to scan where theirs is off as none about it is.

    An odometry does not deskew by a jump; it does by what it has wrong for seconds. Both (S, 4, 4)
    """
    steps, better = geometry.steps(rough), geometry.steps(refined)
    off = np.linalg.norm(geometry.log(geometry.inverse(better) @ steps).reshape(-1, 2, 3), axis=2)
    usual = ndimage.median_filter(off, size=(_ABOUT_JUMP, 1), mode="nearest")
    jump = (off > _JUMP * usual).any(axis=1)
    chain = [rough[0]]
    for step in np.where(jump[:, None, None], better, steps):
        chain.append(chain[-1] @ step)
    return geometry.orthonormalize(np.array(chain))


def _by(
    scans: slice | Indices, k: int, times: Times, world_from_scan: Poses, clock: PointClock | RowClock
) -> Tangents:
    """(1, 6): the motion during scan k by the path through some scans."""
    path = Trajectory(times[scans], world_from_scan[scans])
    return _twists(path, times[k : k + 1] + clock.begin, clock.sweep)


def _twists(path: Trajectory, begin: Times, sweep: float) -> Tangents:
    """(n, 6): mean motion from each of (n,) s on."""
    before, after = (spline.through(path, moment, beyond=sweep) for moment in (begin, begin + sweep))
    return np.asarray(geometry.log(geometry.inverse(before) @ after) / sweep)


def sizes(motion: Tangents) -> np.ndarray:
    """(k,) float64: root mean squares of each three numbers of motions, such as turns and shifts.

    motion: (n, 3 k) float64, rad/s and m/s
    """
    return np.asarray(np.sqrt(np.mean(motion.reshape(len(motion), -1, 3) ** 2, axis=(0, 2))))
