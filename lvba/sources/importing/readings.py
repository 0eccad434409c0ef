"""Ways to read an odometry, and how thick the map is by each: which one is taken is decided by pairs of scans."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lvba import geometry
from lvba.errors import InputError
from lvba.sources.importing import decision, offset, thickness
from lvba.sources.importing.decision import Answer, Decision
from lvba.sources.importing.thickness import TimedScan
from lvba.sources.importing.track import Track

_MOST_TURN_RAD, _MOST_STEP = 0.7, 0.5
"""Between the scans of a pair, the step as a part of the median range: more, and they may see other places."""
_LEVER_M = 10.0
MOST_PAIRS = 30
_FEWEST_PAIRS = 4
_FEWEST_POINTS = 50
_ROUNDS = 3
_CONTRADICTION, _CONTRADICTION_M = 6.0, 0.15
"""Pairs that lie no closer than so many times the thickness of single scans, and so many m, contradict all readings."""
_ROUGH, _ROUGH_M = 4.0, 0.06
"""The same for a warning."""
_COMMON_S = 0.012
_FIT_STEP = 0.1
"""Part of a sweep."""
_SIGNIFICANT_SIGMAS, _SIGNIFICANT_SWEEPS = 4.0, 0.15
"""An offset in time that is off conventions by more than both is no chance, and none of them."""


@dataclass(frozen=True)
class Reading:
    """A way to read an odometry.

    quaternions: "xyzw" as is, or "wxyz"; pose_direction: "world_from", or "inverse"; pose_of: body, lidar or camera
    points: "raw" or "deskewed"; shift: s; a pose holds this much after its stamp, on the clock of the points
    """

    quaternions: str = "xyzw"
    pose_direction: str = "world_from"
    pose_of: str = "body"
    points: str = "raw"
    shift: float = 0.0

    def answered(self, question: str, value: Any) -> "Reading":
        """With another answer to a question; to `time`: s."""
        return replace(self, **{"shift" if question == "time" else question: value})


@dataclass(frozen=True)
class Extrinsics:
    """child_from_lidar, (4, 4), by what the poses may be of; what is not known is not there."""

    child_from_lidar: dict[str, np.ndarray]


@dataclass
class Scorer:
    """The thickness of pairs of scans by readings; each is measured once."""

    odometry: Track
    extrinsics: Extrinsics
    pairs: list[tuple[TimedScan, TimedScan]]
    _known: dict[Reading, np.ndarray] = field(default_factory=dict)

    def scores(self, reading: Reading) -> np.ndarray:
        """(P,) float64, m, of each pair."""
        if reading not in self._known:
            lidar = lidar_track(self.odometry, reading, self.extrinsics)
            deskewed = reading.points == "deskewed"
            self._known[reading] = self.along(lidar, deskewed)
        return self._known[reading]

    def along(self, lidar: Track, deskewed: bool) -> np.ndarray:
        """(P,) float64, m, of each pair, by another track. deskewed: points are as seen at the stamps of the scans"""
        return np.array(
            [
                thickness.distance(one.in_world(lidar, deskewed), other.in_world(lidar, deskewed))
                for one, other in self.pairs
            ]
        )

    def score(self, reading: Reading) -> float:
        """m: the geometric mean over pairs."""
        return decision.mean(self.scores(reading))


def lidar_track(odometry: Track, reading: Reading, extrinsics: Extrinsics) -> Track:
    """World from LiDAR on the clock of the points."""
    poses = odometry.poses
    if reading.quaternions == "wxyz":
        turned = np.roll(geometry.quaternion(poses), -1, axis=-1)
        poses = geometry.from_quaternion_translation(turned, poses[:, :3, 3])
    if reading.pose_direction == "inverse":
        poses = geometry.inverse(poses)
    return Track(odometry.times + reading.shift, poses @ extrinsics.child_from_lidar[reading.pose_of])


@dataclass(frozen=True)
class Choices:
    """The answers that are possible, the likely one first.

    shifts: s, with what each means; said: answers that options give; known_by: what says the first answer to a question,
    beside the data
    """

    quaternions: tuple[str, ...]
    pose_direction: tuple[str, ...]
    pose_of: tuple[str, ...]
    points: tuple[str, ...]
    shifts: dict[str, float]
    said: dict[str, str]
    known_by: dict[str, str]

    def of(self, question: str) -> dict[str, object]:
        """The value of the field of `Reading` by the name of the answer."""
        if question == "time":
            return dict(self.shifts)
        return {name: name for name in getattr(self, question)}


ORDER = ("quaternions", "pose_direction", "pose_of", "points", "time")


@dataclass(frozen=True)
class ScansRead:
    """The reading that is taken, and why.

    pairs: how many were looked at; thickness, floor: m, of the pairs by it, and of single scans
    measured, measured_sigma: s, how long after their stamps poses hold, as measured, and how uncertain that is
    """

    reading: Reading
    decisions: tuple[Decision, ...]
    pairs: int
    thickness: float
    floor: float
    measured: float
    measured_sigma: float
    warnings: tuple[str, ...]


def find(scorer: Scorer, choices: Choices, sweep: float, where: object) -> ScansRead:
    """The reading by which pairs of scans lie closest, question by question.

    sweep: s, of the LiDAR; 0: not known
    Raises InputError: data contradict what an option says, or every reading.
    """
    best = _closest(scorer, choices)
    place, sigma = _time(scorer, best, sweep)
    reading, decisions = best, list[Decision]()
    for question in ORDER:
        excluded = offset.away(choices.shifts, place, sigma, _COMMON_S) if question == "time" else []
        decided = _decide(scorer, choices, question, best, where, excluded)
        decisions.append(decided)
        reading = reading.answered(question, choices.of(question)[decided.taken])
    # answers that data leave open, each by itself, need not be as good together
    if scorer.pairs and decision.better(Answer("", scorer.scores(best)), Answer("", scorer.scores(reading))):
        reading, decisions = best, [each.by_scores() for each in decisions]
    more: list[str] = []
    usual = reading.shift == next(iter(choices.shifts.values()))
    sigmas = _SIGNIFICANT_SIGMAS if usual else offset.NEAR_SIGMAS
    if abs(place - reading.shift) > max(sigmas * sigma, _SIGNIFICANT_SWEEPS * sweep):
        reading, decisions, more = _measured(scorer, reading, decisions, choices, place, sigma)
    warnings = [each.warning for each in decisions if each.warning] + more
    thick, floor = _thickness(scorer, reading)
    words = f"{100 * thick:.1f} cm off at best, {100 * floor:.1f} cm within single scans"
    mend = "check that the odometry is of this recording, and its clock, unit (m) and calibration"
    if thick > max(_CONTRADICTION * floor, _CONTRADICTION_M) and len(scorer.pairs) >= _FEWEST_PAIRS:
        raise InputError(where, f"no reading of these poses lays the scans on each other: {words}", mend)
    if thick > max(_ROUGH * floor, _ROUGH_M):
        warnings.append(f"poses: scans lie on each other only roughly: {words}: {mend}")
    return ScansRead(
        reading=reading,
        decisions=tuple(decisions),
        pairs=len(scorer.pairs),
        thickness=thick,
        floor=floor,
        measured=place,
        measured_sigma=sigma,
        warnings=tuple(warnings),
    )


def _time(scorer: Scorer, best: Reading, sweep: float) -> tuple[float, float]:
    """s: how long after their stamps poses hold, as measured beside the best reading, and its standard deviation."""
    if not scorer.pairs or not sweep:
        return best.shift, float("inf")
    left, sigma = offset.measure(
        lambda by: scorer.scores(best.answered("time", best.shift + by)), _FIT_STEP * sweep, 2
    )
    return best.shift + left, sigma


def _measured(
    scorer: Scorer, reading: Reading, decisions: list[Decision], choices: Choices, place: float, sigma: float
) -> tuple[Reading, list[Decision], list[str]]:
    """Reading, decisions and warnings where poses hold at another time (s) than by any usual convention."""
    shift = round(place, 4)
    other = reading.answered("time", shift)
    size = f"{1000 * shift:+.0f} ms (+- {1000 * sigma:.0f}) after their stamps"
    if not scorer.score(other) < scorer.score(reading):
        return (
            reading,
            decisions,
            [
                f"time: the data suggest that poses hold {size}, but that does not improve the fit: not applied"
            ],
        )
    if "time" in choices.said:
        words = f"time: scans lie closest with poses that hold {size}; --convention time={shift} applies that"
        return reading, decisions, [words]
    words = f"time: poses hold {size}, which is no usual convention: applied"
    return other, [*decisions[:-1], decisions[-1].measured(f"{shift:+.4f}", scorer.score(other), words)], []


def _thickness(scorer: Scorer, reading: Reading) -> tuple[float, float]:
    """m: how far pairs of scans are from each other, and points of single scans from the planes of the others there."""
    if not scorer.pairs:
        return float("nan"), float("nan")
    lidar = lidar_track(scorer.odometry, reading, scorer.extrinsics)
    floors = [thickness.floor(one.in_world(lidar, reading.points == "deskewed")) for one, _ in scorer.pairs]
    return scorer.score(reading), float(np.mean(floors))


def _closest(scorer: Scorer, choices: Choices) -> Reading:
    """The best reading: of what a pose is, all answers with each other; then of times, likewise; until none is better."""
    first = {question: list(_allowed(choices, question).values()) for question in ORDER}
    best = Reading(*(first[question][0] for question in ORDER))  # type: ignore[arg-type]
    for _ in range(_ROUNDS if scorer.pairs else 0):
        before = best
        for group in (ORDER[:3], ORDER[3:]):
            tried = [best]
            for question in group:
                tried = [each.answered(question, value) for each in tried for value in first[question]]
            best = min(tried, key=scorer.score)
        if best == before:
            break
    return best


def _allowed(choices: Choices, question: str) -> dict[str, object]:
    """What an option says, or all answers."""
    every = choices.of(question)
    said = choices.said.get(question, "")
    return {said: every[said]} if said else every


def _decide(
    scorer: Scorer, choices: Choices, question: str, best: Reading, where: object, excluded: list[str]
) -> Decision:
    every = choices.of(question)
    preferred = next(iter(every))
    said, known = choices.said.get(question, ""), choices.known_by.get(question, "")
    if not scorer.pairs:
        taken, left = said or preferred, tuple(every)
        by = "option" if said else (known or "default" if len(every) > 1 else "only")
        warning = ""
        if by == "default":
            warning = f"{question}: there are no scans to tell by: {taken} is taken; --convention {question}=... decides"
        return Decision(
            question=question,
            taken=taken,
            by=by,
            unit="m",
            scores=(),
            best=taken,
            margin=0.0,
            error=0.0,
            open=left,
            warning=warning,
        )
    answers = [Answer(key, scorer.scores(best.answered(question, value))) for key, value in every.items()]
    return decision.decide(question, answers, said, preferred, "m", where, excluded, known)


def pairs_of(segments: list[list[TimedScan]], odometry: Track) -> list[tuple[TimedScan, TimedScan]]:
    """Up to `MOST_PAIRS` pairs of scans over the whole recording: near each other, and as differently moved as there are.

    Motions are what tells conventions apart; scans that move alike lie on each other whatever they are read as.
    """
    reach = 0.15
    rated: list[list[tuple[float, tuple[TimedScan, TimedScan]]]] = []
    for scans in segments:
        inside = [
            scan
            for scan in scans
            if odometry.covers(scan.span[0] - reach, scan.span[1] + reach)
            and len(scan.points) > _FEWEST_POINTS
        ]
        rows = []
        for number, one in enumerate(inside):
            for other in inside[number + 1 :]:
                value = _difference(one, other, odometry)
                if value > 0:
                    rows.append((value, (one, other)))
        rated.append(sorted(rows, key=lambda entry: -entry[0]))
    pairs: list[tuple[TimedScan, TimedScan]] = []
    rank = 0
    while len(pairs) < MOST_PAIRS and any(len(entries) > rank for entries in rated):
        ranked = sorted(
            (entries[rank] for entries in rated if len(entries) > rank), key=lambda entry: -entry[0]
        )
        pairs += [pair for _, pair in ranked[: MOST_PAIRS - len(pairs)]]
        rank += 1
    return pairs


def _difference(one: TimedScan, other: TimedScan, odometry: Track) -> float:
    """How differently two scans are moved, in m/s at some distance; 0 where they are too far apart."""
    step = 0.1
    times = np.array([one.stamp, one.stamp + step, other.stamp, other.stamp + step])
    poses = odometry.at(times)
    turn = np.radians(geometry.rotation_angle_deg(geometry.inverse(poses[0]) @ poses[2]))
    # poses may yet turn out to be the inverse of what they are called
    steps = [np.linalg.norm(each[2, :3, 3] - each[0, :3, 3]) for each in (poses, geometry.inverse(poses))]
    far = float(np.median(np.linalg.norm(one.points, axis=1)))
    if turn > _MOST_TURN_RAD or min(steps) > _MOST_STEP * far:
        return 0.0
    twists = geometry.log(geometry.inverse(poses[0::2]) @ poses[1::2]) / step
    off = twists[1] - twists[0]
    return float(_LEVER_M * np.linalg.norm(off[:3]) + np.linalg.norm(off[3:])) + 1e-9


def timed(scan_stamp: float, after: np.ndarray, points: np.ndarray) -> TimedScan:
    """A scan without the points that have no time. scan_stamp: s; after: (N,) float64, s; points: (N, 3) float32, m"""
    known = np.isfinite(after)
    return TimedScan(scan_stamp, after[known], points[known])
