"""How much of the motion during scans is left in a recording: one fraction for all of its scans, or what the rough poses
had wrong of it.

Points are measured when their times say, or the rows of the depth image that they are in.
Measured in a few windows of successive scans, with poses, planes and the fraction found in turn. Where it is significant,
`scan_motions` measures how the sensor moved.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from lvba.arrays import Vector
from lvba.blocks.moving_windows import MovingWindows
from lvba.blocks.scan_windows import Window
from lvba.dataset import DESKEWED_BY, Dataset
from lvba.lidar import point_times, row_times, scan_motion
from lvba.lidar.config import LidarConfig
from lvba.lidar.point_times import PointClock
from lvba.lidar.range_errors import Beams, RangeErrors
from lvba.lidar.row_times import RowClock
from lvba.lidar.scan_evidence import ScanEvidence, nothing
from lvba.lidar.scan_motion import MOTIONS, MotionLeft
from lvba.progress import Progress, silent

_log = logging.getLogger(__name__)

_ROUNDS = 5
_CONVERGED = 2e-3
"""Rounds end when the fraction changes by less."""
_SUSPECT, _SURE = 2.0, 4.0
"""Standard deviations above which a fraction is looked at closer, and is corrected."""
_LEAST = 0.01
"""And at least so much: less moves scans by less than their noise."""
_MOST = 1.3
"""What is more is no motion that was left."""
_FALLS = 0.3
"""A fraction that is real falls to less than this part of itself once it is corrected."""
_BY_ROUGH = 0.5
"""From this fraction on, scans were deskewed by the rough poses: errors of the poses that a window is given, too, draw it
from 1 to zero. Simulated odometries came to 0.7 to 0.95."""


def measure(
    dataset: Dataset,
    probes: list[Window],
    sampled: Callable[[], list[Window]],
    config: LidarConfig,
    ranges: RangeErrors | None = None,
    progress: Progress = silent,
) -> MotionLeft | None:
    """Which fraction is left in the scans of a whole recording, of motions that are not known yet; None: nothing says
    when their points were measured.

    probes, sampled: of the recording, as `scan_windows` has them; ranges: errors of the sensor, which are taken out first
    Raises InputError: a scan cannot be read.
    """
    known = clock(dataset, probes)
    if known is None:
        return None
    if isinstance(known, str):
        return _not_corrected(None, problem=known)
    return _Measurement(MovingWindows(dataset, known, config), ranges, progress).of(probes, sampled)


def is_sure(motion: MotionLeft) -> bool:
    """Whether what was measured is no chance, so that points are to be moved by it."""
    if motion.fraction is None or motion.sigma is None or motion.problem:
        return False
    return bool(motion.by_rough) or _exceeds(motion.fraction, _SURE * motion.sigma)


def _exceeds(fraction: float, chance: float) -> bool:
    """Whether a fraction is as large as chance may make it, and large enough to matter."""
    return abs(fraction) >= max(_LEAST, chance)


def _not_corrected(
    clock: PointClock | RowClock | None,
    fraction: float | None = None,
    sigma: float | None = None,
    problem: str = "",
    by_rough: tuple[str, ...] = (),
) -> MotionLeft:
    """Points stay as they are, until motions are known."""
    return MotionLeft(
        clock=clock,
        fraction=fraction,
        sigma=sigma,
        motion=np.zeros((0, 6)),
        problem=problem,
        by_rough=by_rough,
    )


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


_OWN = slice(0, 1)
"""Of `scan_motion.motions`: the whole motion."""


@dataclass(frozen=True)
class _Measurement:
    """Finds poses, planes and the fractions in turn."""

    moving: MovingWindows
    ranges: RangeErrors | None
    progress: Progress

    def of(self, probes: list[Window], sampled: Callable[[], list[Window]]) -> MotionLeft:
        """By some windows; only where they tell of a fraction, by more of the recording."""
        probes = [each.corrected(self.ranges) for each in probes]
        if isinstance(self.moving.clock, PointClock) and (said := self.moving.dataset.deskewed_by):
            return self._as_said(probes, said)
        evidence, _ = self._of_windows(probes, np.zeros(MOTIONS), None)
        alone = evidence.of(_OWN)
        change, sigma = float(alone.change[0]), float(alone.sigma[0])
        suspect = isinstance(self.moving.clock, PointClock) and self._suspects_rough(evidence)
        if not (suspect or _exceeds(change, _SUSPECT * sigma)):
            return self._nothing(change, sigma)
        windows = [each.corrected(self.ranges) for each in sampled()]
        if suspect and (by_rough := self._by_rough(windows)) is not None:
            return by_rough
        return self._estimated(windows, change)

    def _as_said(self, windows: list[Window], by_rough: tuple[str, ...]) -> MotionLeft:
        """Scans that their recording says were deskewed by the rough poses: then no more is left."""
        said = _not_corrected(self.moving.clock, 0.0, by_rough=by_rough)
        evidence, _ = self._of_windows(windows, said.fractions, None)
        return replace(said, sigma=self._sigma(evidence))

    def _suspects_rough(self, evidence: ScanEvidence) -> bool:
        """Whether scans may be deskewed by the rough poses. Of bent scans, poses tell little of by how much."""
        return bool((np.abs(evidence.change) > _SUSPECT * evidence.sigma)[1:].any())

    def _by_rough(self, windows: list[Window]) -> MotionLeft | None:
        """With what of their motion scans were deskewed by the rough poses; None: with nothing. Then no more is left."""
        fractions, twists = np.zeros(MOTIONS), None
        for turn in range(_ROUNDS):
            self.progress("motion left in scans", turn, _ROUNDS)
            evidence, twists = self._of_windows(windows, fractions, twists)
            fractions = np.clip(evidence.change, -1.0, 1.0)
        sure = fractions > np.maximum(_BY_ROUGH, _SURE * evidence.sigma)
        by_rough = tuple(name for name, is_so in zip(DESKEWED_BY, sure[1:], strict=True) if is_so)
        if not by_rough:
            return None
        return _not_corrected(self.moving.clock, 0.0, self._sigma(evidence), by_rough=by_rough)

    def _estimated(self, windows: list[Window], first: float) -> MotionLeft:
        """The fraction of the motion, by windows in turn. first: where it begins"""
        fraction, twists, changes = first, None, [first]
        for turn in range(_ROUNDS):
            self.progress("motion left in scans", turn, _ROUNDS)
            evidence, twists = self._of_windows(windows, fraction * np.eye(MOTIONS)[0], twists)
            alone = evidence.of(_OWN)
            changes.append(float(alone.change[0]) - fraction)
            fraction += changes[-1]
            if abs(changes[-1]) < _CONVERGED:
                break
        return self._judged(fraction, self._sigma(alone), changes)

    def _sigma(self, evidence: ScanEvidence) -> float:
        """Standard deviation of the fraction: errors of ranges that no model has bend surfaces, as motion does."""
        return float(evidence.sigma[0]) * (1.0 if self.ranges is None else self.ranges.beside)

    def _nothing(self, fraction: float, sigma: float) -> MotionLeft:
        """Of a fraction that may be chance."""
        known = bool(np.isfinite(sigma))
        return _not_corrected(
            self.moving.clock, round(fraction, 6) if known else None, sigma if known else None
        )

    def _of_windows(
        self, windows: list[Window], fractions: Vector, twists: list[np.ndarray] | None
    ) -> tuple[ScanEvidence, list[np.ndarray]]:
        """What windows tell together, and their twists at the poses found.

        twists: None: of the poses that windows begin with
        """
        twists = twists or [self.moving.first_twists(window) for window in windows]
        pairs = [
            self._evidence(window, fractions, twist) for window, twist in zip(windows, twists, strict=True)
        ]
        evidence = sum((each for each, _ in pairs), nothing(MOTIONS))
        _log.info("motion left: %s after %s, +- %s", evidence.change, fractions, evidence.sigma)
        return evidence, [twist for _, twist in pairs]

    def _judged(self, fraction: float, sigma: float, changes: list[float]) -> MotionLeft:
        if np.isfinite(sigma) and not _exceeds(fraction, _SURE * sigma):
            return self._nothing(fraction, sigma)
        if not np.isfinite(sigma) or abs(fraction) > _MOST or abs(changes[-1]) > _FALLS * abs(changes[0]):
            problem = "no motion of the sensor explains what is left"
            return _not_corrected(self.moving.clock, round(fraction, 6), problem=problem)
        # digits that sums in another order would not give are left out
        return _not_corrected(self.moving.clock, round(fraction, 5), sigma)

    def _evidence(
        self, window: Window, fractions: Vector, twist: np.ndarray
    ) -> tuple[ScanEvidence, np.ndarray]:
        """Of a window, and its twists at the poses found."""
        rough = self.moving.rough_twists(window)
        taken_out = scan_motion.left(fractions, twist, rough)
        solved = self.moving.solved(window, taken_out)
        if solved is None:
            return nothing(MOTIONS), twist
        own = self.moving.twists(window, solved.result.world_from_scan)
        return scan_motion.evidence(self.moving.view(solved), solved.tau, own, rough, taken_out), own
