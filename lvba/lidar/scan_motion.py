"""The fraction of the sensor's motion during a scan that deskewing left in its points, from the planes that scans share.

A point measured tau seconds from its scan's stamp by a sensor that moves by `twist` a second belongs at
exp(fraction * tau * twist) p; the fraction is 0 where scans are deskewed, 1 where they are raw. Where they were deskewed
by rough poses, the difference of the twist from that of the rough poses is left, too. The fractions of both are unknowns
that all scans share, linear in the distances of points from their planes, with poses and planes free beside them.

What the points of a scan tell beside that is a motion of its own, and an acceleration: hands turn a sensor by 2 rad/s^2,
which bends a sweep of 0.1 s so much that a pose by a steady motion is 0.1 degrees off.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lvba import geometry
from lvba.arrays import Tangents, Times, Vector
from lvba.dataset import DESKEWED_BY
from lvba.lidar import scan_evidence
from lvba.lidar.point_times import PointClock
from lvba.lidar.row_times import RowClock
from lvba.lidar.scan_evidence import POSE_SIGMA, ByShared, OnPlanes, ScanEvidence, View

MOTIONS = 1 + len(DESKEWED_BY)
"""How many `motions` there are."""


def motions(twist: Tangents, rough: Tangents) -> np.ndarray:
    """(3, S, 6), rad/s and m/s: motions of which a fraction may be left in scans: all of it, and of its difference from
    that of the rough poses the rotation and the translation. Both motions (S, 6), scan frames"""
    turn, shift = np.zeros_like(twist), np.zeros_like(twist)
    turn[:, :3], shift[:, 3:] = (twist - rough)[:, :3], (twist - rough)[:, 3:]
    return np.stack([twist, turn, shift])


def left(fractions: Vector, twist: Tangents, rough: Tangents) -> np.ndarray:
    """(S, 6), rad/s and m/s: what is left in scans. fractions: (3,), of `motions`"""
    return np.asarray(np.tensordot(fractions, motions(twist, rough), 1))


def moved(
    points: np.ndarray, tau: Times, motion: np.ndarray, acceleration: np.ndarray | None = None
) -> np.ndarray:
    """exp(tau * motion) exp(tau^2 / 2 * acceleration) p of the points (N, 3), m, of one scan, (N, 3) float32.

    tau: (N,) s; motion: (6,) float64, rad/s and m/s, scan frame
    acceleration: (6,) float64, rad/s^2 and m/s^2, scan frame; None: none
    """
    if acceleration is not None and np.any(acceleration):
        points = geometry.moved_along(points, 0.5 * tau**2, acceleration)
    return geometry.moved_along(points, tau, motion).astype(np.float32)


@dataclass(frozen=True)
class MotionLeft:
    """What is left of the motion in the scans of a recording, and how they are corrected.

    fraction: of the motion; 0: deskewed, 1: raw; sigma: its standard deviation, both None where not measured
    by_rough: which of `DESKEWED_BY` scans were deskewed with by the rough poses: what these had wrong is left, too
    motion: (S, 6) float64, rad/s and m/s, scan frames, at the stamps; (0, 6): points stay as they are
    acceleration: (S, 6) float64, rad/s^2 and m/s^2, scan frames; (0, 6): none
    problem: why it was not measured, or not corrected
    pose_covariance: (S, 6, 6) float64, rad and m, local tangent: what the uncertainty of the motion adds to that of each
        scan's pose; (0, 6, 6): nothing
    """

    clock: PointClock | RowClock | None
    fraction: float | None
    sigma: float | None
    motion: np.ndarray
    problem: str = ""
    pose_covariance: np.ndarray = field(default_factory=lambda: np.zeros((0, 6, 6)))
    acceleration: np.ndarray = field(default_factory=lambda: np.zeros((0, 6)))
    by_rough: tuple[str, ...] = ()

    @property
    def fractions(self) -> np.ndarray:
        """(3,): of `motions`."""
        return np.array([self.fraction or 0.0, *(float(name in self.by_rough) for name in DESKEWED_BY)])

    @property
    def corrected(self) -> bool:
        """Whether points are moved."""
        return len(self.motion) > 0

    @property
    def sweep(self) -> float:
        """Seconds of the sensor's motion that are left in a scan."""
        return 0.0 if self.clock is None else (self.fraction or 0.0) * self.clock.sweep

    def points(self, points: np.ndarray, time: Times | None, index: int, stamp: float) -> np.ndarray:
        """(N, 3) float32, m: where the points of a scan belong.

        points: (N, 3) float32, m, scan frame; time: (N,), in the unit of the file; index: the scan's number; stamp: s
        """
        if not self.corrected or self.clock is None or (time is None and isinstance(self.clock, PointClock)):
            return points
        tau = self.clock.from_stamp(points, time, stamp)
        accelerated = self.acceleration[index] if len(self.acceleration) else None
        return moved(points, tau, self.motion[index], accelerated)

    def facts(self) -> dict[str, Any]:
        """As report.json has it (`lidar.motion_left`)."""
        named = (
            "clock",
            "fraction",
            "sigma",
            "by_rough",
            "motion",
            "acceleration",
            "problem",
        )
        return {name: getattr(self, name) for name in named}

    @staticmethod
    def of_facts(facts: Mapping[str, Any] | None) -> "MotionLeft | None":
        """As report.json has it (`lidar.motion_left`); None where points stay as they are, or it is not as written."""
        if not facts or not facts.get("motion"):
            return None
        try:
            motion = np.array(facts["motion"], float).reshape(-1, 6)
            # results of 0.2 have none
            acceleration = np.array(facts.get("acceleration") or [], float).reshape(-1, 6)
            if len(acceleration) not in (0, len(motion)):
                return None
            return MotionLeft(
                clock=_clock(facts["clock"]),
                fraction=facts["fraction"] if "fraction" in facts else facts["part"],  # before 0.3
                sigma=facts["sigma"],
                by_rough=tuple(facts.get("by_rough") or ()),  # older results have none
                motion=motion,
                acceleration=acceleration,
            )
        except (KeyError, TypeError, ValueError):
            return None


def _clock(facts: Mapping[str, Any]) -> PointClock | RowClock:
    if "down" not in facts:
        return PointClock(**facts)
    vectors = {name: np.array(facts[name], float).reshape(3) for name in ("position", "ahead", "down")}
    return RowClock(**{**facts, **vectors})


def by_parts(tau: Times, twists: np.ndarray) -> ByShared:
    """Derivative of points' distances by fractions of k motions.

    tau: (M,) s from the stamps; twists: (k, S, 6) float64, rad/s and m/s, scan frames
    """

    def derivative(points: OnPlanes) -> np.ndarray:
        return np.asarray(tau[points.chosen, None] * (points.by_pose @ twists[:, points.scan].T))

    return derivative


def evidence(view: View, tau: Times, twist: Tangents, rough: Tangents, taken_out: Tangents) -> ScanEvidence:
    """What the planes of S scans tell of the fractions of `motions`.

    tau: (M,) s from the stamps; twist, rough: (S, 6), rad/s and m/s, scan frames; taken_out: (S, 6), the motion that
        points were moved by already
    """
    twists = np.concatenate([motions(twist, rough), taken_out[None]])
    known = np.append(np.zeros(len(twists) - 1), -1.0)
    every = scan_evidence.evidence(view, by_parts(tau, twists), len(twists))
    return every.given(slice(0, len(twists) - 1), known)


@dataclass(frozen=True)
class Deviations:
    """What fixed planes tell of each scan's own motion beside the one its points were moved by, poses eliminated.

    A deviation is a motion, rad/s and m/s, and how much it grows over the sweep, in the same units: a point at tau goes
    by tau times the one and tau^2 / sweep times the other.
    By all planes of a scan, and by each half of them. information: (3, S, 12, 12) float64; gradient: (3, S, 12) float64;
    zeros of scans that see too little
    by_motion: (S, 6, 12) float64, by what the pose of a scan changes as its deviation does: rad and m
    """

    information: np.ndarray
    gradient: np.ndarray
    by_motion: np.ndarray

    @staticmethod
    def unseen(count: int) -> "Deviations":
        """Of so many scans of which nothing is known."""
        return Deviations(np.zeros((3, count, 12, 12)), np.zeros((3, count, 12)), np.zeros((count, 6, 12)))

    @property
    def steady(self) -> "Deviations":
        """The same of motions that do not grow: of the first six numbers."""
        return Deviations(self.information[:, :, :6, :6], self.gradient[:, :, :6], self.by_motion[:, :, :6])

    def beside(self, deviation: np.ndarray) -> "Deviations":
        """The same of whole deviations, of which a fraction was taken out of the points already.

        deviation: (S, 12) float64, that fraction
        """
        more = np.einsum("hsij,sj->hsi", self.information, deviation)
        return Deviations(self.information, self.gradient + more, self.by_motion)


def deviations(view: View, tau: Times, sweep: float) -> Deviations:
    """Of the scans of a view. tau: (M,) s from the stamps; sweep: s, of a scan"""
    result = Deviations.unseen(len(view.scans))
    for scan in range(len(view.scans)):
        terms = scan_evidence.terms(view, scan, lambda points: _by_deviation(points, tau, sweep), met=False)
        if terms is None:
            continue
        plane, both, _, r = terms
        half = _halves(plane)
        for number, chosen in enumerate((half >= 0, half == 0, half == 1)):
            information, gradient, by_motion = _of_motion(both[chosen], r[chosen])
            result.information[number, scan], result.gradient[number, scan] = information, gradient
            if number == 0:
                result.by_motion[scan] = by_motion
    return result


def _by_deviation(points: OnPlanes, tau: Times, sweep: float) -> np.ndarray:
    """(n, 12): derivative of distances by the deviation of a scan."""
    since = tau[points.chosen, None]
    return np.concatenate([since * points.by_pose, since**2 / sweep * points.by_pose], axis=1)


def _halves(plane: np.ndarray) -> np.ndarray:
    """(n,): 0 or 1: which half of the planes (n,) of points each is in; both have about as many points."""
    _, label, count = np.unique(plane, return_inverse=True, return_counts=True)
    rank = np.empty(len(count), int)
    rank[np.argsort(-count, kind="stable")] = np.arange(len(count))
    return np.asarray(((rank + 1) // 2 % 2)[label])


def _of_motion(both: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Information (12, 12) and gradient (12,) of a deviation, and derivative (6, 12) of the pose by it.

    both: (n, 18) float64, derivatives of the distances r (n,) by pose and deviation
    """
    normal, right = np.einsum("ni,nj->ij", both, both), -np.einsum("ni,n->i", both, r)
    pose = normal[:6, :6] + np.diag(POSE_SIGMA**-2.0)
    through = np.linalg.solve(pose, normal[:6, 6:]).T
    return normal[6:, 6:] - through @ normal[:6, 6:], right[6:] - through @ right[:6], -through.T


_PASSES = 30
_TOO_SURE = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
"""By how much points may be less sure of a motion than their scatter says: errors of a depth camera, and of planes that
are not quite plane, are alike over many points."""
_SURE = 2.0
"""Standard deviations by which what is left must get less on planes that a motion was not found by."""


_USUAL = 3.0
"""Times the median that one scan counts at most: else one alone would decide for all."""


def most_likely(known: Deviations, wider: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """(S, 12): deviations of all scans, drawn towards zero as far as chance explains them, and what their uncertainty
    adds to the covariances of the scans' poses, (S, 6, 6).

    wider: (S, 2) float64, rad/s and m/s, by how much the motion of single scans may be off that the path tells less of:
        those have deviations whatever the others have; None: of none
    How sure points are of them is judged by what each half of a scan's planes tells of the other half; zeros where that
    is nothing, and no motion grows where that tells nothing more.
    """
    steady, growing = _Judged.of(known.steady), _Judged.of(known)
    better, error = _usual(growing.falls - steady.falls)
    grows = better > _SURE * error
    judged = growing if grows else steady
    gain, error = _usual(judged.falls)
    deviation, covariance = np.zeros(known.gradient.shape[1:]), np.zeros((len(known.by_motion), 6, 6))
    if wider is None:
        wider = np.zeros((len(deviation), 2))
    every = gain > _SURE * error
    if not (every or wider.any()):
        return deviation, covariance
    whole = grows and every
    used = known if whole else known.steady
    chosen = slice(None) if every else np.flatnonzero(wider.any(axis=1))
    information, gradient = used.information[0, chosen], used.gradient[0, chosen]
    likely, spread = _drawn_to_zero(information / judged.factor, gradient / judged.factor, wider[chosen])
    deviation[chosen, : likely.shape[1]] = likely
    covariance[chosen] = _of_poses(used.by_motion[chosen], spread)
    if not whole:
        covariance += _of_poses(known.by_motion[:, :, 6:], _unsteady(deviation[:, :6], wider))
    return deviation, covariance


def _of_poses(by_motion: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(S, 6, 6): what deviations with a covariance (S, n, n) add to those of poses. by_motion: (S, 6, n)"""
    return np.asarray(by_motion @ covariance @ by_motion.transpose(0, 2, 1))


def _unsteady(deviation: np.ndarray, wider: np.ndarray) -> np.ndarray:
    """(S, 6, 6): covariance of how much steady deviations (S, 6) may grow. wider: (S, 2), as of `most_likely`

    A motion that is further from the path than it lets expect has changed near by, perhaps during the sweep: by as much.
    """
    size = np.square(deviation).reshape(len(deviation), 2, 3).mean(axis=2)
    beyond = np.where(wider > 0, np.maximum(size - wider**2, 0.0), 0.0)
    return np.asarray(np.repeat(beyond, 3, axis=1)[:, :, None] * np.eye(6))


@dataclass(frozen=True)
class _Judged:
    """factor: by which information is too large; falls: (S,) of half the sum of squares on either half of a scan's planes
    by what the other half tells"""

    factor: float
    falls: np.ndarray

    @staticmethod
    def of(known: Deviations) -> "_Judged":
        """With the factor of which scans fall most."""
        each = [_Judged(factor, _held_out(known, factor)) for factor in _TOO_SURE]
        return max(each, key=lambda judged: _usual(judged.falls)[0])


def _held_out(known: Deviations, factor: float) -> np.ndarray:
    """(S,), as `_Judged` has them."""
    falls = np.zeros(known.gradient.shape[1])
    for source, judge in ((1, 2), (2, 1)):
        motion, _ = _drawn_to_zero(known.information[source] / factor, known.gradient[source] / factor)
        falls += np.einsum("si,si->s", known.gradient[judge], motion)
        falls -= 0.5 * np.einsum("si,sij,sj->s", motion, known.information[judge], motion)
    return falls


def _usual(falls: np.ndarray) -> tuple[float, float]:
    """The sum over scans (S,), each counting as much as is usual at most, and its standard error."""
    most = _USUAL * np.median(np.abs(falls))
    usual = np.clip(falls, -most, most)
    return float(usual.sum()), float(np.sqrt(np.sum(usual**2)))


def _drawn_to_zero(
    information: np.ndarray, gradient: np.ndarray, wider: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """(S, n), and covariances (S, n, n), by information (S, n, n) and gradient (S, n), float64; zeros where nothing is
    known.

    Their variances, of each three numbers one, are those that make the whole most likely (expectation maximization); of
    scans whose motion may be off by more (`most_likely`), those and that, which the others do not depend on.
    """
    scans, size = gradient.shape
    known = np.trace(information, axis1=1, axis2=2) > 0
    deviation, covariance = np.zeros(gradient.shape), np.zeros(information.shape)
    more = np.zeros((scans, size // 3))
    if wider is not None:
        more[:] = np.tile(np.square(wider), (1, size // 6))
    usual = known & ~more.any(axis=1)
    variance = np.full(size // 3, 0.1**2 if usual.any() else 1e-12)
    for _ in range(_PASSES if usual.any() else int(known.any())):
        inverse = np.repeat(1 / (variance + more[known]), 3, axis=1)
        covariance[known] = np.linalg.inv(information[known] + inverse[:, :, None] * np.eye(size))
        deviation[known] = np.einsum("sij,sj->si", covariance[known], gradient[known])
        if usual.any():
            square = deviation[usual] ** 2 + np.diagonal(covariance[usual], axis1=1, axis2=2)
            variance = np.maximum(square.reshape(len(square), -1, 3).mean(axis=(0, 2)), 1e-12)
    return deviation, covariance
