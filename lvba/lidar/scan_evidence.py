"""What planes tell of numbers that all scans share, such as errors of the range sensor, with poses and planes free.

Gauss-Newton on the distances of points from their planes. Derivatives are those of the place where the beam meets the
plane, not of the point: noise along the beam is in the distance and would be in the derivative, and their product is no
noise any more (20 mm of noise made 0.01 degrees of elevation, six standard deviations).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy import linalg, sparse
from scipy.special import chdtrc

from lvba import geometry
from lvba.arrays import Indices, Poses, Vector
from lvba.lidar.neighborhoods import neighborhoods
from lvba.lidar.plane import PlanePoints, Planes
from lvba.lidar.pose_response import PoseResponse
from lvba.lidar.scan import Scans

POSE_SIGMA = np.array([0.01, 0.01, 0.01, 0.05, 0.05, 0.05])
"""rad and m: how far poses may move beside the shared numbers, where planes leave them open."""
_FEWEST_POINTS = 30
_UNCERTAIN = 1e-6
"""Least information that planes have of themselves: of a plane seen along a line, nothing else tells its tilt."""
_AWAY = 9.0
"""Squared distance, in those that are usual, from which on a point is on no plane."""
_ALIKE = 1e10
"""Condition of the information, by numbers of equal size, above which planes cannot tell them apart."""
_HALVINGS = 6
"""Times that the planes of some scans are halved into neighborhoods. What a model lacks, such as errors of single rings
of a LiDAR, is alike on planes beside each other: on drives, standard deviations are 2 to 3 times those of planes that err
each by itself. Of simulated sensors, neighborhoods make no difference."""
_GRAZING = 0.05
"""Cosine of incidence below which where a beam meets its plane is as uncertain as the plane."""


class OnPlanes(NamedTuple):
    """Points of a scan where their beams meet the planes.

    scan: its number; chosen: (n,) int64, of the points among those of all scans
    place: (n, 3) m, normal: (n, 3) of the planes, scan frame; by_pose: (n, 6), derivative of the distance
    """

    scan: int
    chosen: np.ndarray
    place: np.ndarray
    normal: np.ndarray
    by_pose: np.ndarray


class Seen(NamedTuple):
    """Points of a scan on planes.

    plane: (n,) int64, ascending; number: (n,) int64, of the points among those of all scans
    point: (n, 3) float64, m, scan frame; distance: (n,) float64, m, from their planes
    """

    plane: np.ndarray
    number: np.ndarray
    point: np.ndarray
    distance: np.ndarray


ByShared = Callable[[OnPlanes], np.ndarray]
"""Derivative of the points' distances from their planes by the k shared numbers, (n, k)."""


@dataclass(frozen=True)
class ScanEvidence:
    """What some scans tell of k shared numbers, poses and planes eliminated; adds up over scans that share no plane.

    information: (k, k), second derivative of half the sum of squared normalized distances by the numbers
    gradient: (k,), minus the first derivative
    own: (G, k), the first derivative of each neighborhood's part of the sum; curvature: (G, k, k), the second
    poses: how they move by a unit of each number
    """

    information: np.ndarray
    gradient: np.ndarray
    own: np.ndarray
    curvature: np.ndarray
    poses: PoseResponse

    @property
    def change(self) -> np.ndarray:
        """(k,), of the numbers, to the least sum; zeros of those that nothing tells of."""
        known, inverse = self._inverse()
        change = np.zeros(len(self.gradient))
        change[known] = inverse @ self.gradient[known]
        return change

    @property
    def covariance(self) -> np.ndarray:
        """(k, k), of the change: as the gradients of neighborhoods of planes differ there (Huber's sandwich, by clusters:
        Liang, Zeger: Longitudinal data analysis using generalized linear models, 1986). Infinite variances where nothing
        tells."""
        known, inverse = self._inverse()
        covariance = np.diag(np.where(known, 0.0, np.inf))
        there = np.einsum("ij,pj->pi", inverse, (self.own + self.curvature @ self.change)[:, known])
        covariance[np.ix_(known, known)] = np.einsum("pi,pj->ij", there, there)
        return covariance

    def _inverse(self) -> tuple[np.ndarray, np.ndarray]:
        """Which numbers (k,) bool the planes tell of, and the inverse of the information of these."""
        size = np.sqrt(np.maximum(np.diagonal(self.information), 0.0))
        known = size > 0
        inside = (self.information / np.maximum(np.outer(size, size), 1e-300))[np.ix_(known, known)]
        if known.any() and not np.linalg.cond(inside) < _ALIKE:
            known, inside = known & False, inside[:0, :0]
        return known, np.linalg.inv(inside) / np.outer(size[known], size[known])

    @property
    def sigma(self) -> np.ndarray:
        """(k,) standard deviations; infinite where nothing tells."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance)))

    def follows(self, columns: slice, number: int) -> np.ndarray:
        """(n,): how the change of some of the numbers moves by a unit of another one that is not estimated, the rest
        known to be zero; zeros of those that nothing tells of."""
        known, inverse = self.of(columns)._inverse()
        moved = np.zeros(len(known))
        moved[known] = -inverse @ self.information[columns, number][known]
        return moved

    def of(self, columns: slice) -> "ScanEvidence":
        """Of some of the numbers, the others known to be zero."""
        return ScanEvidence(
            information=self.information[columns, columns],
            gradient=self.gradient[columns],
            own=self.own[:, columns],
            curvature=self.curvature[:, columns, columns],
            poses=self.poses.of_numbers(columns),
        )

    def given(self, columns: slice, values: Vector) -> "ScanEvidence":
        """Of some of the numbers, the others known. values: (k,), of all, of which those of the others count"""
        others = np.array(values, float)
        others[columns] = 0.0
        rest = self.of(columns)
        return replace(
            rest,
            gradient=rest.gradient - self.information[columns] @ others,
            own=rest.own + self.curvature[:, columns] @ others,
        )

    def chance(self, columns: slice) -> float:
        """How often some of the numbers are estimated so far off together if they are zero, the others whatever they are
        (Wald); 1 where nothing tells."""
        off, spread = self.change[columns], self.covariance[columns, columns]
        if not np.isfinite(spread).all():
            return 1.0
        return float(chdtrc(len(off), max(off @ linalg.lstsq(spread, off)[0], 0.0)))

    def likely(self, columns: slice, sigma: float) -> np.ndarray:
        """The change of some of the numbers if each was expected to be off by so much: less where planes leave it open.

        sigma: standard deviation, in the unit of the numbers. Posterior mean of a normal prior.
        """
        variance, axes = np.linalg.eigh(self.covariance[columns, columns])
        return np.asarray(axes @ (sigma**2 / (sigma**2 + variance) * (axes.T @ self.change[columns])))

    def __add__(self, other: "ScanEvidence") -> "ScanEvidence":
        return ScanEvidence(
            information=self.information + other.information,
            gradient=self.gradient + other.gradient,
            own=np.concatenate([self.own, other.own]),
            curvature=np.concatenate([self.curvature, other.curvature]),
            poses=self.poses + other.poses,
        )


def nothing(size: int) -> ScanEvidence:
    """Of so many numbers."""
    return ScanEvidence(
        information=np.zeros((size, size)),
        gradient=np.zeros(size),
        own=np.zeros((0, size)),
        curvature=np.zeros((0, size, size)),
        poses=PoseResponse.nothing(size),
    )


@dataclass(frozen=True)
class View:
    """S scans, M points, at their poses, with the planes they see.

    scans: m, scan frames; world_from_scan: (S, 4, 4), refined; planes, labels: found there
    sensor_position: (3,), m, where the beams begin in the scan frame
    """

    scans: Scans
    world_from_scan: np.ndarray
    planes: Planes
    labels: PlanePoints
    sensor_position: np.ndarray

    @staticmethod
    def of(
        scans: Scans,
        world_from_scan: Poses,
        planes: Planes,
        labels: PlanePoints,
        sensor: Vector | None = None,
    ) -> "View":
        """With the LiDAR at the origin of the scan frame where nothing else is said."""
        return View(scans, world_from_scan, planes, labels, np.zeros(3) if sensor is None else sensor)

    @property
    def thickness(self) -> float:
        """m, standard deviation of points about their plane, median over planes."""
        return float(np.sqrt(np.median(self.planes.eigenvalues[:, 0])))

    def away(self, scale: float) -> float:
        """How far points are from planes: mean of squared distances over `scale` (m), at most `_AWAY` each, and that of
        points on none. Two of the same points are compared by the same scale: thin planes of few points are no gain.
        """
        sum_of_squares, on = 0.0, 0
        for scan in range(len(self.scans)):
            if (seen := self.seen(scan)) is None:
                continue
            sum_of_squares += float(np.minimum((seen.distance / scale) ** 2, _AWAY).sum())
            on += len(seen.number)
        count = len(self.scans.points)
        return (sum_of_squares + _AWAY * (count - on)) / max(count, 1)

    def on_planes(self, scan: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Planes (n,), ascending, and numbers (n,) of a scan's points that lie on them; None: too few."""
        first, last = self.scans.offsets[scan : scan + 2]
        plane = self.labels.plane[first:last]
        order = np.argsort(plane, kind="stable")
        order = order[np.searchsorted(plane[order], 0) :]
        return (plane[order], first + order) if len(order) >= _FEWEST_POINTS else None

    def seen(self, scan: int) -> "Seen | None":
        """A scan's points that lie on planes; None: too few."""
        if (known := self.on_planes(scan)) is None:
            return None
        plane, number = known
        point = self.scans.points[number].astype(float)
        world = geometry.transform_points(self.world_from_scan[scan], point)
        distance = np.einsum("ni,ni->n", self.planes.normal[plane], world - self.planes.center[plane])
        return Seen(plane, number, point, distance)


@dataclass(frozen=True)
class Moved:
    """What moves by a unit of each of k shared numbers, all else as it fits best.

    planes: (P, k) float64, m, along their normals, at their centers; scans: (S, 6, k) float64, local tangent, rad and m
    """

    planes: np.ndarray
    scans: np.ndarray


def evidence(view: View, by_shared: ByShared, size: int) -> ScanEvidence:
    """What the planes tell of so many shared numbers."""
    return evidence_and_moved(view, by_shared, size)[0]


def evidence_and_moved(view: View, by_shared: ByShared, size: int) -> tuple[ScanEvidence, Moved]:
    """The same, and what moves by them."""
    sums = [each for scan in range(len(view.scans)) if (each := _of_scan(view, scan, by_shared)) is not None]
    if not sums:
        planes, scans = len(view.planes.center), len(view.world_from_scan)
        return nothing(size), Moved(np.zeros((planes, size)), np.zeros((scans, 6, size)))
    return _eliminated(sums, view.world_from_scan, neighborhoods(view.planes.center, _HALVINGS), size)


def terms(view: View, scan: int, by_shared: ByShared, met: bool = True) -> tuple[np.ndarray, ...] | None:
    """Plane (n,), derivatives x (n, 6 + k) by pose and shared numbers, y (n, 3) by plane, and normalized distance r (n,).

    Of a scan's points on planes, which ascend; None: too few.
    met: derivatives are those of where beams meet the planes; False: of the points, where these are far off their planes
    """
    seen = view.seen(scan)
    if seen is None:
        return None
    plane, number, point, distance = seen
    planes, pose = view.planes, view.world_from_scan[scan]
    thickness = planes.eigenvalues[:, 0]
    scale = 1.0 / np.sqrt(np.maximum(thickness, np.median(thickness)))[plane]
    center, normal = planes.center[plane], planes.normal[plane] @ pose[:3, :3]
    place = _met(point, distance, normal, view.sensor_position) if met else point
    by_pose = np.concatenate([np.cross(place, normal), normal], axis=1)
    shared = by_shared(OnPlanes(scan, number, place, normal, by_pose))
    away = geometry.transform_points(pose, place) - center
    across = np.einsum("ni,nij->nj", away, planes.axes[plane][:, :, 1:])
    x = np.concatenate([by_pose, shared], axis=1) * scale[:, None]
    y = np.concatenate([np.ones((len(plane), 1)), across], axis=1) * scale[:, None]
    return plane, x, y, distance * scale


def _met(point: np.ndarray, distance: np.ndarray, normal: np.ndarray, sensor: np.ndarray) -> np.ndarray:
    """Where the beams of points (n, 3) meet planes at distances (n,) from them."""
    beam = point - sensor
    beam = beam / np.maximum(np.linalg.norm(beam, axis=1), 1e-9)[:, None]
    cosine = np.einsum("ni,ni->n", beam, normal)
    bounded = np.where(cosine < 0, -1.0, 1.0) * np.maximum(np.abs(cosine), _GRAZING)
    return np.asarray(point - beam * (distance / bounded)[:, None])


class _Sums(NamedTuple):
    """Of a scan's points on e planes, by m = 6 + k numbers. plane: (e,); xx: (e, m, m); xy: (e, m, 3); yy: (e, 3, 3);
    xr: (e, m); yr: (e, 3)"""

    scan: int
    plane: np.ndarray
    xx: np.ndarray
    xy: np.ndarray
    yy: np.ndarray
    xr: np.ndarray
    yr: np.ndarray


def _of_scan(view: View, scan: int, by_shared: ByShared) -> _Sums | None:
    known = terms(view, scan, by_shared)
    if known is None:
        return None
    plane, x, y, r = known
    bounds = np.r_[np.flatnonzero(np.r_[True, np.diff(plane) > 0]), len(plane)].tolist()
    columns = np.concatenate([x, y, r[:, None]], axis=1)
    square = np.stack([columns[a:b].T @ columns[a:b] for a, b in pairwise(bounds)])
    by_x, by_y = slice(0, x.shape[1]), slice(x.shape[1], -1)
    return _Sums(
        scan=scan,
        plane=plane[bounds[:-1]],
        xx=square[:, by_x, by_x],
        xy=square[:, by_x, by_y],
        yy=square[:, by_y, by_y],
        xr=square[:, by_x, -1],
        yr=square[:, by_y, -1],
    )


def _eliminated(
    sums: list[_Sums], world_from_scan: Poses, near: Indices, size: int
) -> tuple[ScanEvidence, Moved]:
    """The sums by the shared numbers alone, and what moves. near: (P,), the neighborhood of each plane"""
    scans, planes = len(world_from_scan), len(near)
    plane = np.concatenate([each.plane for each in sums])
    scan = np.concatenate([np.full(len(each.plane), each.scan) for each in sums])
    xx, xy, xr = (np.concatenate([getattr(each, name) for each in sums]) for name in ("xx", "xy", "xr"))
    square, right = np.tile(_UNCERTAIN * np.eye(3), (planes, 1, 1)), np.zeros((planes, 3))
    for each in sums:
        square[each.plane] += each.yy
        right[each.plane] += each.yr
    inverse = np.linalg.inv(np.linalg.cholesky(square))
    right = np.einsum("pij,pj->pi", inverse, right)
    free = 6 * scans
    row = np.concatenate(
        [6 * scan[:, None] + np.arange(6), np.tile(free + np.arange(size), (len(scan), 1))], axis=1
    )
    white = np.einsum("eij,ekj->eik", xy, inverse[plane])
    coupling = _sparse(white, row, plane, (free + size, 3 * planes))
    normal = np.zeros((free + size, free + size))
    for each in sums:
        own = np.r_[6 * each.scan : 6 * each.scan + 6, free : free + size]
        normal[np.ix_(own, own)] += each.xx.sum(axis=0)
    normal -= (coupling @ coupling.T).toarray()
    normal[:free, :free] += np.diag(np.tile(POSE_SIGMA**-2.0, scans))
    poses = -linalg.solve(normal[:free, :free], normal[:free, free:], assume_a="pos")
    through = np.concatenate([poses, np.eye(size)])
    met = (coupling.T @ through).reshape(planes, 3, size)
    own, curvature = _by_plane(xx, xr, through[row], plane, planes)
    own -= np.einsum("pik,pi->pk", met, right)
    curvature -= np.einsum("pik,pil->pkl", met, met)
    information = np.einsum("in,nj->ij", normal[free:], through)
    moved = poses.reshape(scans, 6, size)
    every = ScanEvidence(
        information=(information + information.T) / 2,
        gradient=-own.sum(axis=0),
        own=_together(own, near),
        curvature=_together(curvature, near),
        poses=PoseResponse.of(moved, world_from_scan),
    )
    return every, Moved(np.einsum("pi,pik->pk", inverse[:, :, 0], met), moved)


def _together(values: np.ndarray, near: Indices) -> np.ndarray:
    """Sums (G, ...) of values (P, ...) over the planes of each neighborhood. near: (P,)"""
    total = np.zeros((int(near.max()) + 1, *values.shape[1:]))
    np.add.at(total, near, values)
    return total


def _by_plane(
    xx: np.ndarray, xr: np.ndarray, through: np.ndarray, plane: np.ndarray, planes: int
) -> tuple[np.ndarray, np.ndarray]:
    """Sums (P, k) and (P, k, k) over the E pairs of scan and plane, by the shared numbers with poses following."""
    size = through.shape[2]
    own, curvature = np.zeros((planes, size)), np.zeros((planes, size, size))
    np.add.at(own, plane, np.einsum("ei,eik->ek", xr, through))
    np.add.at(curvature, plane, through.transpose(0, 2, 1) @ (xx @ through))
    return own, curvature


def _sparse(
    blocks: np.ndarray, row: np.ndarray, plane: np.ndarray, shape: tuple[int, int]
) -> sparse.csr_matrix:
    """Blocks (E, m, 3) at rows (E, m) and the columns of planes (E,)."""
    rows = np.repeat(row, 3, axis=1).ravel()
    columns = np.tile(3 * plane[:, None] + np.arange(3), (1, row.shape[1])).ravel()
    return sparse.csr_matrix((blocks.ravel(), (rows, columns)), shape=shape)
