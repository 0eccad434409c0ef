"""Odometry scan by scan: predicted by the last motion and the IMU, registered to the map of the last scans."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import chain, islice
from typing import Any

import numpy as np

from lvba import geometry
from lvba.arrays import Pose, Vectors
from lvba.optim import normal_equations
from lvba.optim.levenberg_marquardt import damped_step
from lvba.optim.normal_equations import NormalEquations
from lvba.sources.odometry import information as informations
from lvba.sources.odometry.local_map import LocalMap, Registered
from lvba.sources.odometry.prediction import Motion, Prediction, moved_on, predict
from lvba.sources.odometry.sweeps import Inertial, Sweep, deskewed

_SHARED = 30.0
"""So many points err alike (a surface, a cell of the map): they count as one."""
_REACHES = (2.0, 0.5)
"""Cells: how far points may be from the map, by the predicted pose, and then by the registered one."""
_HEAD, _STEADY = 12, 4
"""Scans that are followed first for how fast the recording begins; from which one on the map is no longer bent."""
_HEAD_ROUNDS = (_STEADY, 1, 1)
"""By the motion of which of them the first sweep is deskewed, round by round."""
SURPRISING = 3.5
"""Standard deviations between registration and prediction that chance does not explain."""
_TRIED = 2
"""In so many directions, of those that planes tell least about, a scan is registered again from a cell away."""
OPEN = 0.5
"""A scan that ends farther from its pose than this part of a cell is held by no surface in some direction."""


@dataclass(frozen=True)
class Step:
    """What the odometry found at one scan.

    time: s; world_from_lidar: (4, 4); registered: as the map alone has it
    surprise: how far the registration is from the prediction, in standard deviations of both together
    sway: 0: the scan comes back to the same place when its registration starts elsewhere; 1: it stays where it starts
    """

    time: float
    world_from_lidar: Pose
    registered: Registered
    surprise: float
    sway: float


def odometry(sweeps: Iterable[Sweep], voxel: float, imu: Inertial | None = None) -> Iterator[Step]:
    """A step for each sweep; sweeps that are not later than the one before are left out. voxel: m, cells of the map.

    The world is the LiDAR's frame at the first sweep.
    """
    remaining = iter(sweeps)
    head = list(islice(remaining, _HEAD))
    if not head:
        return
    # how fast a recording begins, only its map can tell
    turns = None if imu is None else replace(imu, forces=None)
    begin = Motion.at_rest(head[0].time)
    for like in _HEAD_ROUNDS:
        begin = _before(
            [motion for motion, _ in _followed(head, begin, voxel, turns, robust=False)], imu, like
        )
    for _, step in _followed(chain(head, remaining), begin, voxel, imu):
        yield step


def _before(moved: list[Motion], imu: Inertial | None, like: int) -> Motion:
    """The motion at the first of some scans, by those after it: the map begins with a sweep that it deskews.

    like: the number of the scan whose motion is taken; a map of one sweep that was deskewed wrongly bends the first ones
    """
    if len(moved) <= _STEADY + 1:
        return replace(moved[0], velocity=moved[-1].velocity, turn_rate=moved[-1].turn_rate)
    steady, last = moved[_STEADY], moved[-1]
    felt = imu.force(steady.time, last.time, last.bias) if imu else None
    gravity = None
    if felt is not None:
        gained = (last.velocity - steady.velocity) / (last.time - steady.time)
        gravity = steady.pose[:3, :3] @ felt - gained
    taken = moved[like]
    return replace(
        moved[0],
        interval=taken.interval,
        velocity=taken.velocity,
        turn_rate=taken.turn_rate,
        bias=last.bias,
        gravity=gravity,
    )


def _followed(
    sweeps: Iterable[Sweep], motion: Motion, voxel: float, imu: Inertial | None, robust: bool = True
) -> Iterator[tuple[Motion, Step]]:
    """The motion up to each sweep, from that at the first one, with its step.

    robust: registrations that contradict the motion before count less
    """
    local, first = LocalMap(voxel), True
    for sweep in sweeps:
        if first:
            cloud = local.prepared(deskewed(sweep, predict(motion, sweep, imu).during))
            local.add(cloud, motion.pose)
            yield motion, _first_step(motion, cloud.size())
            first = False
        elif sweep.time > motion.time:
            motion, step = _go_on(local, sweep, imu, motion, voxel, robust)
            yield motion, step


def _first_step(motion: Motion, points: int) -> Step:
    return Step(
        time=motion.time,
        world_from_lidar=motion.pose,
        registered=Registered(motion.pose, 1.0, points, 0.0),
        surprise=0.0,
        sway=0.0,
    )


def _go_on(
    local: LocalMap, sweep: Sweep, imu: Inertial | None, motion: Motion, voxel: float, robust: bool
) -> tuple[Motion, Step]:
    prediction = predict(motion, sweep, imu)
    pose, during = prediction.pose, prediction.during
    for reach in _REACHES:
        points = deskewed(sweep, during)
        cloud = local.prepared(points)
        registered = local.register(cloud, pose, reach * voxel)
        information = informations.of_planes(points, 2 * voxel) * (registered.matched / _SHARED)
        pose, surprise = _fused(registered.map_from_lidar, information, prediction, robust)
        moved = geometry.log(geometry.inverse(motion.pose) @ pose) / (sweep.time - motion.time)
        during = np.r_[during[:3] if prediction.turn is not None else moved[:3], moved[3:]]
    sway = _sway(local, cloud, registered.map_from_lidar, information, points)
    local.add(local.prepared(deskewed(sweep, during)), pose)
    step = Step(
        time=sweep.time,
        world_from_lidar=pose,
        registered=registered,
        surprise=surprise,
        sway=sway,
    )
    return moved_on(motion, sweep.time, pose, registered.map_from_lidar, prediction), step


def _sway(local: LocalMap, cloud: Any, registered: Pose, information: np.ndarray, points: Vectors) -> float:
    """How far from its pose a scan ends when its registration starts a cell away, in cells: the most of some directions.

    registered: (4, 4), as the map alone has it; information: (6, 6), rad and m; points: (N, 3), m, LiDAR frame
    Where surfaces hold a scan, however little, it comes back. Where they do not, it ends wherever noise and the cells of
    the map keep it, and of that its information says nothing.
    """
    size = np.repeat(
        [np.median(np.linalg.norm(points, axis=1)), 1.0], 3
    )  # m, how far a unit of tangent moves points
    _, directions = np.linalg.eigh(information / size[:, None] / size)
    sway = 0.0
    for direction in directions.T[:_TRIED]:
        start = geometry.retract(registered, local.voxel * direction / size)
        end = local.register(cloud, start, _REACHES[0] * local.voxel).map_from_lidar
        off = geometry.log(geometry.inverse(registered) @ end)
        sway = max(sway, float(np.linalg.norm(off * size)) / local.voxel)
        if sway > OPEN:
            break
    return sway


def _fused(
    registered: Pose, information: np.ndarray, prediction: Prediction, robust: bool
) -> tuple[Pose, float]:
    """The most likely pose (4, 4) by registration and prediction, and by how many sigmas they differ.

    information: (6, 6), of the registration, rad and m
    Where the map leaves a direction open, the prediction decides.
    """
    off = geometry.log(geometry.inverse(prediction.pose) @ registered)
    prior = np.diag(1 / prediction.sigma**2)
    pull = prior @ off
    step = _solved(information + prior, pull)
    # off^T (information^-1 + prior^-1)^-1 off, also where the information has no inverse
    surprise = float(np.sqrt(max(pull @ (off + step), 0.0)))
    if robust and surprise > SURPRISING:
        # a registration that slides along a surface contradicts the motion before, scan after scan
        step = _solved(information * (SURPRISING / surprise) ** 2 + prior, pull)
    return geometry.retract(registered, step), surprise


def _solved(hessian: np.ndarray, gradient: np.ndarray) -> np.ndarray:
    """The step (6,) to the minimum. hessian: (6, 6); gradient: (6,)"""
    step, _ = damped_step(_equations(hessian, gradient), 0.0)
    return np.zeros(6) if step is None else step.blocks[0]


def _equations(hessian: np.ndarray, gradient: np.ndarray) -> NormalEquations:
    return normal_equations.from_dense(hessian, gradient[None], 0.0)
