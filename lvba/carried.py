"""Another sensor's poses moved along with refined ones: cameras that follow the scans (Li et al., eq. 1).

Eq. (1) takes the motion between two scans from the rough poses. Where these are wrong by centimeters from scan to scan,
because they jump there or because the odometry was lost, it leaves cameras where no image can find its neighbors again.
"""

from dataclasses import dataclass

import numpy as np

from lvba import geometry, spline, trajectory
from lvba.arrays import Pose, Poses
from lvba.trajectory import JUMP_DEG, JUMP_M, Trajectory

FAR_M, FAR_DEG = 0.1, 1.0
"""A rough motion from scan to scan that is wrong by more is interpolated only where the result fits the refined scans."""
_OF_LEFT_OUT = 1.5
"""A spline is off between scans by 0.3 of what leaving a scan out changes: three standard deviations in three axes."""
_LEAST = np.array([np.radians(0.3), 0.02])
"""rad and m: frames leave the trajectory by as much anyway (`visual.trajectory_prior`)."""


@dataclass(frozen=True)
class Carried:
    """Where rough poses and refined scans put another sensor.

    world_from_sensor: (I, 4, 4) float64
    by_rough: (I,) bool, by the rough motion since a scan, as eq. (1) has it; else by a spline through the refined scans
    """

    world_from_sensor: np.ndarray
    by_rough: np.ndarray


def carry(rough: Trajectory, refined: Poses, others: Trajectory, mounted: Pose) -> Carried:
    """Poses of another sensor moved along with refined ones. Source: Li et al., eq. (1).

    rough: of the first sensor; refined: (N, 4, 4), poses at rough.times; others: rough poses of the other sensor
    mounted: (4, 4) `sensor_from_other` as calibrated
    Where a rough motion is wrong, the other sensor may have followed it evenly, or the scan before or the scan after:
    whichever leaves it mounted most as calibrated. Where all of these contradict a spline through the refined scans
    by more than that can be off, the spline has it.
    """
    corrections = trajectory.interpolate_corrections(rough, refined, others.times)
    poses, by_rough = np.asarray(corrections @ others.world_from_sensor), np.ones(len(others), bool)
    there = np.flatnonzero(_far(rough, refined, others))
    if len(there) == 0:
        return Carried(poses, by_rough)
    moving = Trajectory(rough.times, refined)
    smooth = _between(moving, others) @ mounted
    choices = np.concatenate([poses[None, there], _sides(rough, refined, others, there)])
    off = geometry.log(geometry.inverse(smooth[there]) @ choices)
    size = np.linalg.norm(off.reshape(*off.shape[:2], 2, 3), axis=-1)
    nearest = (size / [np.radians(JUMP_DEG), JUMP_M]).max(axis=-1).argmin(axis=0)
    own = np.arange(len(there))
    poses[there] = choices[nearest, own]
    if len(moving) >= spline.FEWEST_SAMPLES:
        known = _OF_LEFT_OUT * spline.leave_one_out_error(moving, others.times[there])
        by_rough[there] = (size[nearest, own] <= known + _LEAST).all(axis=1)
        poses[~by_rough] = smooth[~by_rough]
    return Carried(poses, by_rough)


def _far(rough: Trajectory, refined: Poses, others: Trajectory) -> np.ndarray:
    """(I,) bool: taken during rough motions that are wrong by far; beyond the ends nothing is."""
    if len(rough) < 2:
        return np.zeros(len(others), bool)
    before, _ = trajectory.bracket(rough.times, others.times)
    far = trajectory.motions_differ(rough.world_from_sensor, refined, FAR_M, FAR_DEG)[before]
    return np.asarray(far & ~spline.outside(rough, others.times))


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
