"""How far the stamps of an IMU are off the clock of the points: by when its gyroscope turns, and when the poses do."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from lvba import geometry
from lvba.arrays import Pose
from lvba.inertial import readings
from lvba.sources.importing import clocks, decision, imu_axes, offset
from lvba.sources.importing import turning as turnings
from lvba.sources.importing.decision import Answer, Decision
from lvba.sources.importing.survey import ImuReadings
from lvba.sources.importing.track import MAX_GAP_S, Track
from lvba.sources.importing.turning import Turning

QUESTION = "imu_offset"
_STAMPS = "its stamps"
_APART_S = 0.08
"""Between poses whose turn is compared: single ones close together say little."""
_GROUPS, _FEWEST, _TURNS = 20, 4, 5
"""Parts of the recording that are scored each by itself, at least, and turns in each."""
_STEP_S = 0.01
_SIGNIFICANT_S = 0.03
"""What is less is left to the bundle adjustment, which looks for it: poses may be late by as much, not the IMU."""
_OTHERWISE, _TURNING = 0.5, 0.05
"""Part of turn rates that poses may differ from the gyroscope by, and the rates (rad/s) from which on that is asked, and
an offset that no convention gives is taken as measured."""
_SEARCHED = np.linspace(-1.0, 1.0, 21)
"""s: offsets that no convention gives, tried where one of them fits better than all that conventions give."""
_TURNED_DEG, _SCALED = 3.0, 1.1
"""Errors of axes and of scale that are named: what is less is left to the bundle adjustment, too."""
_WRONG_DEG = 30.0
"""Axes that are rotated by more are those of another extrinsic: the IMU is left out."""
_DEGREES, _LIKE_DEGREES = np.degrees(1.0), 2.0
"""Scale of a gyroscope in deg/s, and the factor that it may be off by: noise of poses adds to their turns."""


@dataclass(frozen=True)
class ImuRead:
    """What was found. offset: s, added to stamps of the IMU; decisions: none where nothing could be compared

    measured, measured_sigma: s, how long after their stamps readings were taken, as measured, and how uncertain that is
    rates, forces: by what readings are multiplied: rad/s of degrees, and the sign of the accelerometer
    left_out: the poses contradict its axes, so that it must not be used
    """

    offset: float = 0.0
    decisions: tuple[Decision, ...] = ()
    measured: float = 0.0
    measured_sigma: float = float("inf")
    warnings: tuple[str, ...] = ()
    rates: float = 1.0
    forces: float = 1.0
    left_out: bool = False

    def mended(self, imu: ImuReadings | None) -> ImuReadings | None:
        """The readings as they are meant, when they were taken; None: there are none that may be used."""
        if imu is None or self.left_out:
            return None
        return replace(
            imu, times=imu.times + self.offset, rates=self.rates * imu.rates, forces=self.forces * imu.forces
        )


def find(
    poses: Track,
    imu: ImuReadings | None,
    imu_from_lidar: Pose | None,
    offsets: dict[str, float],
    said: Mapping[str, str],
    where: object,
    known_by: str = "",
    added: float = 0.0,
) -> ImuRead:
    """The offset by which the gyroscope turns as poses do, and whether units, signs and axes are what is said.

    poses: world from LiDAR; imu_from_lidar: (4, 4), None: not known
    offsets: s, by name, the first is taken where data cannot tell; said: answers that options give, by question
    known_by: what says the first one, beside the data; added: s, to stamps, before, which names of offsets count in
    Raises InputError: data contradict what an option says.
    """
    if imu is None:
        return ImuRead()
    first = said.get(QUESTION, "") or next(iter(offsets))
    turning, steps = turnings.turning(imu, imu_from_lidar), poses.apart(_APART_S)
    if imu_from_lidar is None or turning is None or len(steps) <= _FEWEST * _TURNS:
        return ImuRead(offsets[first])
    turns = _Turns(Track(poses.times[steps], poses.poses[steps]), turning)
    answers = [Answer(name, turns.scores(value)) for name, value in offsets.items()]
    if not all(np.isfinite(answer.scores).all() for answer in answers):
        words = "imu: there are no readings while most poses are taken: its clock is another one, or it was switched off"
        return ImuRead(offsets[first], warnings=(words,))
    read = _when(turns, answers, offsets, said.get(QUESTION, ""), where, known_by, added)
    fit = turns.fit(read.offset)
    if fit is not None and fit.counts_degrees:
        in_radians = replace(imu, rates=np.radians(imu.rates))
        again = find(poses, in_radians, imu_from_lidar, offsets, said, where, known_by, added)
        words = f"imu: {fit.words()}: its rates are taken for degrees per second"
        return replace(again, rates=float(np.radians(1.0)), warnings=(words, *again.warnings))
    axes = imu_axes.find(
        poses,
        replace(imu, times=imu.times + read.offset),
        imu_from_lidar,
        turns.of_axes(read.offset, imu_from_lidar),
        said.get(imu_axes.QUESTION, ""),
        where,
    )
    why = list(axes.contradictions)
    if fit is not None and fit.degrees > _WRONG_DEG:
        # by how much, also where that is along no axis
        why = [fit.words(), *(each for each in why if imu_axes.GYROSCOPE not in each)]
    if why:
        words = f"imu: {'; '.join(why)}: it is left out: check its extrinsic (--calibration) and its units"
        return replace(read, left_out=True, warnings=(*read.warnings, words))
    warnings = (*read.warnings, turns.otherwise(read.offset, fit), _unit(imu), *axes.warnings)
    return replace(
        read,
        forces=axes.sign,
        decisions=(*read.decisions, *axes.decisions),
        warnings=tuple(words for words in warnings if words),
    )


def _when(
    turns: "_Turns",
    answers: list[Answer],
    offsets: dict[str, float],
    said: str,
    where: object,
    known_by: str,
    added: float,
) -> ImuRead:
    """The offset, of answers with their scores, or as measured."""
    start = turns.near(offsets, min(answers, key=lambda answer: answer.score))
    left, sigma = offset.measure(lambda by: turns.scores(start + by), _STEP_S, 2)
    place = start + left
    excluded = offset.away(offsets, place, sigma, _SIGNIFICANT_S)
    decided = decision.decide(
        QUESTION, answers, said, next(iter(offsets)), "rad/s", where, excluded, known_by or _STAMPS
    )
    taken = offsets[decided.taken]
    # by turns that are as small as the noise of poses, chance seems to be an offset
    if abs(place - taken) > max(4 * sigma, _SIGNIFICANT_S) and not said and turns.size >= _TURNING:
        size = f"{1000 * (place + added):+.0f} ms (+- {1000 * sigma:.0f})"
        words = f"{QUESTION}: the IMU turns {size} after its stamps: applied"
        taken = round(place, 4)
        decided = decided.measured(clocks.name_of(taken, added), decision.mean(turns.scores(taken)), words)
    return ImuRead(
        offset=taken,
        decisions=(decided,),
        measured=place,
        measured_sigma=sigma,
        warnings=(decided.warning,) if decided.warning else (),
    )


def _unit(imu: ImuReadings) -> str:
    """A warning where the accelerometer is in no known unit."""
    if readings.in_si_units(readings.ordered(imu.times, imu.rates, imu.forces)) is not None:
        return ""
    norm = float(np.median(np.linalg.norm(imu.forces, axis=1)))
    return f"imu: accelerations are not used: their median norm, {norm:.3g}, is neither 9.81 m/s^2 nor 1 g"


def shifted(imu: ImuReadings | None, by: float) -> ImuReadings | None:
    """The readings as taken so much later, s."""
    return imu if imu is None or not by else replace(imu, times=imu.times + by)


class _Turns:
    """Turns from pose to pose, beside a gyroscope."""

    def __init__(self, poses: Track, turning: Turning) -> None:
        near = np.diff(poses.times) < MAX_GAP_S
        self._begin, self._end = poses.times[:-1][near], poses.times[1:][near]
        rotation = Rotation.from_matrix(poses.poses[:, :3, :3])
        self._turned = (rotation[:-1].inv() * rotation[1:])[near]
        self._turning = turning

    def scores(self, late: float) -> np.ndarray:
        """(P,) float64, rad/s: root mean square of what the rates differ by in each part of the recording.

        late: s, how long after their stamps readings were taken
        NaN in parts that the readings do not cover.
        """
        return self._parts(self._off(late))

    def _off(self, late: float) -> np.ndarray:
        """(N, 3), rad/s, less what is the same all the time (the bias); NaN where readings cover too little."""
        begin, end = self._begin - late, self._end - late
        felt = self._turning.at(begin).inv() * self._turning.at(end)
        rates = (felt.inv() * self._turned).as_rotvec() / (end - begin)[:, None]
        covered = self._turning.covers(begin, end)
        if np.mean(covered) < _OTHERWISE:
            return np.full_like(rates, np.nan)
        rates -= np.median(rates[covered], axis=0)
        rates[~covered] = np.sqrt(np.mean(rates[covered] ** 2, axis=0))
        return np.asarray(rates)

    def near(self, offsets: dict[str, float], best: Answer) -> float:
        """s: the offset that `best` of these names, or one that no convention gives and that is better beyond chance."""
        others = [Answer(f"{late:+.4g}", self.scores(float(late))) for late in _SEARCHED]
        others = [other for other in others if np.isfinite(other.scores).all()]
        other = min(others, key=lambda answer: answer.score, default=best)
        return float(other.name) if decision.better(other, best) else offsets[best.name]

    @property
    def size(self) -> float:
        """rad/s: root mean square of how fast the poses turn, less what is the same all the time."""
        rates = self._turned.as_rotvec() / (self._end - self._begin)[:, None]
        return float(np.sqrt(np.mean(np.sum((rates - rates.mean(axis=0)) ** 2, axis=1))))

    def otherwise(self, late: float, fit: "_Fit | None") -> str:
        """A warning where the gyroscope turns otherwise than the poses; "" where it does not. fit: that of `fit(late)`"""
        size = self.size
        off = float(np.sqrt(np.mean(self.scores(late) ** 2)))
        if max(size, off) < _TURNING:
            return ""
        if fit is not None and (why := fit.words()):
            return f"imu: {why}: check its extrinsic (--calibration) and its units"
        if off < _OTHERWISE * size:
            return ""
        return (
            f"imu: its rates differ from those of the poses by {off:.2g} of {size:.2g} rad/s: check its extrinsic "
            "(--calibration), its units and its clock"
        )

    def of_axes(self, late: float, imu_from_lidar: Pose) -> imu_axes.Scores:
        """Scores, rad/s, of rotations (3, 3) of the IMU's axes. late: as of `scores`; imu_from_lidar: (4, 4)"""
        felt, true = self._rates(late)
        lidar_from_imu = imu_from_lidar[:3, :3].T

        def scores(rotation: np.ndarray) -> np.ndarray:
            turn = lidar_from_imu @ rotation @ lidar_from_imu.T
            return self._parts(felt @ turn.T - true)

        return scores

    def fit(self, late: float) -> "_Fit | None":
        """With which axes and which scale it would turn as the poses; None where that is no better beyond chance.

        Also None where it hardly turns.
        """
        felt, true = self._rates(late)
        if np.sqrt(max(np.mean(np.sum(each**2, axis=1)) for each in (felt, true))) < _TURNING:
            return None
        turn = geometry.closest_rotation(true.T @ felt)
        scale = float(np.sum(felt**2) / max(np.sum(true * (felt @ turn.T)), 1e-12))
        fitted = felt @ turn.T / scale
        if not decision.better(Answer("", self._parts(fitted - true)), Answer("", self._parts(felt - true))):
            return None
        return _Fit(float(np.degrees(Rotation.from_matrix(turn).magnitude())), scale)

    def _rates(self, late: float) -> tuple[np.ndarray, np.ndarray]:
        """Of the gyroscope and of the poses, (N, 3) rad/s, LiDAR axes, where readings cover them, less the medians."""
        begin, end = self._begin - late, self._end - late
        covered, seconds = self._turning.covers(begin, end), (end - begin)[:, None]
        # mean rates: turns would be counted past half a turn, of a gyroscope that is far too fast
        felt = (self._turning.sum(end) - self._turning.sum(begin)) / seconds
        true = self._turned.as_rotvec() / seconds
        felt, true = (rates[covered] - np.median(rates[covered], axis=0) for rates in (felt, true))
        return felt, true

    def _parts(self, off: np.ndarray) -> np.ndarray:
        """(P,) rad/s: root mean square of off (N, 3) in each part of the recording."""
        groups = min(_GROUPS, len(off) // _TURNS)
        return np.sqrt([np.mean(np.sum(part**2, axis=1)) for part in np.array_split(off, groups)])


@dataclass(frozen=True)
class _Fit:
    """How the gyroscope turns beside the poses. degrees: by which its axes are turned; scale: times as fast"""

    degrees: float
    scale: float

    @property
    def counts_degrees(self) -> bool:
        return bool(abs(np.log(self.scale / _DEGREES)) < np.log(_LIKE_DEGREES))

    def words(self) -> str:
        """What is named of it, "": it is little."""
        if self.counts_degrees:
            return f"its gyroscope turns {self.scale:.0f} times as fast as the poses, as one that counts degrees would"
        if self.degrees > _TURNED_DEG:
            return f"its gyroscope's axes are rotated by {self.degrees:.0f} degrees from the given extrinsic"
        if abs(np.log(self.scale)) > np.log(_SCALED):
            return f"its gyroscope turns {self.scale:.3g} times as fast as the poses"
        return ""
