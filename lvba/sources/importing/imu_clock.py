"""How far the stamps of an IMU are off the clock of the points: by when its gyroscope turns, and when the poses do."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from lvba.arrays import Pose
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
        return ImuRead(offsets[first])
    best = min(answers, key=lambda answer: answer.score).name
    left, sigma = offset.measure(lambda by: turns.scores(offsets[best] + by), _STEP_S, 2)
    place = offsets[best] + left
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
    warnings = [decided.warning, turns.otherwise(taken)]
    return ImuRead(taken, (decided,), place, sigma, tuple(words for words in warnings if words))


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

    def otherwise(self, late: float) -> str:
        """A warning where the gyroscope turns otherwise than the poses; "" where it does not."""
        rates = self._turned.as_rotvec() / (self._end - self._begin)[:, None]
        size = float(np.sqrt(np.mean(np.sum((rates - rates.mean(axis=0)) ** 2, axis=1))))
        off = float(np.sqrt(np.mean(self.scores(late) ** 2)))
        if size < _TURNING or off < _OTHERWISE * size:
            return ""
        return (
            f"imu: it turns otherwise than the poses, by {off:.2g} of {size:.2g} rad/s: check its mounting "
            "(--calibration), its units and its clock"
        )
