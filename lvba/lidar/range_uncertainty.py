"""How far points stay off their surfaces by what the errors of the range sensor may still be, corrected or not.

What is measured of them is as good as the planes tell. An error of a centimeter that no plane shows clearly stays in the
points and in all that is tied to them: in a courtyard before a narrow LiDAR, cameras were 3.8 mm off by one, and 1.4 mm
were expected without it.
"""

import math
from dataclasses import dataclass

import numpy as np

from lvba.lidar.range_errors import (
    BRIGHTNESS,
    DISTORTION,
    ELEVATION,
    INCIDENCE,
    OFFSET,
    Beams,
    by_errors,
    directions,
)
from lvba.lidar.scan_evidence import ByShared, OnPlanes, View

USUAL = {
    INCIDENCE: 0.01, ELEVATION: math.radians(0.2), DISTORTION: 0.02, OFFSET: 0.01, BRIGHTNESS: 0.01
}  # fmt: skip
"""What errors of sensors usually are, one standard deviation: planes that tell nothing of one say no more of it."""
_USUAL_ELEVATION_AHEAD = math.radians(0.1)
"""Of a sensor that looks ahead: data sheets of LiDARs with prisms say as much. One that turns may be off by 0.2."""
_NOT_KNOWN = 1e6
"""Times the usual variance that stands for an infinite one."""
GRAZING = 0.5
"""How much brighter or darker surfaces that are met at grazing angles may be than their intensities say, all together,
one standard deviation, times the usual brightness: rough ones return more than matt ones do."""
_GRAZING_COSINE = 0.2
"""Of incidence, below which that holds."""
_THINNED = 8
"""Every so many points on planes are enough for a mean square."""


@dataclass(frozen=True)
class Response:
    """How points on planes move by k errors; adds up over scans.

    squares: (2, k, k) float64, sums over points of products of how far they move along the plane's normal by a unit of
        each: as parts of the range, and in m
    points: how many
    """

    squares: np.ndarray
    points: int

    def __add__(self, other: "Response") -> "Response":
        return Response(self.squares + other.squares, self.points + other.points)

    def off(self, moment: np.ndarray) -> tuple[float, float]:
        """How far points are off, root mean square: as a part of the range, and in m.

        moment: (k, k) float64, second moments of the errors
        """
        part, off = np.sqrt(np.einsum("pij,ij->p", self.squares, moment) / max(self.points, 1))
        return float(part), float(off)


def none(size: int) -> Response:
    """Of no point, by so many errors."""
    return Response(np.zeros((2, size, size)), 0)


def response(view: View, beams: Beams, brighter: np.ndarray | None) -> Response:
    """Of the points that some scans have on their planes. brighter: (M,) float64, as of `range_errors.by_errors`"""
    total, derivative = none(len(beams.names)), by_errors(beams, brighter)
    for scan, pose in enumerate(view.world_from_scan):
        known = view.on_planes(scan)
        if known is None:
            continue
        plane, chosen = (each[::_THINNED] for each in known)
        place = view.scans.points[chosen].astype(float)
        normal = view.planes.normal[plane] @ pose[:3, :3]
        moved = derivative(OnPlanes(scan, chosen, place, normal, np.zeros((len(chosen), 0))))
        parts = moved / directions(place, beams.position)[1][:, None]
        total += Response(np.stack([parts.T @ parts, moved.T @ moved]), len(chosen))
    return total


def by_grazing(beams: Beams) -> ByShared:
    """Derivative of points' distances from their planes by ranges that are too long on surfaces met at grazing angles,
    (n, 1)."""

    def derivative(points: OnPlanes) -> np.ndarray:
        ray, _ = directions(points.place, beams.position)
        along = np.einsum("ni,ni->n", points.normal, ray)
        return np.asarray(np.where(np.abs(along) < _GRAZING_COSINE, -along, 0.0)[:, None])

    return derivative


def usual(beams: Beams) -> np.ndarray:
    """(k,) float64: what the errors `beams.names` usually are, one standard deviation, in m, rad or as a part."""
    known = USUAL | ({ELEVATION: _USUAL_ELEVATION_AHEAD} if beams.narrow else {})
    return np.array([known[name] for name in beams.names])


def moment(
    usual: np.ndarray, estimate: np.ndarray, covariance: np.ndarray, corrected: np.ndarray
) -> np.ndarray:
    """(k, k) float64: second moments of what is left of errors.

    usual: (k,) float64, what each usually is, one standard deviation
    estimate, covariance: (k,) and (k, k) float64, as the planes have them together
    corrected: (k,) float64, what is taken out of the points
    Posterior of a normal prior, `usual` about zero: its variance, and what its mean is off the correction beyond that.
    """
    prior = np.diag(np.square(usual))
    known = np.where(np.isfinite(covariance), covariance, _NOT_KNOWN * prior)
    gain = np.linalg.solve(prior + known, prior).T
    left, spread = gain @ estimate - corrected, gain @ known
    # chance alone makes that mean as large as its deviations say, and these count already
    chance = len(left) / max(float(left @ np.linalg.solve(spread, left)), 1e-12)
    return np.asarray(spread + max(1.0 - chance, 0.0) * np.outer(left, left))
