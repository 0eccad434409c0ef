"""The alignments of two patches of surfels that are near a rough one, and which of them the surfels prefer."""

from dataclasses import dataclass

import numpy as np

from lvba import geometry
from lvba.arrays import Pose
from lvba.loop_closure import correlation, surfel_icp, verification
from lvba.loop_closure.submap import Patch
from lvba.loop_closure.surfel_icp import Stage, Target
from lvba.loop_closure.verification import OverlapEvidence

SIGMAS = 2.0
"""How many standard deviations a rough pose may be off."""


@dataclass(frozen=True)
class Expected:
    """Where the odometry has patch b in the frame of patch a, (4, 4), with standard deviations."""

    a_from_b: np.ndarray
    sigma_m: float
    sigma_deg: float

    @property
    def reach_m(self) -> float:
        """m, no alignment is further away."""
        return SIGMAS * self.sigma_m

    @property
    def reach_deg(self) -> float:
        """Degrees, none is turned by more."""
        return SIGMAS * self.sigma_deg

    @property
    def information(self) -> np.ndarray:
        """(6, 6), local tangent [rotation | translation]."""
        return np.diag(np.repeat([np.radians(self.sigma_deg), self.sigma_m], 3) ** -2)


@dataclass(frozen=True)
class Alignment:
    """One alignment, and what speaks for it and against it."""

    a_from_b: np.ndarray
    evidence: OverlapEvidence

    @property
    def score(self) -> float:
        """What agrees, less what contradicts."""
        evidence = self.evidence
        return float(
            (evidence.for_a - _AGAINST * evidence.against_a).sum()
            + (evidence.for_b - _AGAINST * evidence.against_b).sum()
        )


_AGAINST = 3.0
"""How much more a surfel counts that contradicts than one that agrees."""


def find(
    target: Target, source: Target, expected: Expected, *, tolerance: float, starts: int
) -> list[Alignment]:
    """Different alignments that surfels fall into, within what the odometry may be off; best first.

    tolerance: m, furthest that surfels may be from a surface that they lie on; starts: rough alignments that are tried
    """
    cell = 2 * max(target.patch.cell, source.patch.cell)
    patches = (target.patch, source.patch)
    rough = correlation.search(
        *patches, expected.a_from_b, expected.reach_m, expected.reach_deg, cell, starts
    )
    few, more = (_thinned(source.patch, count) for count in (_COARSE_SURFELS, _FINE_SURFELS))
    begin = np.array([expected.a_from_b, *rough.a_from_b])
    coarse = _aligned(target, few, begin, surfel_icp.COARSE, expected)
    fine = _aligned(target, more, _different(coarse, _NEAR_M), surfel_icp.FINE, expected)
    inside = [
        pose
        for pose in _different(fine, _NEAR_M / 2)
        if _within(expected.a_from_b, pose, expected.reach_m, expected.reach_deg)
    ]
    alignments = [Alignment(pose, verification.evidence(target, source, pose, tolerance)) for pose in inside]
    return sorted(alignments, key=lambda alignment: -alignment.score)


def polished(target: Target, patch: Patch, a_from_b: Pose, expected: Expected) -> np.ndarray:
    """The alignment (4, 4) by all surfels, where it was found by some."""
    return np.asarray(_aligned(target, patch, a_from_b[None], surfel_icp.FINE[-1:], expected)[0])


def _aligned(
    target: Target, patch: Patch, a_from_b: np.ndarray, stages: tuple[Stage, ...], expected: Expected
) -> np.ndarray:
    """From each of some poses (P, 4, 4), (P, 4, 4)."""
    return surfel_icp.align_each(target, patch, a_from_b, stages, expected.a_from_b, expected.information)


_COARSE_SURFELS, _FINE_SURFELS = 800, 2500
_NEAR_M, _NEAR_DEG = 0.2, 2.0
"""Alignments that differ by less are the same."""


def _thinned(patch: Patch, count: int) -> Patch:
    """About that many of the surfels, evenly."""
    return patch.take(np.arange(0, len(patch), max(len(patch) // count, 1)))


def _different(poses: np.ndarray, near: float) -> np.ndarray:
    """The poses (P, 4, 4) without those that are near (m) an earlier one."""
    kept: list[np.ndarray] = []
    for pose in poses:
        if not any(_within(other, pose, near, _NEAR_DEG) for other in kept):
            kept.append(pose)
    return np.array(kept)


def _within(one: np.ndarray, other: np.ndarray, meters: float, degrees: float) -> bool:
    off = geometry.inverse(one) @ other
    return bool(np.linalg.norm(off[:3, 3]) <= meters and geometry.rotation_angle_deg(off) <= degrees)


def best_of(alignments: list[Alignment], target: Target, source: Target, tolerance: float) -> Alignment:
    """The one that surfels prefer which can tell it from the others.

    tolerance: m, furthest that a surfel may be from a surface that it agrees with
    """
    best = alignments[0]
    for other in alignments[1:]:
        here, there = _differing(best, other, target, source, tolerance)
        if there > here:
            best = other
    return best


def rivals(
    best: Alignment,
    alignments: list[Alignment],
    open_directions: np.ndarray,
    target: Target,
    source: Target,
    tolerance: float,
) -> list[tuple[float, np.ndarray]]:
    """How well each other alignment does in relation to the best one, and how far (6,) it is from it.

    tolerance: m, as of `best_of`; open_directions: (W, 6) float64, along these they do not count as different
    """
    others = []
    for other in alignments:
        off = geometry.log(geometry.inverse(best.a_from_b) @ other.a_from_b)
        if not _along(off, open_directions, source.patch):
            here, there = _differing(best, other, target, source, tolerance)
            others.append((max(there, 0.0) / here if here > 0 else float(there > 0), off))
    return others


def _differing(
    one: Alignment, other: Alignment, target: Target, source: Target, tolerance: float
) -> tuple[float, float]:
    """Score of two alignments among the surfels that would notice the difference.

    Ground does not notice a shift along it, facades not one along the street: however many of them agree, they say
    nothing.
    """
    scores = np.zeros(2)
    for patch, moved_by, side in (
        (source.patch, geometry.inverse(one.a_from_b) @ other.a_from_b, "b"),
        (target.patch, one.a_from_b @ geometry.inverse(other.a_from_b), "a"),
    ):
        moved = geometry.transform_points(moved_by, patch.center) - patch.center
        notices = np.abs(np.einsum("ki,ki->k", patch.normal, moved)) > 2 * tolerance
        for k, each in enumerate((one, other)):
            agree, against = (
                getattr(each.evidence, f"{what}_{side}")[notices].sum() for what in ("for", "against")
            )
            scores[k] += agree - _AGAINST * against
    return float(scores[0]), float(scores[1])


def _along(off: np.ndarray, directions: np.ndarray, patch: Patch) -> bool:
    """Whether a motion (6,) is one along open directions (W, 6), but for little."""
    lever = float(np.sqrt(np.mean(np.sum((patch.center - patch.center.mean(0)) ** 2, axis=1))))
    scale = np.array([lever] * 3 + [1.0] * 3)
    basis = np.linalg.qr((directions * scale).T)[0]
    left = off * scale - basis @ (basis.T @ (off * scale))
    return bool(np.linalg.norm(left) < _NEAR_M)
