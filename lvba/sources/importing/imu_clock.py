"""How far the stamps of an IMU are off the clock of the points: by when its gyroscope turns, and when the poses do."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from lvba import geometry
from lvba.arrays import Pose
from lvba.inertial import readings
from lvba.sources.importing import decision, offset
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
_ODD_S = 0.03
"""What is less is left to the bundle adjustment, which looks for it: poses may be late by as much, not the IMU."""
_OTHERWISE, _TURNING = 0.5, 0.05
"""Part of turn rates that poses may differ from the gyroscope by, and the rates (rad/s) from which on that is asked."""
_SEARCHED = np.linspace(-1.0, 1.0, 21)
"""s: offsets that no convention gives, tried where one of them fits better than all that conventions give."""
_TURNED_DEG, _SCALED = 3.0, 1.1
"""Errors of axes and of scale that are named: what is less is left to the bundle adjustment, too."""
_DEGREES, _LIKE_DEGREES = np.degrees(1.0), 2.0
"""Scale of a gyroscope in deg/s, and the factor that it may be off by: noise of poses adds to their turns."""


@dataclass(frozen=True)
class ImuRead:
    """What was found. offset: s, added to stamps of the IMU; decisions: none where nothing could be compared

    measured, measured_sigma: s, how long after their stamps readings were taken, as measured, and how uncertain that is
    """

    offset: float = 0.0
    decisions: tuple[Decision, ...] = ()
    measured: float = 0.0
    measured_sigma: float = float("inf")
    warnings: tuple[str, ...] = ()


def find(
    poses: Track,
    imu: ImuReadings | None,
    imu_from_lidar: Pose | None,
    offsets: dict[str, float],
    said: str,
    where: object,
    known_by: str = "",
) -> ImuRead:
    """The offset by which the gyroscope turns as poses do.

    poses: world from LiDAR; imu_from_lidar: (4, 4), None: not known
    offsets: s, by name, the first is taken where data cannot tell; said: the answer that an option gives, ""
    known_by: what says the first one, beside the data
    Raises InputError: data contradict what an option says.
    """
    if imu is None:
        return ImuRead()
    first = said or next(iter(offsets))
    turning, steps = turnings.turning(imu, imu_from_lidar), _steps(poses)
    if turning is None or len(steps) <= _FEWEST * _TURNS:
        return ImuRead(offsets[first])
    turns = _Turns(Track(poses.times[steps], poses.poses[steps]), turning)
    answers = [Answer(name, turns.scores(value)) for name, value in offsets.items()]
    if not all(np.isfinite(answer.scores).all() for answer in answers):
        words = "imu: there are no readings while most poses are taken: its clock is another one, or it was switched off"
        return ImuRead(offsets[first], warnings=(words,))
    start = turns.near(offsets, min(answers, key=lambda answer: answer.score))
    left, sigma = offset.measure(lambda by: turns.scores(start + by), _STEP_S, 2)
    place = start + left
    excluded = offset.away(offsets, place, sigma, _ODD_S)
    decided = decision.decide(
        QUESTION, answers, said, next(iter(offsets)), "rad/s", where, excluded, known_by or _STAMPS
    )
    taken = offsets[decided.taken]
    if abs(place - taken) > max(4 * sigma, _ODD_S) and not said:
        size = f"{1000 * place:+.0f} ms (+- {1000 * sigma:.0f})"
        words = f"{QUESTION}: the IMU turns {size} after its stamps: that is taken"
        taken = round(place, 4)
        decided = decided.measured(f"{taken:+.4g}", decision.mean(turns.scores(taken)), words)
    warnings = [decided.warning, turns.otherwise(taken), _unit(imu)]
    return ImuRead(taken, (decided,), place, sigma, tuple(words for words in warnings if words))


def _unit(imu: ImuReadings) -> str:
    """A warning where the accelerometer is in no known unit."""
    if readings.in_si_units(readings.ordered(imu.times, imu.rates, imu.forces)) is not None:
        return ""
    norm = float(np.median(np.linalg.norm(imu.forces, axis=1)))
    return f"imu: accelerations are not used: their median norm, {norm:.3g}, is gravity neither in m/s^2 nor in g"


def shifted(imu: ImuReadings | None, by: float) -> ImuReadings | None:
    """The readings as taken so much later, s."""
    return imu if imu is None or not by else replace(imu, times=imu.times + by)


def _steps(poses: Track) -> np.ndarray:
    """(M,) int64: numbers of poses at least so far apart."""
    kept = [0]
    for number, time in enumerate(poses.times):
        if time - poses.times[kept[-1]] >= _APART_S:
            kept.append(number)
    return np.array(kept)


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
        off = self._off(late)
        groups = min(_GROUPS, len(off) // _TURNS)
        squares = [np.mean(np.sum(part**2, axis=1)) for part in np.array_split(off, groups)]
        return np.asarray(np.sqrt(np.array(squares)))

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

    def otherwise(self, late: float) -> str:
        """A warning where the gyroscope turns otherwise than the poses; "" where it does not."""
        rates = self._turned.as_rotvec() / (self._end - self._begin)[:, None]
        size = float(np.sqrt(np.mean(np.sum((rates - rates.mean(axis=0)) ** 2, axis=1))))
        off = float(np.sqrt(np.mean(self.scores(late) ** 2)))
        if max(size, off) < _TURNING:
            return ""
        if why := self._fit(late):
            return f"imu: {why}: check its mounting (--calibration) and its units"
        if off < _OTHERWISE * size:
            return ""
        return (
            f"imu: it turns otherwise than the poses, by {off:.2g} of {size:.2g} rad/s: check its mounting "
            "(--calibration), its units and its clock"
        )

    def _fit(self, late: float) -> str:
        """With which axes and which scale it would turn as the poses; "" where that is no better beyond chance."""
        begin, end = self._begin - late, self._end - late
        covered, seconds = self._turning.covers(begin, end), (end - begin)[:, None]
        # mean rates: turns would be counted past half a turn, of a gyroscope that is far too fast
        felt = (self._turning.sum(end) - self._turning.sum(begin)) / seconds
        true = self._turned.as_rotvec() / seconds
        felt, true = (rates[covered] - np.median(rates[covered], axis=0) for rates in (felt, true))
        turn = geometry.closest_rotation(true.T @ felt)
        scale = float(np.sum(felt**2) / max(np.sum(true * (felt @ turn.T)), 1e-12))
        fitted = felt @ turn.T / scale
        groups = min(_GROUPS, len(true) // _TURNS)

        def answer(rates: np.ndarray) -> Answer:
            squares = np.sum((rates - true) ** 2, axis=1)
            return Answer("", np.sqrt([part.mean() for part in np.array_split(squares, groups)]))

        if not decision.better(answer(fitted), answer(felt)):
            return ""
        angle = float(np.degrees(Rotation.from_matrix(turn).magnitude()))
        if abs(np.log(scale / _DEGREES)) < np.log(_LIKE_DEGREES):
            return f"its gyroscope turns {scale:.0f} times as fast as the poses, as one that counts degrees would"
        if angle > _TURNED_DEG:
            return f"its axes are turned by {angle:.0f} degrees from what is said"
        if abs(np.log(scale)) > np.log(_SCALED):
            return f"its gyroscope turns {scale:.3g} times as fast as the poses"
        return ""
