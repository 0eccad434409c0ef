"""The part of the sensor's motion during a scan that deskewing left in its points, from the planes that scans share.

A point measured tau seconds from its scan's stamp by a sensor that moves by `twist` a second belongs at
exp(part * tau * twist) p; part is 0 where scans are deskewed, 1 where they are raw. It is the one unknown that all scans
share, linear in the distances of points from their planes, with poses and planes free beside it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lvba import geometry
from lvba.arrays import Tangents, Times
from lvba.lidar import scan_evidence
from lvba.lidar.point_times import PointClock
from lvba.lidar.row_times import RowClock
from lvba.lidar.scan_evidence import POSE_SIGMA, ByShared, OnPlanes, ScanEvidence, View


def moved(points: np.ndarray, tau: Times, motion: np.ndarray) -> np.ndarray:
    """exp(tau * motion) p of the points (N, 3), m, of one scan, (N, 3) float32.

    tau: (N,) s; motion: (6,) float64, rad/s and m/s, scan frame
    """
    return geometry.moved_along(points, tau, motion).astype(np.float32)


@dataclass(frozen=True)
class MotionLeft:
    """What is left of the motion in the scans of a recording, and how they are corrected.

    part: of the motion; 0: deskewed, 1: raw; sigma: its standard deviation, both None where not measured
    motion: (S, 6) float64, rad/s and m/s, scan frames: part times twist; (0, 6): points stay as they are
    problem: why it was not measured, or not corrected
    pose_covariance: (S, 6, 6) float64, rad and m, local tangent: what the uncertainty of the motion adds to that of each
        scan's pose; (0, 6, 6): nothing
    """

    clock: PointClock | RowClock | None
    part: float | None
    sigma: float | None
    motion: np.ndarray
    problem: str = ""
    pose_covariance: np.ndarray = field(default_factory=lambda: np.zeros((0, 6, 6)))

    @property
    def corrected(self) -> bool:
        """Whether points are moved."""
        return len(self.motion) > 0

    @property
    def sweep(self) -> float:
        """Seconds of the sensor's motion that are left in a scan."""
        return 0.0 if self.clock is None else (self.part or 0.0) * self.clock.sweep

    def points(self, points: np.ndarray, time: Times | None, index: int, stamp: float) -> np.ndarray:
        """(N, 3) float32, m: where the points of a scan belong.

        points: (N, 3) float32, m, scan frame; time: (N,), in the unit of the file; index: the scan's number; stamp: s
        """
        if not self.corrected or self.clock is None or (time is None and isinstance(self.clock, PointClock)):
            return points
        return moved(points, self.clock.from_stamp(points, time, stamp), self.motion[index])

    def facts(self) -> dict[str, Any]:
        """As report.json has it (`lidar.motion_left`)."""
        return {name: getattr(self, name) for name in ("clock", "part", "sigma", "motion", "problem")}

    @staticmethod
    def of_facts(facts: Mapping[str, Any] | None) -> "MotionLeft | None":
        """As report.json has it (`lidar.motion_left`); None where points stay as they are, or it is not as written."""
        if not facts or not facts.get("motion"):
            return None
        try:
            motion = np.array(facts["motion"], float).reshape(-1, 6)
            clock = _clock(facts["clock"])
            return MotionLeft(clock=clock, part=facts["part"], sigma=facts["sigma"], motion=motion)
        except (KeyError, TypeError, ValueError):
            return None


def _clock(facts: Mapping[str, Any]) -> PointClock | RowClock:
    if "down" not in facts:
        return PointClock(**facts)
    vectors = {name: np.array(facts[name], float).reshape(3) for name in ("position", "ahead", "down")}
    return RowClock(**{**facts, **vectors})


def by_part(tau: Times, twist: Tangents) -> ByShared:
    """Derivative of points' distances by the part.

    tau: (M,) s from the stamps; twist: (S, 6), rad/s and m/s, scan frames
    """

    def derivative(points: OnPlanes) -> np.ndarray:
        return np.asarray(tau[points.chosen, None] * (points.by_pose @ twist[points.scan])[:, None])

    return derivative


def evidence(view: View, tau: Times, twist: Tangents) -> ScanEvidence:
    """What the planes of S scans tell of the part that is left: one number.

    tau: (M,) s from the stamps; twist: (S, 6), rad/s and m/s, scan frames
    """
    return scan_evidence.evidence(view, by_part(tau, twist), 1)


@dataclass(frozen=True)
class Deviations:
    """What fixed planes tell of each scan's own motion beside the one its points were moved by, poses eliminated.

    By all planes of a scan, and by each half of them. information: (3, S, 6, 6) float64; gradient: (3, S, 6) float64; of
    (rad/s, m/s); zeros of scans that see too little
    by_motion: (S, 6, 6) float64, by what the pose of a scan changes as its motion does: rad and m by rad/s and m/s
    """

    information: np.ndarray
    gradient: np.ndarray
    by_motion: np.ndarray

    @staticmethod
    def unseen(count: int) -> "Deviations":
        """Of so many scans of which nothing is known."""
        return Deviations(np.zeros((3, count, 6, 6)), np.zeros((3, count, 6)), np.zeros((count, 6, 6)))


def deviations(view: View, tau: Times) -> Deviations:
    """Of the scans of a view. tau: (M,) s from the stamps"""
    result = Deviations.unseen(len(view.scans))
    for scan in range(len(view.scans)):
        terms = scan_evidence.terms(
            view, scan, lambda points: tau[points.chosen, None] * points.by_pose, met=False
        )
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


def _halves(plane: np.ndarray) -> np.ndarray:
    """(n,): 0 or 1: which half of the planes (n,) of points each is in; both have about as many points."""
    _, label, count = np.unique(plane, return_inverse=True, return_counts=True)
    rank = np.empty(len(count), int)
    rank[np.argsort(-count, kind="stable")] = np.arange(len(count))
    return np.asarray(((rank + 1) // 2 % 2)[label])


def _of_motion(both: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Information (6, 6) and gradient (6,) of a motion, and derivative (6, 6) of the pose by it.

    both: (n, 12) float64, derivatives of the distances r (n,) by pose and motion
    """
    normal, right = np.einsum("ni,nj->ij", both, both), -np.einsum("ni,n->i", both, r)
    pose = normal[:6, :6] + np.diag(POSE_SIGMA**-2.0)
    through = np.linalg.solve(pose, normal[:6, 6:]).T
    return normal[6:, 6:] - through @ normal[:6, 6:], right[6:] - through @ right[:6], -through.T


_PASSES = 30
_TOO_SURE = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
"""By how much points may be less sure of a motion than their scatter says: errors of a depth camera, and of planes that
are not quite plane, are alike over many points."""
_SURE = 3.0
"""Standard deviations by which what is left must get less on planes that a motion was not found by."""


_USUAL = 3.0
"""Times the median that one scan counts at most: else one alone would decide for all."""


def most_likely(known: Deviations) -> tuple[np.ndarray, np.ndarray]:
    """(S, 6): deviations of all scans, drawn towards zero as far as chance explains them, and what their uncertainty adds
    to the covariances of the scans' poses, (S, 6, 6).

    How sure points are of them is judged by what each half of a scan's planes tells of the other half; zeros where that
    is nothing.
    """
    gains = [_held_out(known, factor) for factor in _TOO_SURE]
    best = int(np.argmax([gain for gain, _ in gains]))
    gain, error = gains[best]
    if not gain > _SURE * error:
        return np.zeros(known.gradient.shape[1:]), np.zeros(known.by_motion.shape)
    motion, covariance = _drawn_to_zero(
        known.information[0] / _TOO_SURE[best], known.gradient[0] / _TOO_SURE[best]
    )
    return motion, known.by_motion @ covariance @ known.by_motion.transpose(0, 2, 1)


def _held_out(known: Deviations, factor: float) -> tuple[float, float]:
    """By how much half the sum of squares on either half of the planes falls by what the other half tells, over all
    scans, and its standard error. factor: by which information is too large"""
    falls = np.zeros(known.gradient.shape[1])
    for source, judge in ((1, 2), (2, 1)):
        motion, _ = _drawn_to_zero(known.information[source] / factor, known.gradient[source] / factor)
        falls += np.einsum("si,si->s", known.gradient[judge], motion)
        falls -= 0.5 * np.einsum("si,sij,sj->s", motion, known.information[judge], motion)
    most = _USUAL * np.median(np.abs(falls))
    usual = np.clip(falls, -most, most)
    return float(usual.sum()), float(np.sqrt(np.sum(usual**2)))


def _drawn_to_zero(information: np.ndarray, gradient: Tangents) -> tuple[np.ndarray, np.ndarray]:
    """(S, 6), and covariances (S, 6, 6), by information (S, 6, 6) and gradient (S, 6), float64; zeros where nothing is
    known.

    Their variances, one of rotations and one of translations, are those that make the whole most likely (expectation
    maximization).
    """
    known = np.trace(information, axis1=1, axis2=2) > 0
    deviation, covariance = np.zeros(gradient.shape), np.zeros(information.shape)
    variance = np.full(2, 0.1**2)
    for _ in range(_PASSES if known.any() else 0):
        covariance[known] = np.linalg.inv(information[known] + np.diag(np.repeat(1 / variance, 3)))
        deviation[known] = np.einsum("sij,sj->si", covariance[known], gradient[known])
        square = deviation[known] ** 2 + np.diagonal(covariance[known], axis1=1, axis2=2)
        variance = np.maximum(square.reshape(-1, 2, 3).mean(axis=(0, 2)), 1e-12)
    return deviation, covariance
