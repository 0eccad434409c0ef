"""How much of the motion during scans is left in a recording, and where its points belong: one part for all of its scans.

Points are measured when their times say, or the rows of the depth image that they are in.
Measured in a few windows of successive scans, with poses, planes and the part found in turn. Where it is significant, the
poses of all windows tell how the sensor moved.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from lvba.arrays import Poses, Times
from lvba.blocks import scan_windows
from lvba.blocks.scan_windows import Window
from lvba.dataset import Dataset
from lvba.lidar import path_motion, point_times, row_times, scan_motion
from lvba.lidar.bundle_adjustment import Aligned
from lvba.lidar.config import LidarConfig
from lvba.lidar.point_times import PointClock
from lvba.lidar.range_errors import Beams, RangeErrors
from lvba.lidar.row_times import RowClock
from lvba.lidar.scan import gather
from lvba.lidar.scan_evidence import ScanEvidence, View, nothing
from lvba.lidar.scan_motion import MotionLeft
from lvba.progress import Progress, silent

_log = logging.getLogger(__name__)

_ROUNDS = 5
_CONVERGED = 2e-3
"""Rounds end when the part changes by less."""
_SUSPECT, _SURE = 2.0, 4.0
"""Standard deviations above which a part is looked at closer, and is corrected."""
_LEAST = 0.01
"""And at least so much: less moves scans by less than their noise."""
_MOST = 1.3
"""What is more is no motion that was left."""
_TURNS = 3
"""Times that what is left of each scan's own motion is looked for."""
_SAME = 2e-3
"""rad/s and m/s: deviations that change by less are as they were."""
_PLAUSIBLE = 5.0
"""Times as far as scans are from the path of the others that deviations may be: cabinets told 10 and 27 times as much,
which was wrong, a loop as much, which was right."""
_AS_NEAR = 1.01
"""Times as far as before that points may be from planes: so much comes of which planes are seen."""
_FALLS = 0.3
"""A part that is one falls to less than this part of itself once it is corrected."""


def measure(
    dataset: Dataset,
    probes: list[Window],
    sampled: Callable[[], list[Window]],
    config: LidarConfig,
    ranges: RangeErrors | None = None,
    progress: Progress = silent,
) -> MotionLeft | None:
    """What is left in the scans of a whole recording; None: nothing says when their points were measured.

    probes, sampled: of the recording, as `scan_windows` has them; ranges: errors of the sensor, which are taken out first
    Raises InputError: a scan cannot be read.
    """
    known = clock(dataset, probes)
    if known is None:
        return None
    if isinstance(known, str):
        return _not_corrected(None, problem=known)
    measurement = _Measurement(dataset=dataset, clock=known, config=config, ranges=ranges, progress=progress)
    return measurement.of(probes, sampled)


def _not_corrected(
    clock: PointClock | RowClock | None,
    part: float | None = None,
    sigma: float | None = None,
    problem: str = "",
) -> MotionLeft:
    """Points stay as they are."""
    return MotionLeft(clock=clock, part=part, sigma=sigma, motion=np.zeros((0, 6)), problem=problem)


def clock(dataset: Dataset, windows: list[Window]) -> PointClock | RowClock | str | None:
    """By what points were measured when, why that is not known, or None: nothing tells."""
    scans = [scan for window in windows for scan in window.scans]
    stamps = np.concatenate([dataset.scans.times[window.numbers] for window in windows])
    known = point_times.find_clock([scan.time for scan in scans], stamps)
    if known == "":
        return rows(dataset, [scan.points for scan in scans])
    if not isinstance(known, str) and point_times.overlapping(known, dataset.scans.times):
        return "times of points span more than the time from scan to scan"
    return known


def rows(dataset: Dataset, points: list[np.ndarray]) -> RowClock | None:
    """Of a depth camera, by the points (N, 3) m of some scans in the order of their files."""
    beams = Beams.of(points, dataset.sensor_position_scan, dataset.sensor_axes_scan)
    return row_times.find_rows(points, beams, dataset.sensor_axes_scan)


class _Solved(NamedTuple):
    """A window's points (N, 3) m of each scan, moved; tau: (M,) s of all of them; poses and planes found by them."""

    points: list[np.ndarray]
    tau: np.ndarray
    result: Aligned


@dataclass
class _Measurement:
    """Finds poses, planes and the part in turn. poses: of windows of these scans, as they were found last"""

    dataset: Dataset
    clock: PointClock | RowClock
    config: LidarConfig
    ranges: RangeErrors | None
    progress: Progress
    poses: dict[tuple[int, ...], Poses] = field(default_factory=dict)

    def of(self, probes: list[Window], sampled: Callable[[], list[Window]]) -> MotionLeft:
        """By some windows; only where they tell of a part, by more of the recording."""
        probes = [each.corrected(self.ranges) for each in probes]
        evidence, _ = self._of_windows(probes, 0.0, None)
        change, sigma = float(evidence.change[0]), float(evidence.sigma[0])
        if not abs(change) >= max(_LEAST, _SUSPECT * sigma):
            return self._nothing(change, sigma)
        windows = [each.corrected(self.ranges) for each in sampled()]
        part, twists, changes = change, None, [change]
        for turn in range(_ROUNDS):
            self.progress("motion left in scans", turn, _ROUNDS)
            evidence, twists = self._of_windows(windows, part, twists)
            changes.append(float(evidence.change[0]))
            part += changes[-1]
            if abs(changes[-1]) < _CONVERGED:
                break
        return self._judged(part, float(evidence.sigma[0]), changes, windows)

    def _nothing(self, part: float, sigma: float) -> MotionLeft:
        """Of a part that may be chance."""
        known = bool(np.isfinite(sigma))
        return _not_corrected(self.clock, round(part, 6) if known else None, sigma if known else None)

    def _of_windows(
        self, windows: list[Window], part: float, twists: list[np.ndarray] | None
    ) -> tuple[ScanEvidence, list[np.ndarray]]:
        """What windows tell together, and their twists at the poses found.

        twists: None: of the poses that windows begin with
        """
        twists = twists or [self._first_twists(window) for window in windows]
        pairs = [self._evidence(*each) for each in zip(windows, [part] * len(windows), twists, strict=True)]
        evidence = sum((each for each, _ in pairs), nothing(1))
        _log.info("motion left: %.4f and %.5f more, +- %.5f", part, evidence.change[0], evidence.sigma[0])
        return evidence, [twist for _, twist in pairs]

    def _judged(self, part: float, sigma: float, changes: list[float], sampled: list[Window]) -> MotionLeft:
        if np.isfinite(sigma) and not abs(part) >= max(_LEAST, _SURE * sigma):
            return self._nothing(part, sigma)
        if not np.isfinite(sigma) or abs(part) > _MOST or abs(changes[-1]) > _FALLS * abs(changes[0]):
            problem = "no motion of the sensor explains what is left"
            return _not_corrected(self.clock, round(part, 6), problem=problem)
        # digits that sums in another order would not give are left out
        part = round(part, 5)
        motion, deviation, pose_covariance = self._motions(part, sampled)
        return MotionLeft(
            clock=self.clock,
            part=part,
            sigma=sigma,
            motion=np.round(motion + deviation[:, :6], 7),
            acceleration=np.round(2.0 / self.clock.sweep * deviation[:, 6:], 6),
            pose_covariance=pose_covariance,
        )

    def _motions(self, part: float, sampled: list[Window]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """By what points of all scans are moved: the motion of the path between scans, (S, 6), rad/s and m/s; what each
        scan's own points tell beside it, (S, 12), as `scan_motion.Deviations` has it; and what the uncertainty of these
        adds to the covariances of the scans' poses, (S, 6, 6).

        A scan's own points tell much where scans are further apart than the sensor takes to change its motion.
        sampled: windows whose points are corrected already
        """
        count = len(self.dataset.scan_paths)
        windows, corrected = scan_windows.cores(count), {each.own: each for each in sampled}
        motion, deviation, covariance = np.zeros((count, 6)), np.zeros((count, 12)), np.zeros((count, 6, 6))
        for number, core in enumerate(windows):
            self.progress("motion during scans", number, len(windows))
            window = corrected.get(core) or Window.of(self.dataset, core, self.config).corrected(self.ranges)
            own, inside = slice(*core), window.core
            path = self._of_path(part, window)
            motion[own] = path[inside]
            deviation[own], covariance[own] = (each[inside] for each in self._deviations(part, window, path))
        return motion, deviation, covariance

    def _of_path(self, part: float, window: Window) -> np.ndarray:
        """(n, 6), rad/s and m/s: that part of the motion of the path through the scans of a window."""
        first = self._first_twists(window)
        solved = self._solved(window, part * first)
        return part * (first if solved is None else self._twists(window, solved.result.world_from_scan))

    def _wider(self, part: float, window: Window) -> np.ndarray:
        """(n, 2) rad/s and m/s, as of `scan_motion.most_likely`: of the first and the last scan of the recording."""
        wider, ends = np.zeros((len(window.numbers), 2)), (0, len(self.dataset.scan_paths) - 1)
        if not np.isin(ends, window.numbers).any():
            return wider
        times = self.dataset.scans.times[window.numbers]
        for end, off in zip(
            ends, path_motion.beyond_ends(times, self._latest(window), self.clock), strict=True
        ):
            wider[window.numbers == end] = abs(part) * off
        return wider

    def _deviations(self, part: float, window: Window, path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Deviations (n, 12) of a window's scans from a motion (n, 6), rad/s and m/s, and what their uncertainty adds to
        the covariances of the poses, (n, 6, 6).

        They are looked for with those found so far taken out, for planes are sharper then. How much planes tell of
        deviations says nothing of whether they are right: where poses are off, planes are, too, and a window told more
        and more of up to 38 m/s. So they are as large as the path from scan to scan allows, but for the first and last
        scan, of which it tells less; and points stay as near to planes.
        """
        sweep, scale, least, most = self.clock.sweep, None, np.inf, self._most(window)
        deviation, covariance = np.zeros((len(path), 12)), np.zeros((len(path), 6, 6))
        used, wider = (deviation, covariance), self._wider(part, window)
        inner = ~wider.any(axis=1)
        for _ in range(_TURNS):
            motion, acceleration = path + deviation[:, :6], 2.0 / sweep * deviation[:, 6:]
            solved = self._solved(window, motion, acceleration)
            if solved is None:
                break
            view = self._view(solved)
            scale = view.thickness if scale is None else scale
            if not (away := view.away(scale)) < _AS_NEAR * least:
                break
            least, used = min(away, least), (deviation, covariance)
            seen = scan_motion.deviations(view, solved.tau, sweep).beside(deviation)
            deviation, covariance = scan_motion.most_likely(seen, wider)
            if (path_motion.sizes(deviation[inner]) > most).any():
                deviation[inner], covariance[inner] = used[0][inner], used[1][inner]
            if np.abs(deviation - used[0]).max() < _SAME:
                break
        return used

    def _most(self, window: Window) -> np.ndarray:
        """(4,) rad/s, m/s, and what these grow by over a sweep: sizes that deviations of a window's scans may have."""
        times = self.dataset.scans.times[window.numbers]
        sizes = [
            path_motion.unpredicted(times, poses, self.clock)
            for poses in (window.begin, self._latest(window))
        ]
        return np.asarray(_PLAUSIBLE * np.min(sizes, axis=0))

    def _latest(self, window: Window) -> Poses:
        """(n, 4, 4), of a window's scans, as they were found last; those it begins with before that."""
        return self.poses.get(tuple(window.numbers.tolist()), window.begin)

    def _evidence(self, window: Window, part: float, twist: np.ndarray) -> tuple[ScanEvidence, np.ndarray]:
        """Of a window, and its twists at the poses found."""
        solved = self._solved(window, part * twist)
        if solved is None:
            return nothing(1), twist
        own = self._twists(window, solved.result.world_from_scan)
        return scan_motion.evidence(self._view(solved), solved.tau, own), own

    def _view(self, solved: _Solved) -> View:
        result = solved.result
        return View.of(
            *(gather(solved.points), result.world_from_scan, result.planes, result.plane_points),
            self.dataset.sensor_position_scan,
        )

    def _solved(
        self, window: Window, motion: np.ndarray, acceleration: np.ndarray | None = None
    ) -> _Solved | None:
        """A window with its points moved by a motion; None where planes do not tell."""
        scans = tuple(window.numbers.tolist())
        points, tau = self._corrected(window, motion, acceleration)
        result = window.refined(self.dataset, points, self.config, self.poses.get(scans))
        if result is None:
            return None
        self.poses[scans] = result.world_from_scan
        return _Solved(points, np.concatenate(tau), result)

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

    def _twists(self, window: Window, world_from_scan: Poses) -> np.ndarray:
        """(n, 6), rad/s and m/s, scan frames: mean motion during the sweeps, by poses (n, 4, 4)."""
        return path_motion.sweep_twists(self.dataset.scans.times[window.numbers], world_from_scan, self.clock)

    def _first_twists(self, window: Window) -> np.ndarray:
        return self._twists(window, window.begin)


def point_times_of(window: Window, stamps: Times, clock: PointClock | RowClock) -> list[np.ndarray]:
    """Of each scan of a window, (N,) s from its stamp; stamps: (n,) s."""
    return [
        clock.from_stamp(scan.points, scan.time, stamp)
        for scan, stamp in zip(window.scans, stamps, strict=True)
    ]
