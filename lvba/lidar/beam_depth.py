"""How deep beams go into surfaces such as leaves, told by how points spread along the beams.

The noise of a range sensor is as large toward it as away from it. Beams that go into a surface come back from behind the
place where they entered, few of them from far behind: the spread has a long side away from the sensor. If depths are
exponential, their third central moment is twice the cube of their mean, and noise, which has none, adds nothing to it.
This tells whether there are such surfaces. Their mean depth is then also the root of what they spread more than others,
in squares, which fewer points tell.

Nothing tells whether such points or the front of the surface are what a camera sees.
"""

from typing import NamedTuple

import numpy as np

from lvba.arrays import Vector
from lvba.lidar.range_errors import OFFSET, Beams, directions
from lvba.lidar.scan_evidence import ByShared, OnPlanes, View

_FEWEST_POINTS = 100
"""Of a plane, for a third moment."""
_FEWEST_OF_KNOWN = 30
"""For a second one, where others show that beams go in."""
_LARGER = 1.2
"""Times the noise of plain surfaces, along the beam, that such surfaces spread at least."""
_LEAST_COSINE = 0.2
"""Of incidence, for a spread along the beam."""
_SKEWNESS = 0.4
"""Of the spread, above which a plane is no plain surface."""
_CHANCE = 4.0
"""And above so many of its standard deviations; half of the planes of depth cameras have a little of either sign."""
_LEAST_PART = 0.1
"""Of the points on planes, below which a window shows no such surfaces: edges and mirrors do as much."""
_SMALL_PART = 0.03
"""The same where it has shown them before its points were corrected (what comes and goes from round to round keeps the
other errors from an end), and where the planes that tell have one side alone: edges, mirrors and steps make both."""
_ONE_SIDED, _FEWEST_PLANES = 5, 20
"""Times as many planes with a long side away from the sensor as with one toward it, and how many at least. In simulations
without leaves, and indoors, it was at most twice as many; in a courtyard with leaves on 7 % of its points 92 to none."""


class Depths(NamedTuple):
    """How deep beams go into the planes of a window.

    mean: (P,) float64, m, of each plane; 0 for plain surfaces; points: (P,) int64, how many its spread is of
    """

    mean: np.ndarray
    points: np.ndarray

    @property
    def squares(self) -> np.ndarray:
        """(2,) float64: sum of the squared depths of points, m^2, and how many points; adds up over windows."""
        return np.array([float(self.points @ self.mean**2), float(self.points.sum())])

    def of_points(self, plane: np.ndarray) -> np.ndarray:
        """(M,) float64, m: of the planes of points, 0 where they are on none. plane: (M,) int32, -1: none"""
        return np.where(plane >= 0, np.append(self.mean, 0.0)[plane], 0.0)


def of_planes(view: View, position: Vector, seen: bool = False) -> Depths:
    """Of the planes that some scans see.

    position: where the beams begin, scan frame, m; seen: such surfaces have been seen in this window
    """
    plane, along = _along(view, position)
    count = len(view.planes)
    points = np.bincount(plane, minlength=count)
    enough = np.maximum(points, 1)
    off = along - (np.bincount(plane, along, count) / enough)[plane]
    second, third = (np.bincount(plane, off**power, count) / enough for power in (2, 3))
    skewness = third / np.maximum(second, 1e-12) ** 1.5
    clear = np.abs(skewness) > np.maximum(_SKEWNESS, _CHANCE * np.sqrt(6.0 / enough))
    clear &= points >= _FEWEST_POINTS
    entered = clear & (skewness > 0)
    one_sided = entered.sum() >= max(_FEWEST_PLANES, _ONE_SIDED * np.sum(clear & ~entered))
    least = _SMALL_PART if seen or one_sided else _LEAST_PART
    if np.sum(points * clear * np.sign(skewness)) <= least * points.sum():
        return Depths(np.zeros(count), points)
    plain = np.median((second - np.cbrt(third / 2.0) ** 2)[entered])
    usual = points >= _FEWEST_POINTS
    if (others := usual & ~entered).any():
        plain = min(plain, np.median(second[others]))
    deeper = (points >= _FEWEST_OF_KNOWN) & (second > _LARGER**2 * plain)
    return Depths(np.where(deeper, np.sqrt(np.maximum(second - plain, 0.0)), 0.0), points)


def _along(view: View, position: Vector) -> tuple[np.ndarray, np.ndarray]:
    """Plane (n,) and distance behind it along the beam (n,), m, of the points that meet one not too grazing."""
    planes, distances = [np.zeros(0, int)], [np.zeros(0)]
    for scan in range(len(view.scans)):
        seen = view.seen(scan)
        if seen is None:
            continue
        normal = view.planes.normal[seen.plane] @ view.world_from_scan[scan][:3, :3]
        beam, _ = directions(seen.point, position)
        cosine = np.einsum("ni,ni->n", normal, beam)
        met = np.abs(cosine) > _LEAST_COSINE
        planes.append(seen.plane[met])
        distances.append(seen.distance[met] / cosine[met])
    return np.concatenate(planes), np.concatenate(distances)


def by_depth(beams: Beams, depth: np.ndarray) -> ByShared:
    """Derivative of points' distances from their planes by how many times as deep as they seem beams go, (n, 1).

    depth: (M,) float64, m, of the planes of the points of all scans
    """

    def derivative(points: OnPlanes) -> np.ndarray:
        nearer = beams.shift(OFFSET, points.place, np.ones(len(points.place)))
        along = np.einsum("ni,ni->n", points.normal, nearer)
        return np.asarray((along * depth[points.chosen])[:, None])

    return derivative
