"""The trajectory of a recording by its scans, and whether it may be used."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from lvba.sources.odometry import gate
from lvba.sources.odometry.gate import Verdict
from lvba.sources.odometry.registration import Step, odometry
from lvba.sources.odometry.sweeps import Inertial, Sweep

_CELL_PER_RANGE = 0.04
_CELLS_M = (0.1, 0.5)
_FEWEST = 100


@dataclass(frozen=True)
class Estimate:
    """Poses of the LiDAR. times: (N,) float64, s; world_from_lidar: (N, 4, 4); cell: m, of the map

    The world is the LiDAR's frame at the first time.
    """

    times: np.ndarray
    world_from_lidar: np.ndarray
    verdict: Verdict
    cell: float


def estimate(sweeps: Iterable[Sweep], imu: Inertial | None, done: Callable[[int], None]) -> Estimate:
    """The trajectory, with the verdict on it.

    imu: readings in the LiDAR's axes, or None; done: called with how many scans are registered
    Scans with fewer than 100 points are left out. The map's cells follow from the first scan's ranges.
    """
    full = (sweep for sweep in sweeps if len(sweep.points) >= _FEWEST)
    first = next(full, None)
    if first is None:
        return Estimate(np.zeros(0), np.zeros((0, 4, 4)), gate.judge((), False), 0.0)
    cell = float(np.clip(_CELL_PER_RANGE * np.median(np.linalg.norm(first.points, axis=1)), *_CELLS_M))
    steps: list[Step] = []
    for step in odometry(_from(first, full), cell, imu):
        steps.append(step)
        done(len(steps))
    verdict = gate.judge(steps, imu is not None and imu.forces is not None)
    poses = np.array([step.world_from_lidar for step in steps])
    return Estimate(np.array([step.time for step in steps]), poses, verdict, cell)


def _from(first: Sweep, others: Iterator[Sweep]) -> Iterator[Sweep]:
    yield first
    yield from others
