"""Whether two patches of surfels, laid upon each other, can be the same place: what agrees, and what contradicts."""

from dataclasses import dataclass

import numpy as np

from lvba import geometry
from lvba.kernels import see_through as kernel
from lvba.lidar import surfel_alignment
from lvba.lidar.submap import Patch
from lvba.lidar.surfel_alignment import Target

_MARGIN_CELLS = 2.0
"""A surface contradicts a ray when it is this far (cells) in front of the ray's end, or more."""
_RADIUS_CELLS = 0.4
_COSINE = 0.35
_MOST_RAYS = 4000
_ANGLE_DEG = 20.0


@dataclass(frozen=True)
class Evidence:
    """What surfels of b say about an alignment, and those of a.

    agrees_a, agrees_b: (K,) bool, lies on a surface of the other, seen from the same side
    against_a, against_b: (K,) bool, lies behind a surface of the other, which it was seen through
    share: part of the surfels that say anything which agree
    """

    agrees_a: np.ndarray
    agrees_b: np.ndarray
    against_a: np.ndarray
    against_b: np.ndarray

    @property
    def share(self) -> float:
        """0 to 1; 0 where nothing is said."""
        agree = np.count_nonzero(self.agrees_a) + np.count_nonzero(self.agrees_b)
        against = np.count_nonzero(self.against_a) + np.count_nonzero(self.against_b)
        return agree / (agree + against) if agree else 0.0


def evidence(a: Target, b: Target, a_from_b: np.ndarray, tolerance: float) -> Evidence:
    """What speaks for and against an alignment.

    tolerance: m, furthest that a surfel may be from a surface that it lies on
    """
    agrees_b = agreeing(a, b.patch, a_from_b, tolerance)
    agrees_a = agreeing(b, a.patch, geometry.inverse(a_from_b), tolerance)
    against_b = _hidden(a.patch, b.patch.moved(a_from_b)) & ~agrees_b
    against_a = _hidden(b.patch, a.patch.moved(geometry.inverse(a_from_b))) & ~agrees_a
    return Evidence(agrees_a, agrees_b, against_a, against_b)


def agreeing(target: Target, source: Patch, a_from_b: np.ndarray, tolerance: float) -> np.ndarray:
    """Which surfels of the source lie on surfaces of the target, (K,) bool."""
    reach = max(1.25 * target.patch.cell, tolerance)
    found = surfel_alignment.match(target, source, a_from_b, reach, _ANGLE_DEG)
    agrees = np.zeros(len(source), bool)
    agrees[found.source[np.abs(found.distance) < tolerance]] = True
    return agrees


def _hidden(surface: Patch, seen: Patch) -> np.ndarray:
    """Which of the surfels `seen` (in the frame of `surface`) have a surface between them and their sensor, (K,) bool."""
    cell = surface.cell
    low = surface.center.min(0)
    at = np.floor((surface.center - low) / cell).astype(np.int64)
    shape = at.max(0) + 1
    flat = (at[:, 0] * shape[1] + at[:, 1]) * shape[2] + at[:, 2]
    order = np.argsort(flat, kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.bincount(flat, minlength=int(np.prod(shape))))])
    step = -(-len(seen) // _MOST_RAYS)
    hit = kernel.first_hit(
        np.ascontiguousarray(seen.seen_from[::step]),
        np.ascontiguousarray(seen.center[::step]),
        _MARGIN_CELLS * cell,
        surface.center[order],
        surface.normal[order],
        starts,
        low,
        shape,
        cell,
        _RADIUS_CELLS * cell,
        _COSINE,
    )
    hidden = np.zeros(len(seen), bool)
    hidden[::step] = hit >= 0
    return hidden
