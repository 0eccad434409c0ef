"""Which way an IMU's axes point, and whether its accelerometer feels up or down: by how poses turn and accelerate."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import permutations, product

import numpy as np

from lvba import geometry
from lvba.arrays import Pose
from lvba.inertial import readings
from lvba.sources.importing import decision
from lvba.sources.importing.decision import Answer, Decision
from lvba.sources.importing.survey import ImuReadings
from lvba.sources.importing.track import MAX_GAP_S, Track

QUESTION = "accelerometer"
UP, DOWN = "up", "down"
"""What it reads at rest: what holds it against gravity, as ROS has it, or gravity."""
_APART_S = 0.3
"""Between poses whose positions tell an acceleration: 5 mm of noise are 0.14 m/s^2."""
_FEWEST_READINGS = 5
"""Between two of these poses."""
_GROUPS, _FEWEST, _WINDOWS = 20, 4, 3
"""Parts of the recording that are scored each by itself, at most and at least, and accelerations in each, at least."""
GYROSCOPE, ACCELEROMETER = "gyroscope", "accelerometer"
_BESIDE = {
    GYROSCOPE: "rad/s off the turns of the poses",
    ACCELEROMETER: "m/s^2 off the accelerations of the poses",
}
_DOES = {GYROSCOPE: "turn", ACCELEROMETER: "turn or accelerate"}
_EXPLAINED = 0.3
"""Part of what is off that other axes may leave, to be named as what they are."""
_CHECK = "check its extrinsic (--calibration)"
_MORE = "record some seconds in which the sensor turns about all its axes and changes its speed"

Scores = Callable[[np.ndarray], np.ndarray]
"""Of rotations (3, 3) of an IMU's axes: scores (P,) of parts of a recording, smaller is better."""


@dataclass(frozen=True)
class AxesRead:
    """What was found. sign: by which forces are multiplied; contradictions: why the IMU must not be used"""

    sign: float = 1.0
    decisions: tuple[Decision, ...] = ()
    warnings: tuple[str, ...] = ()
    contradictions: tuple[str, ...] = ()


def _rotations() -> np.ndarray:
    """(24, 3, 3): all that take axes to axes, that of no turn first."""
    matrices = [
        np.eye(3)[list(order)] * np.array(signs)[:, None]
        for order in permutations(range(3))
        for signs in product((1, -1), repeat=3)
    ]
    proper = [matrix for matrix in matrices if np.linalg.det(matrix) > 0]
    return np.array(sorted(proper, key=lambda matrix: -float(np.trace(matrix))))


ROTATIONS = _rotations()


def find(
    poses: Track,
    imu: ImuReadings,
    imu_from_lidar: Pose,
    turns: Scores | None,
    said: str,
    where: object,
) -> AxesRead:
    """Whether axes and sign are what is said, where the data tell, and what they leave open.

    poses: world from LiDAR; imu: on their clock; imu_from_lidar: (4, 4)
    turns: scores of the gyroscope, None where it says nothing; said: the answer that an option gives, ""
    Raises InputError: data contradict what an option says.
    """
    contradictions, warnings = [], []
    if turns is not None:
        asked = {(number, 1): Answer("", turns(rotation)) for number, rotation in enumerate(ROTATIONS)}
        best = min(asked, key=lambda each: asked[each].score)
        if decision.better(asked[best], asked[0, 1]):
            contradictions.append(_turned(GYROSCOPE, best, [asked[best], asked[0, 1]]))
        warnings += _axes_are_open(GYROSCOPE, [asked[number, 1] for number in range(len(ROTATIONS))])
    forces = _Forces.of(poses, imu, imu_from_lidar)
    if forces is None:
        sign = -1.0 if said == DOWN else 1.0
        return AxesRead(sign, warnings=tuple(warnings), contradictions=tuple(contradictions))
    answers = {
        (number, sign): Answer("", forces.scores(sign * rotation))
        for number, rotation in enumerate(ROTATIONS)
        for sign in (1, -1)
    }
    best = min(answers, key=lambda each: answers[each].score)
    others = [answers[0, 1], answers[0, -1]]
    if best[0] and all(decision.better(answers[best], other) for other in others):
        contradictions.append(_turned(ACCELEROMETER, best, [answers[best], answers[0, 1]]))
    if contradictions:
        return AxesRead(contradictions=tuple(contradictions))
    up, down = (Answer(name, answer.scores) for name, answer in zip((UP, DOWN), others, strict=True))
    decided = decision.decide(QUESTION, [up, down], said, UP, "m/s^2", where)
    sign = -1 if decided.taken == DOWN else 1
    if decided.by == "default":
        warnings.append(f"imu: the poses hardly accelerate: {decided.warning}, or {_MORE}")
    elif sign < 0 and not said:
        warnings.append(
            "imu: its accelerometer reads gravity instead of specific force (down at rest): its sign was inverted; "
            f"{down.score:.2f} against {up.score:.2f} m/s^2 off the accelerations of the poses"
        )
    warnings += _axes_are_open(ACCELEROMETER, [answers[number, sign] for number in range(len(ROTATIONS))])
    return AxesRead(float(sign), (decided,), tuple(warnings))


def _turned(sensor: str, best: tuple[int, int], scores: Sequence[Answer]) -> str:
    """Why axes cannot be those that are said. scores: with the best rotation, and with none"""
    figures = f"({scores[0].score:.2g} against {scores[1].score:.2g} {_BESIDE[sensor]})"
    if scores[0].score > _EXPLAINED * scores[1].score:
        return f"its {sensor}'s axes differ from the given extrinsic {figures}"
    turn = geometry.from_rotation_translation(ROTATIONS[best[0]], np.zeros(3))
    angle = round(float(geometry.rotation_angle_deg(turn)))
    sign = " and its sign is inverted" if best[1] < 0 else ""
    return f"its {sensor}'s axes are rotated by {angle} degrees from the given extrinsic{sign} {figures}"


def _axes_are_open(sensor: str, answers: Sequence[Answer]) -> list[str]:
    """A warning where the data do not speak against other rotations. answers: of `ROTATIONS`"""
    left = sum(not decision.better(answers[0], other) for other in answers[1:])
    if not left:
        return []
    return [
        f"imu: the axes of its {sensor} cannot be checked: the poses hardly {_DOES[sensor]}, and {left} of 23 other "
        f"orientations of them would fit as well: {_CHECK}, or {_MORE}"
    ]


@dataclass(frozen=True)
class _Forces:
    """Accelerations by poses, and what an accelerometer feels meanwhile.

    accelerations: (N, 3), m/s^2, world axes, means over windows
    felt: (N, 3, 3, 3): R_ij f_k, means over the same windows, of world_from_imu and the forces, m/s^2
    """

    accelerations: np.ndarray
    felt: np.ndarray
    groups: tuple[np.ndarray, ...] = field(default=())

    @staticmethod
    def of(poses: Track, imu: ImuReadings, imu_from_lidar: Pose) -> "_Forces | None":
        """None where too few windows have readings, or these are in no known unit."""
        given = readings.in_si_units(readings.ordered(imu.times, imu.rates, imu.forces))
        knots = poses.apart(_APART_S - 1e-6)
        if given is None or len(knots) < 3:
            return None
        inside = (given.times > poses.times[knots[0]]) & (given.times < poses.times[knots[-1]])
        times, forces = given.times[inside], given.forces[inside]
        if not len(times):
            return None
        at = poses.times[knots]
        lidar_from_imu = geometry.inverse(imu_from_lidar)
        positions = (poses.poses[knots] @ lidar_from_imu)[:, :3, 3]
        rotations = poses.at(times)[:, :3, :3] @ lidar_from_imu[:3, :3]
        products = (rotations[..., None] * forces[:, None, None, :]).reshape(len(times), 27)
        span = np.diff(at)
        interval = np.searchsorted(at, times) - 1
        part = (times - at[interval]) / span[interval]
        rising, falling = (_sums(interval, weight, products, len(span)) for weight in (part, 1 - part))
        # a second difference is the mean of accelerations with weights that rise to its middle, and fall
        felt = (rising[:-1, 1:] + falling[1:, 1:]) / np.maximum(rising[:-1, :1] + falling[1:, :1], 1e-9)
        speeds = np.diff(positions, axis=0) / span[:, None]
        accelerations = 2 * np.diff(speeds, axis=0) / (span[:-1] + span[1:])[:, None]
        counts = np.bincount(interval, minlength=len(span))
        full = (counts >= _FEWEST_READINGS) & (span < MAX_GAP_S)
        # half of the usual rate: what is felt in a gap is not known
        full &= counts / span > 0.5 * np.median(counts / span)
        windows = full[:-1] & full[1:]
        groups = min(_GROUPS, int(windows.sum()) // _WINDOWS)
        if groups < _FEWEST:
            return None
        return _Forces(
            accelerations[windows],
            felt[windows].reshape(-1, 3, 3, 3),
            tuple(np.array_split(np.arange(int(windows.sum())), groups)),
        )

    def scores(self, matrix: np.ndarray) -> np.ndarray:
        """(P,) m/s^2: rms of what accelerations are off in each part, of forces in axes that `matrix` (3, 3) gives.

        What is off all the time alike is gravity, whose direction in the world of the poses is not known.
        """
        off = np.einsum("nijk,jk->ni", self.felt, matrix) - self.accelerations
        squares = np.sum((off - off.mean(axis=0)) ** 2, axis=1)
        return np.array([np.sqrt(squares[group].mean()) for group in self.groups])


def _sums(interval: np.ndarray, weights: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """(count, 1 + K): of weights (N,), and of values (N, K) times these, in each interval."""
    columns = [weights, *(weights * column for column in values.T)]
    return np.stack([np.bincount(interval, column, count) for column in columns], axis=-1)
