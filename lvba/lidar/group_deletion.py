"""By how much errors that planes close to each other share make poses worse than the planes' information has it.

A depth camera bends the surfaces in one part of its view alike: planes that are close to each other then err together,
and the poses follow them. No residual shows it; nor does the spread of the gradients of single planes, whose errors it
takes to be independent. But a solution without the planes of some pieces of space moves further than it should. If the
information is right, an estimate from a part of the data differs from that of all by the difference of the two
covariances (Hausman, "Specification Tests in Econometrics", Econometrica 1978). The ratio of squared moves to that, over
groups of pieces left out in turn (delete-a-group jackknife), is the variance factor at the size of a piece.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from lvba import distinct_rows
from lvba.arrays import Poses
from lvba.lidar.dense_covariance import aligned, aligned_of_root, alignment, inverse, root_of_inverse
from lvba.lidar.plane_feature import PlaneFeatures, fit
from lvba.lidar.problem import Problem
from lvba.optim.normal_equations import NormalEquations
from lvba.parallel import in_order

PIECE_M = 1.0
"""Planes within cubes of this size err together. Of half that, 1 and 2 m, 1 m tells most of two Kinects; ratios of clean
scenes do not change with it."""
GROUPS = 8
"""Pieces are dealt to so many groups, each left out once."""
DEALS = 3
"""Most times that pieces are cut and dealt anew, over all windows: one deal is 40 % off."""
_PLAIN = 0.65
"""Where the first deal finds a ratio below this, planes do not err together, and others would find no ratio above 1."""
MOST_SCANS = 150
"""Scans that are looked at together: the time grows with their third power. Of more, windows of so many tell: the first,
the last and, where these two leave some out, the middle one."""

_LEAST = 1e-12
"""rad^2 and m^2: alignment leaves nothing of the errors of very few scans, and what is divided by must not vanish."""


def variance_factor(problem: Problem, world_from_scan: Poses) -> float:
    """Squared moves of poses (S, 4, 4) that solve a problem over what they should be; 1 where it cannot be told: without
    odometry poses may be open without a group, and fewer pieces than groups leave nothing to compare."""
    if problem.prior is None:
        return 1.0
    moved = expected = 0.0
    windows = list(_windows(problem, world_from_scan))
    for number, (window, poses) in enumerate(windows):
        whole = _Whole.of(window, poses)
        deals = DEALS // len(windows) + (number < DEALS % len(windows))
        for group in _deals(window.features, poses, deals):
            each = _moves(whole, group)
            moved, expected = moved + each[0], expected + each[1]
            if each[0] < _PLAIN * each[1]:
                break
    return moved / expected if expected > 0 else 1.0


def _windows(problem: Problem, poses: np.ndarray) -> Iterator[tuple[Problem, np.ndarray]]:
    """The problem with its poses, or of many scans those of the first, of the last and of what is between them."""
    if len(poses) <= MOST_SCANS:
        yield problem, poses
        return
    last = len(poses) - MOST_SCANS
    for first in (0, last) if last <= MOST_SCANS else (0, last // 2, last):
        yield _window(problem, first, first + MOST_SCANS), poses[first : first + MOST_SCANS]


def _window(problem: Problem, first: int, end: int) -> Problem:
    """Of scans first to end alone: planes that two of them see, and odometry; an IMU is left out."""
    features, prior = problem.features, problem.prior
    assert prior is not None
    mine = (features.scan >= first) & (features.scan < end)
    seen = np.bincount(features.feature[mine], minlength=len(features))
    mine &= (seen >= 2)[features.feature]
    counts = np.bincount(features.feature[mine], minlength=len(features))
    kept = counts > 0
    inside = PlaneFeatures(
        offsets=np.concatenate([[0], np.cumsum(counts[kept])]).astype(np.int64),
        scan=(features.scan[mine] - first).astype(np.int32),
        clusters=features.clusters.take(mine),
        weight=features.weight[mine],
        size=features.size[kept],
    )
    projector = None if problem.projector is None else problem.projector[first:end]
    return Problem(inside, problem.sigma, prior.among(np.arange(first, end)), projector)


def _deals(features: PlaneFeatures, poses: np.ndarray, times: int) -> Iterator[np.ndarray]:
    """The group (F,) of each plane, so many times; none where there are too few pieces."""
    center = fit(features, poses).center
    random = np.random.default_rng(0)
    for _ in range(times):
        cell = np.floor(center / PIECE_M + random.uniform(size=3)).astype(np.int64)
        piece = distinct_rows.number(cell)
        pieces = int(piece.max(initial=-1)) + 1
        if pieces >= GROUPS:
            yield random.permutation(pieces)[piece] % GROUPS


@dataclass(frozen=True)
class _Whole:
    """What all planes of a problem say at poses (S, 4, 4), of all poses but the first.

    information: (6 S - 6, 6 S - 6); gradient, solution: (6 S - 6,); predicted: (S, 6, 6), covariance after alignment
    weight: (S, 6, 6), its inverse
    """

    problem: Problem
    poses: np.ndarray
    information: np.ndarray
    gradient: np.ndarray
    solution: np.ndarray
    predicted: np.ndarray
    weight: np.ndarray

    @classmethod
    def of(cls, problem: Problem, poses: np.ndarray) -> "_Whole":
        whole = problem.linearize(poses, exact=False)
        information, gradient = whole.dense()[6:, 6:], whole.gradient.ravel()[6:]
        covariance = inverse(information)
        predicted = aligned(covariance, poses)
        weight = np.linalg.inv(predicted + _LEAST * np.eye(6))
        return cls(problem, poses, information, gradient, covariance @ gradient, predicted, weight)


def _moves(whole: _Whole, group: np.ndarray) -> tuple[float, float]:
    """Squared moves of the poses without each group of planes, and what they should be; each in predicted units."""
    poses, weight = whole.poses, whole.weight
    motion, pick = alignment(poses)
    finds = np.linalg.solve(pick.T @ motion, pick.T)
    planes = replace(whole.problem, prior=None, inertial=None)

    def without_group(left: NormalEquations) -> tuple[float, float]:
        root = root_of_inverse(whole.information - left.dense()[6:, 6:])
        free = whole.solution - root @ (root.T @ (whole.gradient - left.gradient.ravel()[6:]))
        step = np.concatenate([np.zeros(6), free])
        step = np.asarray(step - motion @ (finds @ step)).reshape(-1, 6)
        moved = float(np.einsum("si,sij,sj->", step, weight, step))
        return moved, float(np.einsum("sij,sji->", weight, aligned_of_root(root, poses) - whole.predicted))

    # kernels share their own work among threads, matrices do not: those of several groups are inverted at once
    groups = (
        replace(planes, features=planes.features.select(group == each)).linearize(poses, exact=False)
        for each in range(GROUPS)
    )
    moved = expected = 0.0
    for each in in_order(without_group, groups):
        moved, expected = moved + each[0], expected + each[1]
    return moved, expected
