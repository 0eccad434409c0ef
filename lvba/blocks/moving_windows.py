"""Windows of scans solved with their points moved by a motion during each scan."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from lvba.arrays import Poses, Times
from lvba.blocks.scan_windows import Window
from lvba.dataset import Dataset
from lvba.lidar import path_motion, scan_motion
from lvba.lidar.bundle_adjustment import Aligned
from lvba.lidar.config import LidarConfig
from lvba.lidar.point_times import PointClock
from lvba.lidar.row_times import RowClock
from lvba.lidar.scan import gather
from lvba.lidar.scan_evidence import View


class Solved(NamedTuple):
    """A window's points (N, 3) m of each scan, moved; tau: (M,) s of all of them; poses and planes found by them."""

    points: list[np.ndarray]
    tau: np.ndarray
    result: Aligned


@dataclass
class MovingWindows:
    """Finds poses and planes of windows. poses: of windows of these scans, as they were found last"""

    dataset: Dataset
    clock: PointClock | RowClock
    config: LidarConfig
    poses: dict[tuple[int, ...], Poses] = field(default_factory=dict)

    def latest(self, window: Window) -> Poses:
        """(n, 4, 4) float64, m, of a window's scans, as they were found last; those it begins with before that."""
        return self.poses.get(tuple(window.numbers.tolist()), window.begin)

    def view(self, solved: Solved) -> View:
        """Planes of a window, and its points on them."""
        result = solved.result
        return View.of(
            *(gather(solved.points), result.world_from_scan, result.planes, result.plane_points),
            self.dataset.sensor_position_scan,
        )

    def solved(
        self, window: Window, motion: np.ndarray, acceleration: np.ndarray | None = None
    ) -> Solved | None:
        """A window with its points moved by a motion; None where planes do not tell.

        motion: (n, 6) float64, rad/s and m/s, scan frames; acceleration: (n, 6) float64, rad/s^2 and m/s^2; None: none
        """
        scans = tuple(window.numbers.tolist())
        points, tau = self._corrected(window, motion, acceleration)
        result = window.refined(self.dataset, points, self.config, self.poses.get(scans))
        if result is None:
            return None
        self.poses[scans] = result.world_from_scan
        return Solved(points, np.concatenate(tau), result)

    def _corrected(
        self, window: Window, motion: np.ndarray, acceleration: np.ndarray | None = None
    ) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Points and their tau, scan by scan. motion, acceleration: (n, 6), as of `scan_motion.moved`; None: none"""
        tau = point_times_of(window, self.dataset.scans.times[window.numbers], self.clock)
        if not motion.any():
            return [scan.points for scan in window.scans], tau
        growing = np.zeros_like(motion) if acceleration is None else acceleration
        moved = [
            scan_motion.moved(scan.points, *each)
            for scan, *each in zip(window.scans, tau, motion, growing, strict=True)
        ]
        return moved, tau

    def twists(self, window: Window, world_from_scan: Poses) -> np.ndarray:
        """(n, 6) float64, rad/s and m/s, scan frames: mean motion during the sweeps.

        world_from_scan: (n, 4, 4) float64, m
        """
        return path_motion.sweep_twists(self.dataset.scans.times[window.numbers], world_from_scan, self.clock)

    def rough_twists(self, window: Window) -> np.ndarray:
        """(n, 6) float64, rad/s and m/s: the same, by the rough poses, without their jumps."""
        rough = self.dataset.scans.world_from_sensor[window.numbers]
        return self.twists(window, path_motion.without_jumps(rough, self.latest(window)))

    def first_twists(self, window: Window) -> np.ndarray:
        """(n, 6) float64, rad/s and m/s: the same, by the poses that a window begins with."""
        return self.twists(window, window.begin)


def point_times_of(window: Window, stamps: Times, clock: PointClock | RowClock) -> list[np.ndarray]:
    """Of each scan of a window, (N,) s from its stamp; stamps: (n,) s."""
    return [
        clock.from_stamp(scan.points, scan.time, stamp)
        for scan, stamp in zip(window.scans, stamps, strict=True)
    ]
