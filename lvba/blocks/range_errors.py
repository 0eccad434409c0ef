"""Which systematic errors of the range sensor the scans of a recording show: measured, corrected, measured again.

All errors together in a few windows of successive scans, the motion left in scans beside them where points have times,
with poses and planes free. What cannot be chance is taken out of the points, until no more is left.
"""

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from lvba.arrays import Poses
from lvba.blocks import motion_left, moving_windows
from lvba.blocks.scan_windows import Window
from lvba.dataset import Dataset
from lvba.lidar import (
    beam_depth,
    incidence,
    path_motion,
    pose_response,
    range_errors,
    range_uncertainty,
    scan_evidence,
    scan_motion,
)
from lvba.lidar.bundle_adjustment import Aligned
from lvba.lidar.config import LidarConfig
from lvba.lidar.point_times import PointClock
from lvba.lidar.range_errors import Beams, RangeErrors
from lvba.lidar.range_uncertainty import Response, Sight
from lvba.lidar.row_times import RowClock
from lvba.lidar.scan import gather
from lvba.lidar.scan_evidence import ByShared, Moved, OnPlanes, ScanEvidence, View
from lvba.progress import Progress, silent

_log = logging.getLogger(__name__)

_ROUNDS = 6
_CONVERGED = 0.03
"""Rounds end when no error changes by more than this part of itself."""
_SUSPECT = 1e-2
"""How often the first look at a right sensor may ask for a closer one."""
_CERTAIN_M = 2e-3
"""And how far cameras, along any axis, or the scans of the whole recording may be off by what it leaves open; if more, a
second look at more points follows. In rooms, beams 0.1 degrees too high put cameras 6 mm off, at 1.6 standard deviations
of the first look and 6 of the closest. On a street, which bends by such errors, the first look leaves 10 mm open."""
_EVERY = 2
"""Every so many points are enough for the second look."""


def measure(
    dataset: Dataset,
    probes: list[Window],
    sampled: Callable[[], list[Window]],
    config: LidarConfig,
    progress: Progress = silent,
) -> RangeErrors:
    """The errors of a recording's sensor. probes, sampled: of the recording, as `scan_windows` has them

    Raises InputError: a scan cannot be read.
    """
    points = [scan.points for window in probes for scan in window.scans]
    beams = Beams.of(points, dataset.sensor_position_scan, dataset.sensor_axes_scan)
    beams = replace(beams, usual=_usual_brightness(probes, beams))
    clock = motion_left.clock(dataset, probes)
    known = None if isinstance(clock, str) else clock
    measurement = _Measurement(dataset=dataset, beams=beams, clock=known, config=config, progress=progress)
    return measurement.of(probes, sampled)


def _alike(part: float, off: float) -> np.ndarray:
    """(6, 6): as `RangeErrors.planes_off`, of planes that are off alike along and about all axes, by a part of the range
    and by so many m."""
    return np.diag(np.repeat(np.square([part, off]), 3))


def _leaves_open(errors: RangeErrors) -> bool:
    """Whether cameras or scans may be further off by what is not known of errors than is certain enough."""
    return max(float(np.diagonal(errors.planes_off)[3:].max()), errors.poses_off[1] ** 2) > _CERTAIN_M**2


def _usual_brightness(probes: list[Window], beams: Beams) -> float | None:
    """By one scan of each window; None: scans have no intensities that differ."""
    scans = [window.scans[len(window.scans) // 2] for window in probes if window.intensity is not None]
    if not scans or len(scans) < len(probes):
        return None
    cosine = np.concatenate([incidence.cosines(scan.points, beams.position) for scan in scans])
    return range_errors.usual_brightness(np.concatenate([scan.intensity for scan in scans]), cosine)


@dataclass
class _Measurement:
    """Finds poses, planes and the errors in turn.

    cosines: of each window, of its points on planes; poses: of its scans, in the round before
    depths: of each window, as `beam_depth.Depths.squares`; responses: of each, of a camera to errors
    poses_by_depth: as of `RangeErrors.poses_off`, by that
    by_grazing: (k,) float64, of the round before: how errors would move by a range that is too long on surfaces met at
        grazing angles
    """

    dataset: Dataset
    beams: Beams
    clock: PointClock | RowClock | None
    config: LidarConfig
    progress: Progress
    cosines: dict[int, np.ndarray] = field(default_factory=dict)
    poses: dict[int, Poses] = field(default_factory=dict)
    depths: dict[int, np.ndarray] = field(default_factory=dict)
    responses: dict[int, Response] = field(default_factory=dict)
    poses_by_depth: tuple[float, float] = (0.0, 0.0)
    by_grazing: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def of(self, probes: list[Window], sampled: Callable[[], list[Window]]) -> RangeErrors:
        """By some windows; only where they tell of an error, or too little, by larger ones."""
        return self._with_depth(self._of(probes, sampled))

    def _of(self, probes: list[Window], sampled: Callable[[], list[Window]]) -> RangeErrors:
        scans = [scan for window in probes for scan in window.scans]
        together = np.concatenate([scan.points for scan in scans]) if scans else np.zeros((0, 3))
        known = [each for window in probes if (each := window.intensity) is not None]
        intensity = np.concatenate(known) if self.beams.usual is not None else None
        shifts = range_errors.typical_shifts(self.beams, together, intensity) if scans else np.zeros(0)
        least = range_errors.LEAST_M / np.maximum(shifts, 1e-9)
        errors = self._if_right(probes, least)
        if errors is not None and _leaves_open(errors):
            errors = self._if_right([window.every(_EVERY) for window in sampled()[:1]], least)
        return self._closer(sampled(), least, together) if errors is None else errors

    def _if_right(self, windows: list[Window], least: np.ndarray) -> RangeErrors | None:
        """What the errors may be as these windows have it; None where they are no chance."""
        self._forget()
        total = self._total(windows, np.zeros(self.size))
        own = total.of(self.own)
        estimate, covariance = self._estimate(own)
        if not np.isfinite(covariance).all():
            return self._unknown(own)
        kept, _ = self._significant(estimate, covariance, least, _SUSPECT)
        if kept.any() or total.chance(self.others) <= _SUSPECT:
            return None
        return self._uncertain(self._errors(estimate, covariance, kept), estimate, covariance, own)

    def _forget(self) -> None:
        """What is known of windows, before others are looked at."""
        for known in (self.cosines, self.poses, self.depths, self.responses):
            known.clear()

    def _closer(self, windows: list[Window], least: np.ndarray, points: np.ndarray) -> RangeErrors:
        errors = np.zeros(self.size)
        rounds = [errors]
        self._forget()
        for turn in range(_ROUNDS):
            self.progress("errors of ranges", turn, _ROUNDS)
            total = self._total(windows, errors)
            if turn == 0 and self.beams.plain and total.chance(self.others) <= range_errors.CHANCE:
                # with errors of its direction that no model has, a real sensor seemed to be 8 cm off
                self.beams = replace(self.beams, plain=False)
                return self._closer(windows, least[: self.size], points)
            change, covariance = self._estimate(total.of(self.own))
            if not np.isfinite(covariance).all():
                return self._unknown(total, "planes do not tell of them once they are corrected")
            kept, estimate = self._significant(errors + change, covariance, least, range_errors.CHANCE)
            errors = estimate
            rounds.append(errors)
            _log.info("errors of ranges: %s +- %s", errors, np.sqrt(np.diagonal(covariance)))
            if (np.abs(errors - rounds[-2]) <= _CONVERGED * np.abs(errors)).all():
                break
        if (by_direction := self._by_direction(total, points))[1] > 0:
            return self._beside_others(total, errors, least, by_direction)
        covariance = covariance + self._of_grazing(errors)
        if (kept & ~range_errors.falls(np.stack(rounds))).any():
            text = "no error of the sensor explains what is left"
            left = replace(self._errors(errors, covariance, kept & False), problem=text)
            return self._uncertain(left, errors + change, covariance, total)
        measured = self._errors(np.where(kept, errors, errors + change), covariance, kept)
        return self._uncertain(measured, errors + change, covariance, total)

    def _unknown(self, total: ScanEvidence, problem: str = "") -> RangeErrors:
        """Errors of which planes tell nothing: as usual ones are."""
        nothing = np.zeros(self.size)
        return self._uncertain(
            RangeErrors(self.beams, problem=problem), nothing, np.diag(nothing + np.inf), total
        )

    def _uncertain(
        self, errors: RangeErrors, estimate: np.ndarray, covariance: np.ndarray, total: ScanEvidence
    ) -> RangeErrors:
        """The errors, with how far points and poses may be off by what is left of them.

        estimate, covariance: (k,) and (k, k), of all together
        """
        names = self.beams.names
        corrected = np.array([errors.values[name] if name in errors.corrected else 0.0 for name in names])
        moment = range_uncertainty.moment(
            range_uncertainty.usual(self.beams), estimate, covariance, corrected
        )
        response = sum(self.responses.values(), range_uncertainty.none(self.size))
        return replace(
            errors,
            planes_off=response.off(moment),
            poses_off=total.poses.of_numbers(slice(0, self.size)).by(moment, self._extent),
        )

    @property
    def _depth(self) -> float:
        """m, root mean square over points, that beams go into surfaces."""
        squares, points = sum(self.depths.values(), np.zeros(2))
        return math.sqrt(squares / max(points, 1.0))

    def _with_depth(self, errors: RangeErrors) -> RangeErrors:
        """The errors, with how deep beams go into surfaces, if they do."""
        if (depth := self._depth) < range_errors.LEAST_M:
            return errors
        (turn, shift), by_depth = errors.poses_off, self.poses_by_depth
        return replace(
            errors,
            values={**errors.values, range_errors.DEPTH: round(depth, 4)},
            noticed=(*errors.noticed, range_errors.DEPTH),
            planes_off=errors.planes_off + _alike(0.0, depth),
            poses_off=(math.hypot(turn, by_depth[0]), math.hypot(shift, by_depth[1])),
        )

    def _beside_others(
        self, total: ScanEvidence, errors: np.ndarray, least: np.ndarray, by_direction: tuple[float, float]
    ) -> RangeErrors:
        """What is significant whatever else depends on the direction of a beam, which is free and stays as it is."""
        change, covariance = self._estimate(total)
        covariance = range_errors.BESIDE**2 * covariance
        if not np.isfinite(covariance).all():
            kept, estimate = np.zeros(self.size, bool), errors
        else:
            kept, estimate = self._significant(errors + change, covariance, least, range_errors.CHANCE)
        judged = self._errors(np.where(kept, estimate, errors + change), covariance, kept)
        likely = self._likely(total)
        values = {**judged.values, range_errors.DIRECTION: round(by_direction[1], 4)}
        return replace(
            judged,
            values=values,
            noticed=(range_errors.DIRECTION,),
            planes_off=_alike(*by_direction),
            poses_off=total.poses.by(np.outer(likely, likely), self._extent),
        )

    @property
    def _extent(self) -> float:
        """m, of the whole recording."""
        return pose_response.extent_of(self.dataset.scans.world_from_sensor)

    @cached_property
    def _sight(self) -> Sight:
        """Of the camera; all around where there is none."""
        if not self.dataset.cameras:
            return range_uncertainty.EVERYWHERE
        return range_uncertainty.sight(self.dataset.camera_from_scan, self.dataset.camera.half_angle)

    @property
    def size(self) -> int:
        """How many errors are measured."""
        return len(self.beams.names)

    @property
    def own(self) -> slice:
        """Of the shared numbers, the errors, the motion left in scans, and how deep beams go into surfaces."""
        return slice(0, self.size + (self.clock is not None) + 1)

    @property
    def others(self) -> slice:
        """Of the shared numbers, what else depends on the direction of a beam."""
        return slice(self.own.stop, self.own.stop + range_errors.HARMONICS)

    def _estimate(self, own: ScanEvidence) -> tuple[np.ndarray, np.ndarray]:
        """The change (k,) of the errors, and its covariance (k, k)."""
        beside = range_errors.BESIDE if self._depth >= range_errors.LEAST_M else 1.0
        return own.change[: self.size], beside**2 * own.covariance[: self.size, : self.size]

    def _by_direction(self, total: ScanEvidence, points: np.ndarray) -> tuple[float, float]:
        """How far points (N, 3) m are off by it, root mean square, as a part of the range and in m; zeros: what is seen
        of it may be chance.

        Less the common scale in it, which planes do not tell: where beams are level, it looks like a harmonic.
        """
        if total.chance(self.others) > range_errors.CHANCE:
            return 0.0, 0.0
        part = range_errors.harmonics(self.beams, points) @ self._likely(total)[self.others]
        length = np.linalg.norm(points - self.beams.position, axis=1)
        part -= float(np.average(part, weights=length**2))
        off = float(np.sqrt(np.mean((part * length) ** 2)))
        return (float(np.sqrt(np.mean(part**2))), off) if off > range_errors.LEAST_M else (0.0, 0.0)

    def _of_grazing(self, errors: np.ndarray) -> np.ndarray:
        """(k, k): what it adds to the covariance of the errors (k,) that nobody knows how bright surfaces are that are
        met at grazing angles, where ranges depend on that."""
        value = dict(zip(self.beams.names, errors, strict=True)).get(range_errors.BRIGHTNESS, 0.0)
        moved = range_uncertainty.GRAZING * value * self.by_grazing
        return np.outer(moved, moved)

    def _likely(self, total: ScanEvidence) -> np.ndarray:
        """The shared numbers, of which only what else depends on the direction of a beam is not zero."""
        numbers = np.zeros(self.others.stop)
        numbers[self.others] = total.likely(self.others, range_errors.HARMONIC_SIGMA)
        return numbers

    def _significant(
        self, estimate: np.ndarray, covariance: np.ndarray, least: np.ndarray, chance: float
    ) -> tuple[np.ndarray, np.ndarray]:
        most = np.array([range_errors.LARGEST[name] for name in self.beams.names])
        return range_errors.significant(estimate, covariance, least, most, chance)

    def _errors(self, values: np.ndarray, covariance: np.ndarray, kept: np.ndarray) -> RangeErrors:
        # digits that sums in another order would not give are left out
        sigma = np.sqrt(np.diagonal(covariance))
        significant = [name for name, is_kept in zip(self.beams.names, kept, strict=True) if is_kept]
        return RangeErrors(
            beams=self.beams,
            values={
                name: round(float(value), 7) for name, value in zip(self.beams.names, values, strict=True)
            },
            sigma={name: round(float(value), 7) for name, value in zip(self.beams.names, sigma, strict=True)},
            corrected=tuple(significant),
        )

    def _total(self, windows: list[Window], errors: np.ndarray) -> ScanEvidence:
        """What windows tell of all shared numbers, their points corrected by some errors (k,)."""
        every = scan_evidence.nothing(self.others.stop + 1)
        for number, window in enumerate(windows):
            every += self._evidence(number, window, errors, len(every.gradient))
        self.by_grazing = every.follows(self.own, self.others.stop)[: self.size]
        total = every.of(slice(0, self.others.stop))
        by_depth = np.diag(np.eye(self.others.stop)[self.own.stop - 1])
        self.poses_by_depth = total.poses.by(by_depth, self._extent)
        return total

    def _evidence(self, number: int, window: Window, errors: np.ndarray, size: int) -> ScanEvidence:
        points = self._corrected(number, window, errors)
        result = window.refined(self.dataset, points, self.config, self.poses.get(number))
        if result is None:
            return scan_evidence.nothing(size)
        self.poses[number] = result.world_from_scan
        view = View.of(
            *(gather(points), result.world_from_scan, result.planes, result.plane_points),
            self.dataset.sensor_position_scan,
        )
        cosine = self.cosines[number] = range_errors.cosines_on_planes(view, self.beams)
        brighter = None
        if self.beams.usual is not None and window.intensity is not None:
            brighter = range_errors.brighter_on_planes(view, self.beams, window.intensity, cosine)
        deep = number in self.depths and self.depths[number][0] > 0
        depths = beam_depth.of_planes(view, self.beams.position, deep)
        self.depths[number] = depths.squares
        by_depth = beam_depth.by_depth(self.beams, depths.of_points(view.labels.plane))
        by_shared = self._by_shared(window, result, brighter, by_depth)
        evidence, moved = scan_evidence.evidence_and_moved(view, by_shared, size)
        of_errors = Moved(moved.planes[:, : self.size], moved.scans[..., : self.size])
        self.responses[number] = range_uncertainty.response(view, of_errors, self._sight)
        return evidence

    def _corrected(self, number: int, window: Window, errors: np.ndarray) -> list[np.ndarray]:
        """Points of each scan; angles of incidence are those on the planes of the round before."""
        points = [scan.points for scan in window.scans]
        names = tuple(name for name, value in zip(self.beams.names, errors, strict=True) if value)
        if not names:
            return points
        values = dict(zip(self.beams.names, map(float, errors), strict=True))
        ranges = RangeErrors(beams=self.beams, values=values, corrected=names)
        ends = np.cumsum([len(each) for each in points])[:-1]
        known = self.cosines.get(number)
        cosines = [None] * len(points) if known is None else np.split(known, ends)
        intensities = [scan.intensity for scan in window.scans]
        return [ranges.points(*each) for each in zip(points, cosines, intensities, strict=True)]

    def _by_shared(
        self, window: Window, result: Aligned, brighter: np.ndarray | None, by_depth: ByShared
    ) -> ByShared:
        terms = [range_errors.by_errors(self.beams, brighter)]
        if self.clock is not None:
            stamps = self.dataset.scans.times[window.numbers]
            tau = moving_windows.point_times_of(window, stamps, self.clock)
            twist = path_motion.sweep_twists(stamps, result.world_from_scan, self.clock)
            terms.append(scan_motion.by_parts(np.concatenate(tau), twist[None]))
        terms += [by_depth, range_errors.by_directions(self.beams), range_uncertainty.by_grazing(self.beams)]

        def derivative(points: OnPlanes) -> np.ndarray:
            return np.concatenate([each(points) for each in terms], axis=1)

        return derivative
