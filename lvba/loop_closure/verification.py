"""Whether two patches of surfels, laid upon each other, can be the same place: what agrees, and what contradicts."""

from dataclasses import dataclass

import numpy as np

from lvba import geometry
from lvba.arrays import Pose, Vectors
from lvba.kernels import see_through as kernel
from lvba.loop_closure import correlation, surfel_icp
from lvba.loop_closure.submap import Patch
from lvba.loop_closure.surfel_icp import Target

_MARGIN_CELLS = 2.0
"""A surface contradicts a ray when it is this far (cells) in front of the ray's end, or more."""
_RADIUS_CELLS = 0.4
_COSINE = 0.35
_MOST_RAYS = 4000
_ANGLE_DEG = 20.0


@dataclass(frozen=True)
class OverlapEvidence:
    """What surfels of two patches say about an alignment, each as loud as its direction is rare.

    Ground and long facades fit in many places; what faces another way tells more (`rarity`).
    for_a, for_b: (K,) float64, of surfels that lie on a surface of the other, seen from the same side; else 0
    against_a, against_b: (K,) float64, of those behind a surface of the other, which they were seen through; else 0
    """

    for_a: np.ndarray
    for_b: np.ndarray
    against_a: np.ndarray
    against_b: np.ndarray

    @property
    def agreeing(self) -> float:
        """Part of what is said that agrees, 0 to 1; 0 where nothing is said."""
        agree, against = self._sums
        return float(agree / (agree + against)) if agree else 0.0

    @property
    def contradicting(self) -> float:
        """Part of what is said that contradicts, 0 to 1; 0 where nothing is said."""
        agree, against = self._sums
        return float(against / (agree + against)) if against else 0.0

    @property
    def _sums(self) -> tuple[float, float]:
        """Of what agrees, and of what contradicts."""
        return self.for_a.sum() + self.for_b.sum(), self.against_a.sum() + self.against_b.sum()

    @property
    def surfels(self) -> int:
        """How many agree, of the patch where these are fewer."""
        return int(min(np.count_nonzero(self.for_a), np.count_nonzero(self.for_b)))

    @property
    def overlap(self) -> float:
        """Part of the surfels that agree, of the patch where it is smaller."""
        return float(min(np.mean(self.for_a > 0), np.mean(self.for_b > 0)))


def rarity(normal: Vectors, others: Vectors) -> tuple[np.ndarray, np.ndarray]:
    """How much surfels count by their normals (K, 3) and (L, 3), in one frame: (K,) and (L,), 3 on average."""
    whitening = correlation.whitening(np.concatenate([normal, others]))
    return np.sum((normal @ whitening) ** 2, axis=1), np.sum((others @ whitening) ** 2, axis=1)


def evidence(a: Target, b: Target, a_from_b: Pose, tolerance: float) -> OverlapEvidence:
    """What speaks for and against an alignment.

    tolerance: m, furthest that a surfel may be from a surface that it lies on
    """
    agrees_b = agreeing(a, b.patch, a_from_b, tolerance)
    agrees_a = agreeing(b, a.patch, geometry.inverse(a_from_b), tolerance)
    against_b = _hidden(a.patch, b.patch.moved(a_from_b)) & ~agrees_b
    against_a = _hidden(b.patch, a.patch.moved(geometry.inverse(a_from_b))) & ~agrees_a
    rare_a, rare_b = rarity(a.patch.normal, b.patch.normal @ a_from_b[:3, :3].T)
    return OverlapEvidence(rare_a * agrees_a, rare_b * agrees_b, rare_a * against_a, rare_b * against_b)


def agreeing(target: Target, source: Patch, a_from_b: Pose, tolerance: float) -> np.ndarray:
    """Which surfels of the source lie on surfaces of the target, within `tolerance` (m), (K,) bool."""
    reach = max(1.25 * target.patch.cell, tolerance)
    matches = surfel_icp.match(target, source, a_from_b, reach, _ANGLE_DEG)
    agrees = np.zeros(len(source), bool)
    agrees[matches.source[np.abs(matches.distance) < tolerance]] = True
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
        np.ascontiguousarray(seen.observer[::step]),
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
