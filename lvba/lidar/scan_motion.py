"""The part of the sensor's motion during a scan that deskewing left in its points, from the planes that scans share.

A point measured tau seconds from its scan's stamp by a sensor that moves by `twist` a second belongs at
exp(part * tau * twist) p; part is 0 where scans are deskewed, 1 where they are raw. It is the one unknown that all scans
share, linear in the distances of points from their planes, with poses and planes free beside it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy import linalg, sparse

from lvba import geometry
from lvba.arrays import Poses, Tangents, Times
from lvba.dataset import Scan
from lvba.lidar.plane import PlanePoints, Planes
from lvba.lidar.point_times import PointClock
from lvba.lidar.scan import Scans

_POSE_SIGMA = np.array([0.01, 0.01, 0.01, 0.05, 0.05, 0.05])
"""rad and m: how far poses may move beside the part, where planes leave them open."""
_FEWEST_POINTS = 30
_UNCERTAIN = 1e-6
"""Least information that planes have of themselves: of a plane seen along a line, nothing else tells its tilt."""


@dataclass(frozen=True)
class Evidence:
    """What some scans tell of the part that is left, poses and planes eliminated; adds up over scans that share no plane.

    information: second derivative of half the sum of squared normalized distances by the part
    gradient: minus the first derivative, at the part so far
    spread: variance of the gradient, as the planes' own gradients differ
    """

    information: float
    gradient: float
    spread: float

    @property
    def change(self) -> float:
        """Of the part, to the least sum."""
        return self.gradient / self.information if self.information > 0 else 0.0

    @property
    def sigma(self) -> float:
        """Its standard deviation; infinite where nothing tells of the part."""
        return float(np.sqrt(self.spread)) / self.information if self.information > 0 else float("inf")

    def __add__(self, other: "Evidence") -> "Evidence":
        return Evidence(
            self.information + other.information,
            self.gradient + other.gradient,
            self.spread + other.spread,
        )


NOTHING = Evidence(0.0, 0.0, 0.0)


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

    def points(self, scan: Scan, index: int, stamp: float) -> np.ndarray:
        """(N, 3) float32, m: where the points of a scan belong. index: its number; stamp: s"""
        if not self.corrected or self.clock is None or scan.time is None:
            return scan.points
        return moved(scan.points, self.clock.from_stamp(scan.time, stamp), self.motion[index])

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


def evidence(
    scans: Scans, tau: Times, twist: Tangents, world_from_scan: Poses, planes: Planes, labels: PlanePoints
) -> Evidence:
    """What the planes of S scans tell of the part that is left.

    scans: M points, m, scan frames; tau: (M,) s from the stamps; twist: (S, 6), rad/s and m/s, scan frames
    world_from_scan: (S, 4, 4), refined; planes, labels: found there
    Gauss-Newton; the spread is the sum of squares of each plane's gradient (Huber's sandwich, by planes).
    """
    view = _View(
        scans=scans, tau=tau, twist=twist, world_from_scan=world_from_scan, planes=planes, labels=labels
    )
    sums = [each for each in (_of_scan(view, scan) for scan in range(len(scans))) if each is not None]
    return _eliminated(sums, len(scans), len(planes)) if sums else NOTHING


def deviations(
    scans: Scans, tau: Times, world_from_scan: Poses, planes: Planes, labels: PlanePoints
) -> tuple[np.ndarray, np.ndarray]:
    """What fixed planes tell of each scan's own motion beside the one its points were moved by.

    As in `evidence`. Information (S, 6, 6) and gradient (S, 6) of (rad/s, m/s), poses eliminated; zeros of scans that see
    too little.
    """
    still = np.zeros((len(scans), 6))
    view = _View(
        scans=scans, tau=tau, twist=still, world_from_scan=world_from_scan, planes=planes, labels=labels
    )
    information, gradient = np.zeros((len(scans), 6, 6)), np.zeros((len(scans), 6))
    for scan in range(len(scans)):
        chosen = _on_planes(view, scan)
        if chosen is None:
            continue
        x, _, r = _terms(view, scan, *chosen)
        both = np.concatenate([x[:, :6], tau[chosen[1], None] * x[:, :6]], axis=1)
        normal, right = np.einsum("ni,nj->ij", both, both), -np.einsum("ni,n->i", both, r)
        pose = normal[:6, :6] + np.diag(_POSE_SIGMA**-2.0)
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


class _View(NamedTuple):
    """As the arguments of `evidence`."""

    scans: Scans
    tau: np.ndarray
    twist: np.ndarray
    world_from_scan: np.ndarray
    planes: Planes
    labels: PlanePoints


class _Sums(NamedTuple):
    """Of a scan's points on e planes, derivatives x (7,) by pose and part, y (3,) by plane, r: normalized distance.

    plane: (e,); xx: (7, 7); xy: (e, 7, 3); yy: (e, 3, 3); xr: (e, 7); yr: (e, 3)
    """

    scan: int
    plane: np.ndarray
    xx: np.ndarray
    xy: np.ndarray
    yy: np.ndarray
    xr: np.ndarray
    yr: np.ndarray


def _on_planes(view: _View, scan: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Planes (n,), ascending, and numbers (n,) of a scan's points that lie on them; None: too few."""
    first, last = view.scans.offsets[scan : scan + 2]
    plane = view.labels.plane[first:last]
    order = np.argsort(plane, kind="stable")
    order = order[np.searchsorted(plane[order], 0) :]
    return (plane[order], first + order) if len(order) >= _FEWEST_POINTS else None


def _of_scan(view: _View, scan: int) -> _Sums | None:
    chosen = _on_planes(view, scan)
    if chosen is None:
        return None
    plane = chosen[0]
    x, y, r = _terms(view, scan, *chosen)
    starts = np.flatnonzero(np.r_[True, np.diff(plane) > 0])
    return _Sums(
        scan=scan,
        plane=plane[starts],
        xx=np.einsum("ni,nj->ij", x, x),
        xy=np.add.reduceat(x[:, :, None] * y[:, None, :], starts),
        yy=np.add.reduceat(y[:, :, None] * y[:, None, :], starts),
        xr=np.add.reduceat(x * r[:, None], starts),
        yr=np.add.reduceat(y * r[:, None], starts),
    )


def _terms(
    view: _View, scan: int, plane: np.ndarray, chosen: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """x (n, 7), y (n, 3) and r (n,) of points (n,) of a scan on planes (n,)."""
    planes, pose = view.planes, view.world_from_scan[scan]
    point = view.scans.points[chosen].astype(float)
    thickness = planes.eigenvalues[:, 0]
    scale = 1.0 / np.sqrt(np.maximum(thickness, np.median(thickness)))[plane]
    normal = planes.normal[plane]
    away = geometry.transform_points(pose, point) - planes.center[plane]
    local = normal @ pose[:3, :3]
    by_pose = np.concatenate([np.cross(point, local), local], axis=1)
    by_part = view.tau[chosen] * (by_pose @ view.twist[scan])
    across = np.einsum("ni,nij->nj", away, planes.axes[plane][:, :, 1:])
    x = np.concatenate([by_pose, by_part[:, None]], axis=1) * scale[:, None]
    y = np.concatenate([np.ones((len(plane), 1)), across], axis=1) * scale[:, None]
    return x, y, np.einsum("ni,ni->n", normal, away) * scale


def _eliminated(sums: list[_Sums], scans: int, planes: int) -> Evidence:
    """The sums by the part alone."""
    plane = np.concatenate([each.plane for each in sums])
    scan = np.concatenate([np.full(len(each.plane), each.scan) for each in sums])
    xy, xr = (np.concatenate([getattr(each, name) for each in sums]) for name in ("xy", "xr"))
    square, right = np.tile(_UNCERTAIN * np.eye(3), (planes, 1, 1)), np.zeros((planes, 3))
    for each in sums:
        square[each.plane] += each.yy
        right[each.plane] += each.yr
    inverse = np.linalg.inv(np.linalg.cholesky(square))
    right = np.einsum("pij,pj->pi", inverse, right)
    white = np.einsum("eij,ekj->eik", xy, inverse[plane])
    row = np.where(np.arange(7) < 6, 6 * scan[:, None] + np.arange(7), 6 * scans)
    coupling = _sparse(white, row, plane, (6 * scans + 1, 3 * planes))
    normal, gradient = np.zeros((6 * scans + 1, 6 * scans + 1)), -(coupling @ right.ravel())
    for each in sums:
        own = np.append(np.arange(6 * each.scan, 6 * each.scan + 6), 6 * scans)
        normal[np.ix_(own, own)] += each.xx
    np.add.at(gradient, row, xr)
    normal -= (coupling @ coupling.T).toarray()
    normal[:-1, :-1] += np.diag(np.tile(_POSE_SIGMA**-2.0, scans))
    through = np.append(-linalg.solve(normal[:-1, :-1], normal[:-1, -1], assume_a="pos"), 1.0)
    own = np.bincount(plane, np.einsum("ei,ei->e", xr, through[row]), planes)
    own -= np.einsum("pi,pi->p", (coupling.T @ through).reshape(planes, 3), right)
    return Evidence(float(normal[-1] @ through), -float(gradient @ through), float(np.sum(own**2)))


def _sparse(
    blocks: np.ndarray, row: np.ndarray, plane: np.ndarray, shape: tuple[int, int]
) -> sparse.csr_matrix:
    """Blocks (E, 7, 3) at rows (E, 7) and the columns of planes (E,)."""
    rows = np.repeat(row, 3, axis=1).ravel()
    columns = np.tile(3 * plane[:, None] + np.arange(3), (1, 7)).ravel()
    return sparse.csr_matrix((blocks.ravel(), (rows, columns)), shape=shape)
