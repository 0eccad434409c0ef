"""How much of the motion during scans is left in a recording, and where its points belong: one part for all of its scans.

Measured in a few windows of successive scans, with poses, planes and the part found in turn. Where it is significant, the
poses of all windows tell how the sensor moved.
"""

import logging
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lvba import geometry, spline
from lvba.arrays import Poses, Tangents, Times
from lvba.dataset import Dataset, Scan
from lvba.errors import DegenerateProblemError
from lvba.io import dataset as recordings
from lvba.lidar import bundle_adjustment, point_times, scan_motion
from lvba.lidar.bundle_adjustment import LidarResult
from lvba.lidar.config import LidarConfig
from lvba.lidar.point_times import PointClock
from lvba.lidar.scan import gather
from lvba.lidar.scan_motion import NOTHING, Evidence, MotionLeft
from lvba.parallel import in_order
from lvba.progress import Progress, silent
from lvba.trajectory import Trajectory

_log = logging.getLogger(__name__)

_CORE, _MARGIN, _SAMPLED = 24, 4, 2
"""Scans of a window, those on either side that help to solve it, and windows that tell of the part."""
_PROBE, _PROBE_STEP_S = 14, 0.4
"""Scans of a window that tells whether there is a part at all, and about the time between them."""
_MOST_POINTS, _PROBE_POINTS = 30_000, 6_000
"""Of a scan, to measure with."""
_ROUNDS = 5
_SETTLED = 2e-3
"""Rounds end when the part changes by less."""
_SURE = 4.0
"""Standard deviations above which a part is corrected."""
_LEAST = 0.01
"""And at least so much: less moves scans by less than their noise."""
_MOST = 1.3
"""What is more is no motion that was left."""
_FALLS = 0.3
"""A part that is one falls to less than this part of itself once it is corrected."""


def measure(
    dataset: Dataset, config: LidarConfig, enabled: bool = True, progress: Progress = silent
) -> MotionLeft | None:
    """What is left in the scans of a whole recording; None: their points have no times that would tell.

    enabled: False: scan poses are not refined, and nothing is measured
    Raises InputError: a scan cannot be read.
    """
    if not enabled or not recordings.has_point_times(dataset):
        return None
    probes = [_Window.probe(dataset, place) for place in (np.arange(_SAMPLED) + 1) / (_SAMPLED + 1)]
    clock = _clock(dataset, probes)
    if isinstance(clock, str):
        return _unknown(clock)
    return _Measurement(dataset, clock, config, progress).of(probes)


def _unknown(problem: str) -> MotionLeft:
    return MotionLeft(None, None, None, np.zeros((0, 6)), problem)


def _clock(dataset: Dataset, windows: list["_Window"]) -> PointClock | str:
    times = [scan.time for window in windows for scan in window.scans]
    stamps = np.concatenate([dataset.scans.times[window.numbers] for window in windows])
    clock = point_times.find_clock(times, stamps)
    if not isinstance(clock, str) and point_times.overlapping(clock, dataset.scans.times):
        return "times of points span more than the time from scan to scan"
    return clock


def _windows(count: int) -> list[tuple[int, int]]:
    """Cores that share all scans."""
    pieces = max(1, round(count / _CORE))
    bounds = [count * k // pieces for k in range(pieces + 1)]
    return list(pairwise(bounds))


@dataclass(frozen=True)
class _Window:
    """Some scans of a recording, thinned. numbers: (n,), ascending; core: those that no other window has, in numbers"""

    numbers: np.ndarray
    core: slice
    scans: list[Scan]

    @staticmethod
    def of(dataset: Dataset, core: tuple[int, int]) -> "_Window":
        """Successive scans with a margin on either side."""
        numbers = np.arange(max(core[0] - _MARGIN, 0), min(core[1] + _MARGIN, len(dataset.scan_paths)))
        inside = slice(core[0] - int(numbers[0]), core[1] - int(numbers[0]))
        return _Window(numbers, inside, _thinned(dataset, numbers, _MOST_POINTS))

    @staticmethod
    def probe(dataset: Dataset, place: float) -> "_Window":
        """Few scans about a place, 0 to 1, of the recording."""
        count = len(dataset.scan_paths)
        interval = float(np.median(np.diff(dataset.scans.times))) if count > 1 else _PROBE_STEP_S
        step = int(np.clip(round(_PROBE_STEP_S / max(interval, 1e-3)), 1, max(1, count // _PROBE)))
        first = round(place * max(count - _PROBE * step, 0))
        numbers = np.arange(first, min(first + _PROBE * step, count), step)
        return _Window(numbers, slice(0, len(numbers)), _thinned(dataset, numbers, _PROBE_POINTS))


def _thinned(dataset: Dataset, numbers: np.ndarray, most: int) -> list[Scan]:
    """Some scans with so many points at most."""

    def load(number: int) -> Scan:
        scan = recordings.load_scan(dataset, number)
        if len(scan) <= most:
            return Scan(scan.points, None, scan.time)
        kept = np.sort(np.random.default_rng(number).permutation(len(scan))[:most])
        return Scan(scan.points[kept], None, None if scan.time is None else scan.time[kept])

    return list(in_order(load, [int(number) for number in numbers]))


@dataclass
class _Measurement:
    """Finds poses, planes and the part in turn."""

    dataset: Dataset
    clock: PointClock
    config: LidarConfig
    progress: Progress

    def of(self, probes: list[_Window]) -> MotionLeft:
        """By some windows; only where they tell of a part, by more of the recording."""
        evidence, _ = self._of_windows(probes, 0.0, None)
        sigma = evidence.sigma if np.isfinite(evidence.sigma) else None
        if not abs(evidence.change) >= max(_LEAST, _SURE * evidence.sigma):
            part = None if sigma is None else round(evidence.change, 6)
            return MotionLeft(self.clock, part, sigma, np.zeros((0, 6)))
        windows = _windows(len(self.dataset.scan_paths))
        chosen = np.unique(np.linspace(0, len(windows) - 1, _SAMPLED + 2)[1:-1].astype(int))
        sampled = [_Window.of(self.dataset, windows[number]) for number in chosen]
        part, twists, changes = evidence.change, None, [evidence.change]
        for turn in range(_ROUNDS):
            self.progress("motion left in scans", turn, _ROUNDS)
            evidence, twists = self._of_windows(sampled, part, twists)
            part += evidence.change
            changes.append(evidence.change)
            if abs(evidence.change) < _SETTLED:
                break
        return self._judged(part, evidence.sigma, changes, windows)

    def _of_windows(
        self, windows: list[_Window], part: float, twists: list[np.ndarray] | None
    ) -> tuple[Evidence, list[np.ndarray]]:
        """What windows tell together, and their twists at the poses found. twists: None: of the rough poses"""
        twists = twists or [self._rough_twists(window) for window in windows]
        pairs = [self._evidence(*each) for each in zip(windows, [part] * len(windows), twists, strict=True)]
        evidence = sum((each for each, _ in pairs), NOTHING)
        _log.info("motion left: %.4f and %.5f more, +- %.5f", part, evidence.change, evidence.sigma)
        return evidence, [twist for _, twist in pairs]

    def _judged(
        self, part: float, sigma: float, changes: list[float], windows: list[tuple[int, int]]
    ) -> MotionLeft:
        if not np.isfinite(sigma) or abs(part) > _MOST or abs(changes[-1]) > _FALLS * abs(changes[0]):
            problem = "no motion of the sensor explains what is left"
            return MotionLeft(self.clock, round(part, 6), None, np.zeros((0, 6)), problem)
        # digits that sums in another order would not give are left out
        part = round(part, 5)
        return MotionLeft(self.clock, part, sigma, np.round(self._motions(part, windows), 7))

    def _motions(self, part: float, windows: list[tuple[int, int]]) -> np.ndarray:
        """(S, 6), rad/s and m/s: by what points of all scans are moved, from the poses of all windows.

        The motion of the path between scans first; then what each scan's own points tell beside it, which is much where
        scans are further apart than the sensor takes to change its motion.
        """
        count = len(self.dataset.scan_paths)
        motions, information, gradient = (
            np.zeros((count, 6)),
            np.zeros((count, 6, 6)),
            np.zeros((count, 6)),
        )
        for number, core in enumerate(windows):
            self.progress("motion during scans", number, len(windows))
            window = _Window.of(self.dataset, core)
            own, inside, rough = slice(*core), window.core, self._rough_twists(window)
            motions[own] = part * rough[inside]
            _, twist = self._solved(window, part, rough)
            if twist is None:
                continue
            motions[own] = part * twist[inside]
            result, _ = self._solved(window, part, twist)
            if result is None:
                continue
            points, tau = self._corrected(window, part, twist)
            terms = scan_motion.deviations(
                *(gather(points), np.concatenate(tau), result.world_from_scan),
                *(result.planes, result.plane_points),
            )
            information[own], gradient[own] = terms[0][inside], terms[1][inside]
        return np.asarray(motions + scan_motion.most_likely(information, gradient))

    def _evidence(self, window: _Window, part: float, twist: np.ndarray) -> tuple[Evidence, np.ndarray]:
        """Of a window, and its twists at the poses found."""
        result, own = self._solved(window, part, twist)
        if result is None or own is None:
            return NOTHING, twist
        points, tau = self._corrected(window, part, twist)
        evidence = scan_motion.evidence(
            gather(points),
            np.concatenate(tau),
            own,
            result.world_from_scan,
            result.planes,
            result.plane_points,
        )
        return evidence, own

    def _solved(
        self, window: _Window, part: float, twist: np.ndarray
    ) -> tuple[LidarResult | None, np.ndarray | None]:
        try:
            result = bundle_adjustment.refine(
                self._corrected(window, part, twist)[0],
                self.dataset.scans.world_from_sensor[window.numbers],
                sensor_position=self.dataset.sensor_position_scan,
                config=self.config,
            )
        except DegenerateProblemError:
            return None, None
        return result, self._twists(window, result.world_from_scan)

    def _corrected(
        self, window: _Window, part: float, twist: np.ndarray
    ) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Points and their tau, scan by scan."""
        stamps = self.dataset.scans.times[window.numbers]
        tau = [
            np.zeros(len(scan)) if scan.time is None else self.clock.from_stamp(scan.time, stamp)
            for scan, stamp in zip(window.scans, stamps, strict=True)
        ]
        if part == 0.0:
            return [scan.points for scan in window.scans], tau
        moved = [
            scan_motion.moved(scan.points, each, part * own)
            for scan, each, own in zip(window.scans, tau, twist, strict=True)
        ]
        return moved, tau

    def _twists(self, window: _Window, world_from_scan: Poses) -> np.ndarray:
        """(n, 6), rad/s and m/s, scan frames: mean motion during the sweeps, by poses (n, 4, 4)."""
        return sweep_twists(self.dataset.scans.times[window.numbers], world_from_scan, self.clock)

    def _rough_twists(self, window: _Window) -> np.ndarray:
        return self._twists(window, self.dataset.scans.world_from_sensor[window.numbers])


def sweep_twists(times: Times, world_from_scan: Poses, clock: PointClock) -> Tangents:
    """(S, 6), rad/s and m/s, scan frames: mean motion during sweeps, by splines through poses (S, 4, 4) at (S,) s."""
    if len(times) < spline.FEWEST_SAMPLES or times[-1] - times[0] < 2 * clock.sweep:
        return np.zeros((len(times), 6))
    begin, path = times + clock.begin, Trajectory(times, world_from_scan)
    before, after = (
        spline.through(path, moment, beyond=clock.sweep) for moment in (begin, begin + clock.sweep)
    )
    return np.asarray(geometry.log(geometry.inverse(before) @ after) / clock.sweep)
