"""Systematic errors of the range sensor that all points share: where points belong, and what planes tell of them.

incidence: m, a surface is measured this much farther at grazing incidence than seen straight on
offset: m, ranges are too long by this much
brightness: m, a surface twice as bright as usual is measured this much farther than a usual one, and others in proportion
elevation: rad, beams go this much higher about the axis of a sensor that turns, or the upright one of a sensor that looks
    ahead, than it says
distortion: ranges of a sensor that looks ahead are too long by this part 45 degrees off its axis, and in proportion to
    the squared tangent of the angle elsewhere, as those of depth cameras

How deep beams go into surfaces such as leaves is looked for beside them, too, and never corrected (see `beam_depth`).
Whatever else depends on the direction of a beam is looked for beside them as a part of the range, by spherical harmonics:
it is not corrected, but an error that it explains as well is none of the above.

A common scale of ranges is none of them: planes cannot tell it from that of the poses. Where most points are on the
ground, they cannot tell an offset from incidence either, but then each takes the other's errors out of the points as
well. What returns less is also met at a more grazing angle: brightness is the intensity over the cosine of incidence,
which a matt surface keeps from any angle.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.special import chdtrc

from lvba.arrays import Vectors
from lvba.lidar import incidence
from lvba.lidar.scan_evidence import ByShared, OnPlanes, View

INCIDENCE, ELEVATION, DISTORTION = "incidence", "elevation", "distortion"
OFFSET, BRIGHTNESS = "offset", "brightness"
DIRECTION = "direction"
"""Of what depends on the direction in another way: m, how far points are off by it, root mean square."""
DEPTH = "depth"
"""Of how far beams go into surfaces such as leaves (see `beam_depth`): m, root mean square over all points."""
HARMONICS = 8
"""Of first and second degree; that of degree zero is the scale, which planes do not tell."""
HARMONIC_SIGMA = 0.01
"""What they are expected to be, as parts of the range: where beams are nearly alike, planes tell only some of them, and
the others could have any size."""
LARGEST = {
    INCIDENCE: 0.05, ELEVATION: math.radians(1.0), DISTORTION: 0.1, OFFSET: 0.05, BRIGHTNESS: 0.05
}  # fmt: skip
"""What is more is not believed of a sensor: the planes are of a kind that tells something else, such as leaves."""
CHANCE = 2e-9
"""How often a right sensor may be taken for a wrong one: six standard deviations, for errors can be twice the predicted
ones."""
BESIDE = 2.0
"""Standard deviations are so many times as large beside another error that is not known: what is not modeled is not in
them."""
LEAST_M = 1e-3
"""And an error must move points by so much, root mean square: less is lost in the noise of usual sensors."""
_FALLS = 0.3
"""An error that is one falls to less than this part of itself once it is corrected."""
_USUAL_COSINE = 2.0 / 3.0
"""Of incidence, where surfaces are not known yet."""
_LEAST_COSINE = 0.1
"""Of incidence, that intensities are divided by: what returns from surfaces met more grazing says little of them. With
0.2, a road far ahead seemed darker than it is, and beams .0035 degrees higher: a street of 240 m was bent by 15 mm."""
_BRIGHTEST = 3.0
"""Times the usual brightness that a surface counts as at most: reflectors return a hundred times as much."""
_VARIED = 0.05
"""Standard deviation of the brightness, relative to the usual one, below which it says nothing."""
_NARROW = 0.6
"""Mean of the directions of points, as unit vectors, above which a sensor looks ahead."""
_NEAR_AXIS = math.cos(math.radians(15.0))
_FLAT = 0.5
"""A sensor turns about the axis along which directions spread by less than this part of the next one, in squares."""


@dataclass(frozen=True)
class Beams:
    """How a sensor sends its beams, in the scan frame.

    position: (3,) m, where they begin; axis: (3,), unit: the one it turns about, or looks along (`narrow`); None: neither
    is clear
    up: (3,), unit, of a sensor that looks ahead: the axis that its elevations are about; None: it does not, or it is not
    known
    usual: brightness of the usual surface, in the unit of the intensities; None: there are none
    plain: False: errors that do not depend on the beam's direction or its incidence are not looked for
    """

    position: np.ndarray
    axis: np.ndarray | None
    narrow: bool
    usual: float | None = None
    plain: bool = True
    up: np.ndarray | None = None

    @staticmethod
    def of(points: Iterable[np.ndarray], position: np.ndarray, axes: np.ndarray) -> "Beams":
        """By the points (N, 3) of some scans.

        position: (3,) float64, m; axes: (3, 3) float64, columns: the sensor's own, in the scan frame
        """
        seen = [directions(each, position)[0] for each in points if len(each)]
        if not seen:
            return Beams(position=position, axis=None, narrow=False)
        local = np.concatenate(seen) @ axes
        mean, square = local.mean(axis=0), np.sort(np.mean(local**2, axis=0))
        length = float(np.linalg.norm(mean))
        if length > _NARROW:
            ahead = mean / length
            nearest = int(np.argmax(np.abs(ahead)))
            if abs(ahead[nearest]) > _NEAR_AXIS:
                ahead = np.sign(ahead[nearest]) * np.eye(3)[nearest]
            return Beams(position=position, axis=axes @ ahead, narrow=True, up=axes @ _upright(ahead))
        if square[0] > _FLAT * square[1]:
            return Beams(position=position, axis=None, narrow=False)
        axis = axes[:, int(np.argmin(np.mean(local**2, axis=0)))].copy()
        return Beams(position=position, axis=axis, narrow=False)

    @property
    def names(self) -> tuple[str, ...]:
        """The errors that such a sensor may have."""
        ahead = (DISTORTION,) if self.narrow and self.axis is not None else ()
        about = () if self.upright is None else (ELEVATION,)
        plain = (OFFSET,) if self.usual is None else (OFFSET, BRIGHTNESS)
        return (INCIDENCE, *ahead, *about, *(plain if self.plain else ()))

    @property
    def upright(self) -> np.ndarray | None:
        """(3,) float64, unit, scan frame: the axis that elevations are about; None: not known."""
        return self.up if self.narrow else self.axis

    def shift(
        self, name: str, points: Vectors, cosine: np.ndarray, brighter: np.ndarray | None = None
    ) -> np.ndarray:
        """(N, 3) m: by how much points (N, 3) m, scan frame, go where they belong for one unit of an error.

        cosine: (N,) float64, of the angle of incidence
        brighter: (N,) float64, as `Beams.brighter`; None: not known, nothing moves by it
        """
        ray, length = directions(points, self.position)
        if name == INCIDENCE:
            return np.asarray(-ray * (1 - cosine)[:, None])
        if name == OFFSET:
            return -ray
        if name == BRIGHTNESS:
            return np.zeros(ray.shape) if brighter is None else np.asarray(-ray * brighter[:, None])
        if name == DISTORTION:
            assert self.axis is not None
            ahead = np.maximum(ray @ self.axis, math.sqrt(0.5))
            return np.asarray(-ray * (length * (1 / ahead**2 - 1))[:, None])
        assert self.upright is not None
        along = ray @ self.upright
        across = np.maximum(np.sqrt(np.maximum(1 - along**2, 0.0)), 1e-3)
        return np.asarray((self.upright - along[:, None] * ray) * (length / across)[:, None])

    def brighter(self, cosine: np.ndarray, intensity: np.ndarray | None) -> np.ndarray:
        """(N,) float64: by how many times the usual brightness surfaces are brighter than that; 0 where not known.

        cosine: (N,) float64, of the angle of incidence; intensity: (N,) float32
        """
        if intensity is None:
            return np.zeros(len(cosine))
        return self.relative(brightness(intensity, cosine))

    def relative(self, seen: np.ndarray) -> np.ndarray:
        """As `brighter`. seen: (N,) float64, brightnesses, NaN where not known"""
        if self.usual is None:
            return np.zeros(len(seen))
        relative = seen / self.usual
        return np.where(np.isfinite(relative), np.clip(relative, 0.0, _BRIGHTEST) - 1.0, 0.0)


def _upright(ahead: np.ndarray) -> np.ndarray:
    """(3,): the upright axis of a sensor that looks ahead (3,), both among its own: z, or, where it looks along z as
    cameras do, -y."""
    return np.array([0.0, -1.0, 0.0]) if abs(ahead[2]) > math.sqrt(0.5) else np.array([0.0, 0.0, 1.0])


def brightness(intensity: np.ndarray, cosine: np.ndarray) -> np.ndarray:
    """(N,) float64: of the surfaces of points, in the unit of the intensities.

    intensity: (N,) float32; cosine: (N,) float64, of the angle of incidence
    """
    return np.asarray(np.asarray(intensity, float) / np.maximum(cosine, _LEAST_COSINE))


def usual_brightness(intensity: np.ndarray | None, cosine: np.ndarray) -> float | None:
    """The median over points; None where it tells nothing.

    intensity: (N,) float32; cosine: (N,) float64, of the angle of incidence
    """
    if intensity is None:
        return None
    seen = brightness(intensity, cosine)
    seen = seen[np.isfinite(seen) & (seen > 0)]
    usual = float(np.median(seen)) if len(seen) else 0.0
    if not usual > 0 or np.std(np.minimum(seen / usual, _BRIGHTEST)) < _VARIED:
        return None
    return usual


def directions(points: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) float64, unit vectors of the beams that meet points, and (N,) float64, m, how far away these are.

    points: (N, 3) float32 or float64, m; position: (3,) float64, m, where the beams begin
    """
    away = np.asarray(points, float) - position
    length = np.linalg.norm(away, axis=1)
    return away / np.maximum(length, 1e-9)[:, None], length


@dataclass(frozen=True)
class RangeErrors:
    """Systematic errors of the range sensor of a recording, and how its scans are corrected.

    values: of those that were measured, in m, rad or as a part; sigma: their standard deviations
    corrected: the names of those that are taken out of the points
    noticed: of those that are no chance, but stay
    problem: why what is significant was not corrected
    planes_off: (6, 6) float64, second moments of how far a camera that planes hold is off its place on the sensor, with
        all of them, by what else depends on the beam's direction or goes into surfaces, or by what these errors may still
        be: `[rotation | translation]`, rad and m, along the axes of the scan
    poses_off: rad and m, root mean square, that poses are off because of that
    """

    beams: Beams
    values: Mapping[str, float] = field(default_factory=dict)
    sigma: Mapping[str, float] = field(default_factory=dict)
    corrected: tuple[str, ...] = ()
    problem: str = ""
    noticed: tuple[str, ...] = ()
    planes_off: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))
    poses_off: tuple[float, float] = (0.0, 0.0)

    @property
    def beside(self) -> float:
        """Times as large as planes say that standard deviations of what is measured after these errors are."""
        return BESIDE if self.noticed else 1.0

    def points(
        self, points: np.ndarray, cosine: np.ndarray | None = None, intensity: np.ndarray | None = None
    ) -> np.ndarray:
        """(N, 3) float32, m: where the points of a scan belong.

        points: (N, 3) float32, m, scan frame; intensity: (N,) float32, None: it has none
        cosine: (N,) float64, of the angles of incidence; None: by the surface about each point
        """
        if not self.corrected or not len(points):
            return points
        cosine = self.cosines(points) if cosine is None else cosine
        straight = np.ones(len(points)) if cosine is None else cosine
        brighter = self.beams.brighter(straight, intensity) if BRIGHTNESS in self.corrected else None
        shifts = [
            self.values[name] * self.beams.shift(name, points, straight, brighter) for name in self.corrected
        ]
        return np.asarray(sum(shifts, np.asarray(points, float)), np.float32)

    def cosines(self, points: np.ndarray) -> np.ndarray | None:
        """(N,) float64, of the angles of incidence of the points of a scan, by what is about each; None: no need.

        points: (N, 3) float32, m, scan frame
        """
        if not len(points) or {INCIDENCE, BRIGHTNESS}.isdisjoint(self.corrected):
            return None
        return incidence.cosines(points, self.beams.position)

    def met_at(self, points: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """(N, 3) float32, m: where points of a scan belong that meet their surfaces at other angles than was taken.

        points: (N, 3) float32, m, corrected; before, after: (N,) float64, cosines of incidence, as taken and as they are
        """
        if INCIDENCE not in self.corrected:
            return points
        moved = self.beams.shift(INCIDENCE, points, after) - self.beams.shift(INCIDENCE, points, before)
        return np.asarray(points + self.values[INCIDENCE] * moved, np.float32)

    def facts(self) -> dict[str, Any]:
        """As report.json has it (`lidar.range_errors`)."""
        return {
            "values": dict(self.values),
            "sigma": dict(self.sigma),
            "corrected": list(self.corrected),
            "noticed": list(self.noticed),
            "axis": self.beams.axis,
            "up": self.beams.up,
            "narrow": self.beams.narrow,
            "sensor_position": self.beams.position,
            "usual_brightness": self.beams.usual,
            "problem": self.problem,
        }

    @staticmethod
    def of_facts(facts: Mapping[str, Any] | None) -> "RangeErrors | None":
        """As report.json has it; None where points stay as they are, or it is not as written."""
        if not facts or not facts.get("corrected"):
            return None
        try:
            axis, up = _vector(facts["axis"]), _vector(facts.get("up"))  # results of 0.2 do not have `up`
            usual = facts.get("usual_brightness")
            beams = Beams(
                position=np.array(facts["sensor_position"], float).reshape(3),
                axis=axis,
                narrow=bool(facts["narrow"]),
                usual=None if usual is None else float(usual),
                up=up,
            )
            names = tuple(facts["corrected"])
            values = {name: float(facts["values"][name]) for name in names if name in beams.names}
            return RangeErrors(
                beams=beams, values=values, sigma=dict(facts["sigma"]), corrected=tuple(values)
            )
        except (KeyError, TypeError, ValueError):
            return None


def _vector(value: Any) -> np.ndarray | None:
    return None if value is None else np.array(value, float).reshape(3)


def sentence(name: str, value: float) -> str:
    """What an error means, for people."""
    if name == ELEVATION:
        way = "higher" if value > 0 else "lower"
        return f"Beams go {abs(math.degrees(value)):.2f} degrees {way} than the sensor says"
    farther = "farther" if value > 0 else "nearer"
    if name == INCIDENCE:
        return f"Surfaces are measured {abs(1e3 * value):.0f} mm {farther} at grazing incidence"
    if name == OFFSET:
        return f"All surfaces are measured {abs(1e3 * value):.0f} mm {'too far' if value > 0 else 'too near'}"
    if name == BRIGHTNESS:
        return f"Surfaces twice as bright as usual are measured {abs(1e3 * value):.0f} mm {farther}"
    if name == DIRECTION:
        size = f"{1e3 * value:.0f} mm and more"
        return (
            f"Ranges are off by {size} in a way that depends on the beam's direction, as no known error does"
        )
    if name == DEPTH:
        return f"The LiDAR measures {1e3 * value:.0f} mm (rms) behind some surfaces, such as leaves"
    return f"Surfaces 45 degrees off the sensor's axis are measured {abs(100 * value):.2f} % {farther} than ahead"


def by_errors(beams: Beams, brighter: np.ndarray | None = None) -> ByShared:
    """Derivative of points' distances from their planes by the errors `beams.names`.

    brighter: (M,) float64, of the planes of the points of all scans, as `Beams.brighter`
    """

    def derivative(points: OnPlanes) -> np.ndarray:
        ray, _ = directions(points.place, beams.position)
        cosine = np.abs(np.einsum("ni,ni->n", ray, points.normal))
        own = None if brighter is None else brighter[points.chosen]
        shifts = [beams.shift(name, points.place, cosine, own) for name in beams.names]
        return np.stack([np.einsum("ni,ni->n", points.normal, each) for each in shifts], axis=1)

    return derivative


def harmonics(beams: Beams, points: Vectors) -> np.ndarray:
    """(N, 8): spherical harmonics of first and second degree of the directions of points (N, 3) m, scan frame."""
    x, y, z = directions(points, beams.position)[0].T
    return np.stack([x, y, z, x * y, y * z, z * x, x * x - y * y, (3 * z * z - 1) / 2], axis=1)


def by_directions(beams: Beams) -> ByShared:
    """Derivative of points' distances from their planes by parts of the range that go with the harmonics."""

    def derivative(points: OnPlanes) -> np.ndarray:
        ray, length = directions(points.place, beams.position)
        along = -length * np.einsum("ni,ni->n", points.normal, ray)
        return np.asarray(along[:, None] * harmonics(beams, points.place))

    return derivative


def typical_shifts(beams: Beams, points: np.ndarray, intensity: np.ndarray | None = None) -> np.ndarray:
    """(k,) m: by how much the errors `beams.names` move points, root mean square along or across the beam, a unit each.

    points: (N, 3) float32, m, scan frames; intensity: (N,) float32
    """
    spread = _USUAL_COSINE * np.ones(len(points))
    brighter = beams.brighter(spread, intensity)
    shifts = [beams.shift(name, points, spread, brighter) for name in beams.names]
    return np.array([math.sqrt(float(np.mean(np.sum(each**2, axis=1)))) for each in shifts])


def significant(
    estimate: np.ndarray, covariance: np.ndarray, least: np.ndarray, most: np.ndarray, chance: float = CHANCE
) -> tuple[np.ndarray, np.ndarray]:
    """Which of k numbers cannot be chance, (k,) bool, and the estimates (k,) of these with the others at zero.

    estimate, least, most: (k,) float64, of all numbers together; sizes that count, and that are believed
    covariance: (k, k) float64, of the estimate
    Backward elimination by Wald tests: what is not believed first, then the least significant.
    """
    off, spread, kept = estimate.copy(), covariance.copy(), np.ones(len(estimate), bool)
    while kept.any():
        square = np.where(kept, off**2 / np.diagonal(spread), np.inf)
        beyond = np.where(kept, np.abs(off) / most, 0.0)
        small = np.where(kept, np.abs(off) / least, np.inf)
        if beyond.max() > 1:
            out = int(np.argmax(beyond))
        elif chdtrc(1, square.min()) > chance:
            out = int(np.argmin(square))
        elif small.min() < 1:
            out = int(np.argmin(small))
        else:
            break
        gain = spread[:, out] / spread[out, out]
        off, spread = off - gain * off[out], spread - np.outer(gain, spread[out])
        kept[out], off[out] = False, 0.0
        spread[out, :] = spread[:, out] = 0.0
        spread[out, out] = 1.0
    return kept, np.where(kept, off, 0.0)


def falls(rounds: np.ndarray) -> np.ndarray:
    """(k,) bool: which errors hardly change in the last round any more, beside what they first seemed to be.

    rounds: (n, k) float64, as each round has them, zeros before the first one. Some only show once others are corrected.
    """
    first = rounds[(rounds != 0).argmax(axis=0), np.arange(rounds.shape[1])]
    return np.asarray(np.abs(rounds[-1] - rounds[-2]) <= _FALLS * np.abs(first))


def cosines_on_planes(view: View, beams: Beams) -> np.ndarray:
    """(M,) cosines of incidence of the points of some scans on their planes; the mean of these where they are on none."""
    cosine = np.full(len(view.scans.points), np.nan)
    for scan in range(len(view.scans)):
        known = view.on_planes(scan)
        if known is None:
            continue
        normal = view.planes.normal[known[0]] @ view.world_from_scan[scan][:3, :3]
        ray, _ = directions(view.scans.points[known[1]], beams.position)
        cosine[known[1]] = np.abs(np.einsum("ni,ni->n", normal, ray))
    seen = np.isfinite(cosine)
    return np.where(seen, cosine, cosine[seen].mean() if seen.any() else 1.0)


def brighter_on_planes(view: View, beams: Beams, intensity: np.ndarray, cosine: np.ndarray) -> np.ndarray:
    """(M,) float64, as `Beams.brighter`: of the plane that each point is on, by the median over all that are; 0 on none.

    A point of another surface near an edge is off the plane, and would have a brightness of its own: the two would seem
    to belong together, and clean rooms to have an error of a centimeter.
    intensity: (M,) float32, of the points of all scans; cosine: (M,) float64, on their planes
    """
    plane = view.labels.plane
    seen = brightness(intensity, cosine)
    order = np.lexsort((seen, plane))
    order = order[(plane[order] >= 0) & np.isfinite(seen[order])]
    number, first, count = np.unique(plane[order], return_index=True, return_counts=True)
    of_plane = np.full(len(view.planes), np.nan)
    of_plane[number] = seen[order[first + count // 2]]
    return beams.relative(np.where(plane >= 0, of_plane[plane], np.nan))
