"""Two patches of surfels, point to plane: the alignment, how well it is known, and which surfels agree."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from lvba import distinct_rows, geometry
from lvba.arrays import Pose, Poses, StepSigmas
from lvba.loop_closure.submap import Patch
from lvba.optim import normal_equations
from lvba.optim.levenberg_marquardt import damped_step
from lvba.optim.normal_equations import NormalEquations

_NEIGHBORS = 6
_FEWEST = 6
"""Matches below which nothing is aligned."""
_STEP_M, _STEP_RAD = 1e-5, 1e-6
"""An alignment stands still below."""
_OPEN_FRACTION = 0.0015
"""A direction is open when surfels tell less about it than this part of what they tell together: normals scatter by a
degree or two about a common one, and that is no information."""


@dataclass(frozen=True)
class Target:
    """A patch, and where its surfels are."""

    patch: Patch
    tree: cKDTree

    @staticmethod
    def of(patch: Patch) -> "Target":
        """Ready to be aligned to."""
        return Target(patch, cKDTree(patch.center))


@dataclass(frozen=True)
class Matches:
    """Pairs of surfels that face the same way and are near each other.

    source, target: (M,) int64
    distance: (M,) float64, m, of the source's center from the target's plane, along its normal
    """

    source: np.ndarray
    target: np.ndarray
    distance: np.ndarray


@dataclass(frozen=True)
class Stage:
    """reach: m, furthest match; angle_deg: largest between normals; steps: at most; robust: m, scale of the kernel."""

    reach: float
    angle_deg: float
    steps: int
    robust: float


COARSE = (Stage(2.0, 40.0, 4, 0.5), Stage(1.2, 35.0, 4, 0.3), Stage(0.7, 30.0, 6, 0.15))
FINE = (Stage(0.7, 25.0, 8, 0.08), Stage(0.5, 20.0, 12, 0.03))


def match(target: Target, source: Patch, a_from_b: Pose, reach: float, angle_deg: float) -> Matches:
    """The nearest surfel of the target within `reach` (m) that faces the same way, for each surfel of the source that has
    one."""
    return _match_each(target, source, a_from_b[None], reach, angle_deg)


def _match_each(
    target: Target, source: Patch, a_from_b: np.ndarray, reach: float, angle_deg: float
) -> Matches:
    """As `match` for each of some poses (P, 4, 4); surfel j of the source is number k len(source) + j at the k-th."""
    rotation, translation = np.swapaxes(a_from_b[:, :3, :3], 1, 2), a_from_b[:, None, :3, 3]
    center = (source.center @ rotation + translation).reshape(-1, 3)
    facing = (source.normal @ rotation).reshape(-1, 3)
    away, near = target.tree.query(center, k=_NEIGHBORS, distance_upper_bound=reach)
    there = np.isfinite(away)
    near = np.where(there, near, 0)
    cosine = np.einsum("kni,ki->kn", target.patch.normal[near], facing)
    alike = there & (cosine > np.cos(np.radians(angle_deg)))
    first = np.argmax(alike, axis=1)
    index = np.flatnonzero(alike.any(axis=1))
    nearest = near[index, first[index]]
    normal = target.patch.normal[nearest]
    distance = np.einsum("mi,mi->m", normal, center[index] - target.patch.center[nearest])
    return Matches(index, nearest, distance)


def align(
    target: Target,
    source: Patch,
    a_from_b: Pose,
    stages: tuple[Stage, ...],
    expected: Pose,
    prior: np.ndarray,
) -> np.ndarray:
    """`a_from_b` (4, 4) that brings the source's surfels onto the target's planes; Cauchy kernel.

    a_from_b: where to begin; expected: (4, 4), where the odometry has it, with information `prior` (6, 6), local tangent:
        decides what surfaces leave open, and no more
    prior: (6, 6) float64, rad and m, to the power of -2
    """
    return np.asarray(align_each(target, source, a_from_b[None], stages, expected, prior)[0])


def align_each(
    target: Target,
    source: Patch,
    a_from_b: Poses,
    stages: tuple[Stage, ...],
    expected: Pose,
    prior: np.ndarray,
) -> np.ndarray:
    """As `align` from each of some poses (P, 4, 4), (P, 4, 4): all of them move at once, each by itself.

    expected: (4, 4); prior: (6, 6) float64
    """
    poses, matched = np.array(a_from_b), np.ones(len(a_from_b), bool)
    for stage in stages:
        moving = matched.copy()
        for _ in range(stage.steps):
            if not moving.any():
                break
            here = np.flatnonzero(moving)
            equations, enough = _linearized(target, source, poses[here], stage, expected, prior)
            moving[here[~enough]] = matched[here[~enough]] = False
            # surfels are matched anew before every step, so no cost could accept or refuse it
            taken, _ = damped_step(equations, 0.0)
            if taken is None:
                return poses
            step = np.where(enough[:, None], taken.blocks, 0.0)
            poses[here] = geometry.retract(poses[here], step)
            far = (np.abs(step[:, :3]).max(1) >= _STEP_RAD) | (np.abs(step[:, 3:]).max(1) >= _STEP_M)
            moving[here] &= far
    return poses


def _linearized(
    target: Target, source: Patch, a_from_b: np.ndarray, stage: Stage, expected: np.ndarray, prior: np.ndarray
) -> tuple[NormalEquations, np.ndarray]:
    """Normal equations with a block for each of some poses (P, 4, 4), and whether enough surfels match there, (P,)."""
    count, size = len(a_from_b), len(source)
    matches = _match_each(target, source, a_from_b, stage.reach, stage.angle_deg)
    weight = 1 / (1 + (matches.distance / stage.robust) ** 2) / stage.robust**2
    behind = geometry.log(geometry.inverse(expected) @ a_from_b)
    hessian, pull = np.tile(prior, (count, 1, 1)), behind @ prior
    ends = np.searchsorted(matches.source, size * np.arange(count + 1))
    for k, (first, last) in enumerate(pairwise(ends)):
        here = slice(first, last)
        own = Matches(matches.source[here] - k * size, matches.target[here], matches.distance[here])
        jacobian = jacobians(target, source, a_from_b[k], own)
        weighted = weight[here, None] * jacobian
        hessian[k] += jacobian.T @ weighted
        pull[k] += weighted.T @ own.distance
    diagonal = np.arange(count)
    equations = normal_equations.from_blocks(diagonal, diagonal, hessian, pull, 0.0)
    return equations, np.diff(ends) >= _FEWEST


def jacobians(target: Target, source: Patch, a_from_b: Pose, matches: Matches) -> np.ndarray:
    """(M, 6), derivatives of the distances by a right perturbation of a_from_b."""
    normal_b = target.patch.normal[matches.target] @ a_from_b[:3, :3]
    return np.concatenate([np.cross(source.center[matches.source], normal_b), normal_b], axis=1)


@dataclass(frozen=True)
class Certainty:
    """How well an alignment is known.

    information: (6, 6), local tangent [rotation | translation] of a_from_b, zero in open directions
    open: (W, 6), motions that the surfaces leave open, local tangent, unit length (rotation times lever)
    sigma: m, typical distance of matched surfels from each other's plane (robust)
    """

    information: np.ndarray
    open: np.ndarray
    sigma: float


def certainty(
    target: Target, source: Patch, a_from_b: Pose, matches: Matches, floor: StepSigmas, open_sigma: float
) -> Certainty:
    """What the matched surfels tell about an alignment.

    Errors of neighboring surfels go together (they are bits of one plane), so the spread of the gradients of whole groups
    widens the covariance where it is larger than independent errors would make it (as in `lidar.covariance`).
    floor: (6,), rad and m, no direction is known better: maps bend a little
    open_sigma: m, a direction known worse than this (rotation times the lever of the surfels) is open, too
    """
    if len(matches.source) == 0:
        return Certainty(np.zeros((6, 6)), np.eye(6), float("inf"))
    sigma = max(1.4826 * float(np.median(np.abs(matches.distance))), 1e-4)
    near = np.abs(matches.distance) < 3 * sigma
    jacobian, distance = jacobians(target, source, a_from_b, matches)[near], matches.distance[near]
    center = source.center[matches.source[near]]
    lever = max(float(np.sqrt(np.mean(np.sum((center - center.mean(0)) ** 2, axis=1)))), 1e-3)
    scale = np.array([1 / lever] * 3 + [1.0] * 3)
    scaled = jacobian * scale
    hessian = scaled.T @ scaled
    group = _groups(center, target.patch.normal[matches.target[near]])
    gradient = np.stack([np.bincount(group, scaled[:, k] * distance) for k in range(6)], axis=-1)
    values, vectors = np.linalg.eigh(hessian)
    trust = vectors / np.maximum(values, 1e-9 * max(values[-1], 1e-9))
    spread = float(np.einsum("gi,ij,gj->", gradient, trust @ vectors.T, gradient)) / 6
    variance = max(sigma**2, spread)
    known = (values > _OPEN_FRACTION * values.sum()) & (values > variance / open_sigma**2)
    basis, tells = vectors[:, known], values[known]
    covariance = np.diag(variance / tells) + basis.T @ np.diag((floor / scale) ** 2) @ basis
    information = basis @ np.linalg.inv(covariance) @ basis.T
    information = 0.5 * (information + information.T) / np.outer(scale, scale)
    return Certainty(information, (vectors[:, ~known] * scale[:, None]).T, sigma)


_GROUP_M = 3.0


def _groups(center: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Numbers (M,) of groups of surfels that are near each other and face the same way."""
    cell = np.floor(center / _GROUP_M).astype(np.int64)
    facing = 2 * np.abs(normal).argmax(axis=1) + (
        normal[np.arange(len(normal)), np.abs(normal).argmax(1)] > 0
    )
    return distinct_rows.number(np.concatenate([cell, facing[:, None]], axis=1))
