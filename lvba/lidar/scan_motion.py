"""The part of the sensor's motion during a scan that deskewing left in its points, from the planes that scans share.

A point measured tau seconds from its scan's stamp by a sensor that moves by `twist` a second belongs at
exp(part * tau * twist) p; part is 0 where scans are deskewed, 1 where they are raw. It is the one unknown that all scans
share, linear in the distances of points from their planes, with poses and planes free beside it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from lvba import geometry
from lvba.arrays import Tangents, Times
from lvba.lidar import scan_evidence
from lvba.lidar.point_times import PointClock
from lvba.lidar.scan_evidence import POSE_SIGMA, ByShared, Evidence, OnPlanes, View


def moved(points: np.ndarray, tau: Times, motion: np.ndarray) -> np.ndarray:
    """exp(tau * motion) p of the points (N, 3), m, of one scan, (N, 3) float32.

    tau: (N,) s; motion: (6,) float64, rad/s and m/s, scan frame
    """
    there = geometry.exp(tau[:, None] * motion)
    return np.asarray(np.einsum("nij,nj->ni", there[:, :3, :3], points) + there[:, :3, 3], np.float32)


@dataclass(frozen=True)
class MotionLeft:
    """What is left of the motion in the scans of a recording, and how they are corrected.

    part: of the motion; 0: deskewed, 1: raw; sigma: its standard deviation, both None where not measured
    motion: (S, 6) float64, rad/s and m/s, scan frames: part times twist; (0, 6): points stay as they are
    problem: why it was not measured, or not corrected
    """

    clock: PointClock | None
    part: float | None
    sigma: float | None
    motion: np.ndarray
    problem: str = ""

    @property
    def corrected(self) -> bool:
        """Whether points are moved."""
        return len(self.motion) > 0

    def points(self, points: np.ndarray, time: Times | None, index: int, stamp: float) -> np.ndarray:
        """(N, 3) float32, m: where the points of a scan belong.

        points: (N, 3) float32, m, scan frame; time: (N,), in the unit of the file; index: the scan's number; stamp: s
        """
        if not self.corrected or self.clock is None or time is None:
            return points
        return moved(points, self.clock.from_stamp(time, stamp), self.motion[index])

    @staticmethod
    def of_facts(facts: Mapping[str, Any] | None) -> "MotionLeft | None":
        """As report.json has it (`lidar.motion_left`); None where points stay as they are, or it is not as written."""
        if not facts or not facts.get("motion"):
            return None
        try:
            motion = np.array(facts["motion"], float).reshape(-1, 6)
            return MotionLeft(PointClock(**facts["clock"]), facts["part"], facts["sigma"], motion)
        except (KeyError, TypeError, ValueError):
            return None


def by_part(tau: Times, twist: Tangents) -> ByShared:
    """Derivative of points' distances by the part.

    tau: (M,) s from the stamps; twist: (S, 6), rad/s and m/s, scan frames
    """

    def derivative(points: OnPlanes) -> np.ndarray:
        return np.asarray(tau[points.chosen, None] * (points.by_pose @ twist[points.scan])[:, None])

    return derivative


def evidence(view: View, tau: Times, twist: Tangents) -> Evidence:
    """What the planes of S scans tell of the part that is left: one number.

    tau: (M,) s from the stamps; twist: (S, 6), rad/s and m/s, scan frames
    """
    return scan_evidence.evidence(view, by_part(tau, twist), 1)


def deviations(view: View, tau: Times) -> tuple[np.ndarray, np.ndarray]:
    """What fixed planes tell of each scan's own motion beside the one its points were moved by.

    tau: (M,) s from the stamps. Information (S, 6, 6) and gradient (S, 6) of (rad/s, m/s), poses eliminated; zeros of
    scans that see too little.
    """
    count = len(view.scans)
    information, gradient = np.zeros((count, 6, 6)), np.zeros((count, 6))
    for scan in range(count):
        terms = scan_evidence.terms(
            view, scan, lambda points: tau[points.chosen, None] * points.by_pose, met=False
        )
        if terms is None:
            continue
        _, both, _, r = terms
        normal, right = np.einsum("ni,nj->ij", both, both), -np.einsum("ni,n->i", both, r)
        pose = normal[:6, :6] + np.diag(POSE_SIGMA**-2.0)
        through = np.linalg.solve(pose, normal[:6, 6:]).T
        information[scan] = normal[6:, 6:] - through @ normal[:6, 6:]
        gradient[scan] = right[6:] - through @ right[:6]
    return information, gradient


_PASSES = 30


def most_likely(information: np.ndarray, gradient: Tangents) -> np.ndarray:
    """(S, 6): deviations of all scans, drawn towards zero as far as chance explains them.

    information: (S, 6, 6) float64; gradient: (S, 6) float64, as `deviations` gives them
    Their variances, one of rotations and one of translations, are those that make the whole most likely (expectation
    maximization).
    """
    deviation, known = np.zeros(gradient.shape), np.trace(information, axis1=1, axis2=2) > 0
    variance = np.full(2, 0.1**2)
    for _ in range(_PASSES if known.any() else 0):
        covariance = np.linalg.inv(information[known] + np.diag(np.repeat(1 / variance, 3)))
        deviation[known] = np.einsum("sij,sj->si", covariance, gradient[known])
        square = deviation[known] ** 2 + np.diagonal(covariance, axis1=1, axis2=2)
        variance = np.maximum(square.reshape(-1, 2, 3).mean(axis=(0, 2)), 1e-12)
    return deviation
