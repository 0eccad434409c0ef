"""Another sensor's poses moved along with refined ones: cameras that follow the scans (Li et al., eq. 1).

Eq. (1) takes the motion between two scans from the rough poses. Where these are wrong by centimeters from scan to scan,
because they jump there or because the odometry was lost, it leaves cameras where no image can find its neighbors again.
"""

from dataclasses import dataclass

import numpy as np

from lvba import geometry, spline, trajectory
from lvba.arrays import Pose, Poses, Times
from lvba.trajectory import JUMP_DEG, JUMP_M, Trajectory

FAR_M, FAR_DEG = 0.1, 1.0
"""A rough motion from scan to scan that is wrong by more is interpolated only where the result fits the refined scans."""
_OF_LEFT_OUT = 1.5
"""A spline is off between scans by 0.3 of what leaving a scan out changes: three standard deviations in three axes."""
_UNEXPLAINED = 2.0
"""In the middle between scans, rough motions are off by about half of how wrong they are from scan to scan."""
_LEAST = np.array([np.radians(0.3), 0.02])
"""rad and m: frames leave the trajectory by as much anyway (`visual.trajectory_prior`)."""


_MOST_ALIKE = 16
"""Frames in one gap, or beyond one end, that err together: of more, the first and the last have little in common."""


@dataclass(frozen=True)
class Carried:
    """Where rough poses and refined scans put another sensor.

    world_from_sensor: (I, 4, 4) float64
    by_rough: (I, 2) bool, rotation and position: by the rough motion since a scan, as eq. (1) has it; else by a spline
        through the refined scans
    wrong: (I, 2) float64, rad and m: by how much the rough motion from the scan before to the scan after is wrong; zeros
        where that is usual, and beyond the ends
    drift: (I, 2) float64, rad and m: standard deviations of the rough motion since the scans, far beyond their ends and
        in gaps between them, along each axis; as large as makes all frames there together as uncertain as one of them
        is, for they drift together; zeros elsewhere
    """

    world_from_sensor: np.ndarray
    by_rough: np.ndarray
    wrong: np.ndarray
    drift: np.ndarray


def carry(rough: Trajectory, refined: Poses, others: Trajectory, extrinsic: Pose) -> Carried:
    """Poses of another sensor moved along with refined ones. Source: Li et al., eq. (1).

    rough: of the first sensor; refined: (N, 4, 4), poses at rough.times; others: rough poses of the other sensor
    extrinsic: (4, 4) `sensor_from_other` as calibrated
    Where a rough motion is wrong, the other sensor may have followed it evenly, or the scan before or the scan after:
    whichever leaves its extrinsic most as calibrated. Where all of these contradict a spline through the refined scans
    by more than that can be off, the spline has it, unless rough motions are wrong by less than that, or by less than
    explains how far they are from it: in a second between scans hands turn a sensor by more than an odometry errs, which
    no spline knows. Rotation and position are judged apart.
    """
    corrections = trajectory.interpolate_corrections(rough, refined, others.times)
    poses, by_rough = np.asarray(corrections @ others.world_from_sensor), np.ones((len(others), 2), bool)
    wrong, drift = _wrong(rough, refined, others), _drift(rough, refined, others.times)
    there = np.flatnonzero(wrong.any(axis=1))
    if len(there) == 0:
        return Carried(poses, by_rough, wrong, drift)
    moving = Trajectory(rough.times, refined)
    smooth = _between(moving, others) @ extrinsic
    choices = np.concatenate([poses[None, there], _sides(rough, refined, others, there)])
    off = geometry.log(geometry.inverse(smooth[there]) @ choices)
    size = np.linalg.norm(off.reshape(*off.shape[:2], 2, 3), axis=-1)
    nearest = (size / [np.radians(JUMP_DEG), JUMP_M]).max(axis=-1).argmin(axis=0)
    own = np.arange(len(there))
    poses[there] = choices[nearest, own]
    if len(moving) >= spline.FEWEST_SAMPLES:
        known = _OF_LEFT_OUT * spline.leave_one_out_error(moving, others.times[there]) + _LEAST
        apart = size[nearest, own]
        expected = np.maximum(wrong[there], np.median(wrong[there], axis=0))
        by_rough[there] = (apart <= known) | (expected <= np.maximum(known, apart / _UNEXPLAINED))
    other = np.flatnonzero(~by_rough.all(axis=1))
    poses[other] = _mixed(poses[other], smooth[other], by_rough[other], extrinsic)
    return Carried(poses, by_rough, wrong, drift)


def far(rough: Times, times: Times) -> np.ndarray:
    """(I,) bool: times (I,) in gaps between others (N,), or beyond their ends by more than the usual interval."""
    if len(rough) < 2:
        return np.zeros(len(times), bool)
    before, _ = trajectory.bracket(rough, times)
    beyond = np.maximum(rough[0] - times, times - rough[-1])
    in_gap = (beyond <= 0) & trajectory.gaps(rough)[np.minimum(before, len(rough) - 2)]
    return np.asarray((beyond > np.median(np.diff(rough))) | in_gap)


def _wrong(rough: Trajectory, refined: Poses, others: Trajectory) -> np.ndarray:
    """(I, 2), as of `Carried`."""
    if len(rough) < 2:
        return np.zeros((len(others), 2))
    before, _ = trajectory.bracket(rough.times, others.times)
    wrong = trajectory.motion_differences(rough.world_from_sensor, refined)[before]
    far = (wrong > [np.radians(FAR_DEG), FAR_M]).any(axis=1) & ~spline.outside(rough, others.times)
    return np.asarray(np.where(far[:, None], wrong, 0.0))


def _drift(rough: Trajectory, refined: Poses, times: Times) -> np.ndarray:
    """(I, 2), as of `Carried`.

    By how much rough motions over as long a time differ from refined ones, wherever scans tell: over the time from the
    end; in a gap, over all of it, by the part that a random walk is off its line there.
    """
    drift, is_far = np.zeros((len(times), 2)), far(rough.times, times)
    if not is_far.any():
        return drift
    interval = np.diff(rough.times)
    before, fraction = trajectory.bracket(rough.times, times)
    gap = np.minimum(before, len(interval) - 1)
    beyond = np.maximum(rough.times[0] - times, times - rough.times[-1])
    outside, inside = is_far & (beyond > 0), is_far & (beyond <= 0)
    lag, size = _differences(rough, refined)
    if outside.any():
        drift[outside] = _over(lag, size, beyond[outside])
    if inside.any():
        bridge = np.sqrt(fraction * (1 - fraction))[inside, None]
        drift[inside] = bridge * _over(lag, size, interval[gap[inside]])
    # frames before, in each gap and after: one run each
    run = np.where(outside, np.where(times < rough.times[0], -1, len(interval)), gap)
    _, which, count = np.unique(run, return_inverse=True, return_counts=True)
    together = np.sqrt(np.minimum(count, _MOST_ALIKE))[which]
    return np.asarray(drift * together[:, None] / np.sqrt(3.0))


def _differences(rough: Trajectory, refined: Poses) -> tuple[np.ndarray, np.ndarray]:
    """(L,) s and (L, 2), rad and m: root mean square difference of rough motions from refined ones over such times."""
    count, lags = len(refined), [1]
    while 4 * lags[-1] <= count:
        lags.append(2 * lags[-1])
    lag, size = np.zeros(len(lags) + 1), np.zeros((len(lags) + 1, 2))
    for row, step in enumerate(lags, 1):
        motions = (
            geometry.inverse(each[:-step]) @ each[step:] for each in (rough.world_from_sensor, refined)
        )
        one, other = motions
        off = geometry.log(geometry.inverse(one) @ other).reshape(-1, 2, 3)
        lag[row] = np.median(rough.times[step:] - rough.times[:-step])
        size[row] = np.sqrt(np.square(off).sum(axis=2).mean(axis=0))
    return lag, size


def _over(lag: np.ndarray, size: np.ndarray, span: np.ndarray) -> np.ndarray:
    """(Q, 2): sizes (L, 2) at lags (L,) s, over spans (Q,) s; beyond the last, in proportion to the span."""
    within = np.stack([np.interp(span, lag, size[:, k]) for k in range(2)], axis=1)
    return np.asarray(within * np.maximum(span / lag[-1], 1.0)[:, None])


def _mixed(one: Poses, other: Poses, by_one: np.ndarray, extrinsic: Pose) -> Poses:
    """(J, 4, 4): the one where `by_one` (J, 2) says so for rotation and position of the first sensor, else the other."""
    one, other = (each @ geometry.inverse(extrinsic) for each in (one, other))
    sensor = np.where(by_one[:, 0, None, None], one, other)
    sensor[:, :3, 3] = np.where(by_one[:, 1:], one[:, :3, 3], other[:, :3, 3])
    return np.asarray(sensor @ extrinsic)


def _between(samples: Trajectory, others: Trajectory) -> np.ndarray:
    """(I, 4, 4): the first sensor at the times of the other."""
    if len(samples) < spline.FEWEST_SAMPLES:
        return trajectory.sample(samples, others.times)
    return spline.through(samples, others.times)


def _sides(rough: Trajectory, refined: Poses, others: Trajectory, there: np.ndarray) -> np.ndarray:
    """(2, J, 4, 4): the others `there` (J,) as if fixed to the scan before, and to the one after, by the rough poses."""
    before, _ = trajectory.bracket(rough.times, others.times[there])
    corrections = refined @ geometry.inverse(rough.world_from_sensor)
    return np.stack([corrections[before + k] @ others.world_from_sensor[there] for k in (0, 1)])
