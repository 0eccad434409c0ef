"""How far points stay off their surfaces by what the errors of the range sensor may still be, corrected or not.

What is measured of them is as good as the planes tell. An error of a centimeter that no plane shows clearly stays in the
points and in all that is tied to them: in a courtyard before a narrow LiDAR, cameras were 3.8 mm off by one, and 1.4 mm
were expected without it.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lvba import geometry
from lvba.arrays import Pose
from lvba.lidar.range_errors import (
    BRIGHTNESS,
    DISTORTION,
    ELEVATION,
    INCIDENCE,
    OFFSET,
    Beams,
    directions,
)
from lvba.lidar.scan_evidence import ByShared, Moved, OnPlanes, View

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
"""Every so many points on planes are enough for a mean."""
_NEAREST_M = 0.3
"""Points nearer to a camera do not count for more."""
_OPEN = 1e-3
"""Part of the mean information by axis that holds a camera where no plane does."""


class Sight(NamedTuple):
    """Which way a camera looks that sits on the sensor.

    position: (3,) m, ahead: (3,), unit vector, scan frame; cosine: of the angle off it that the image's corners are
    """

    position: np.ndarray
    ahead: np.ndarray
    cosine: float

    def sees(self, away: np.ndarray) -> np.ndarray:
        """(N,) bool. away: (N, 3) float64, m, of points from the camera, scan axes"""
        return np.asarray(away @ self.ahead >= self.cosine * np.linalg.norm(away, axis=1))


def sight(camera_from_scan: Pose, half_angle: float) -> Sight:
    """Of a camera whose image's corners are so far off its axis. camera_from_scan: (4, 4) float64, m; half_angle: rad"""
    position = geometry.inverse(camera_from_scan)[:3, 3]
    return Sight(position, camera_from_scan[2, :3], math.cos(min(half_angle, math.pi / 2)))


EVERYWHERE = Sight(np.zeros(3), np.array([0.0, 0.0, 1.0]), -1.0)


@dataclass(frozen=True)
class Response:
    """How a camera that planes hold leaves its place on the sensor by k errors; adds up over scans.

    Planes move by these errors, and scans do. The camera moves with the planes that it sees, as their distances tell by
    angle, and does not turn: that, images know without planes.
    information: (3, 3) float64, of the camera's place, scan axes; pull: (3, k) float64, of planes that move by a unit of
        each error; scans: (6, k) float64, sum over so many scans of how their sensor turns and moves where the camera is
    """

    information: np.ndarray
    pull: np.ndarray
    scans: np.ndarray
    count: int

    def __add__(self, other: "Response") -> "Response":
        return Response(
            self.information + other.information,
            self.pull + other.pull,
            self.scans + other.scans,
            self.count + other.count,
        )

    def off(self, moment: np.ndarray) -> np.ndarray:
        """(6, 6) float64: as `RangeErrors.planes_off`.

        moment: (k, k) float64, second moments of the errors
        """
        held = _OPEN * max(float(np.trace(self.information)) / 3, 1e-12) * np.eye(3)
        moved = -self.scans / max(self.count, 1)
        moved[3:] += np.linalg.solve(self.information + held, self.pull)
        return np.asarray(moved @ moment @ moved.T)


def none(size: int) -> Response:
    """Of no scan, by so many errors."""
    return Response(np.zeros((3, 3)), np.zeros((3, size)), np.zeros((6, size)), 0)


def response(view: View, moved: Moved, camera: Sight) -> Response:
    """Of the points that some scans have on their planes and a camera sees. moved: what moves by a unit of each error"""
    total = none(moved.planes.shape[1])
    for scan, pose in enumerate(view.world_from_scan):
        known = view.on_planes(scan)
        if known is None:
            continue
        plane, chosen = (each[::_THINNED] for each in known)
        away = view.scans.points[chosen].astype(float) - camera.position
        seen = camera.sees(away)
        plane, away = plane[seen], away[seen]
        normal = view.planes.normal[plane] @ pose[:3, :3]
        weighted = normal.T / np.maximum(np.einsum("ni,ni->n", away, away), _NEAREST_M**2)
        turn, shift = moved.scans[scan, :3], moved.scans[scan, 3:]
        there = np.concatenate([turn, shift + np.cross(turn, camera.position, axis=0)])
        total += Response(weighted @ normal, weighted @ moved.planes[plane], there, 1)
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
