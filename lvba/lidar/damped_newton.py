"""Damped Newton steps on fixed planes."""

from dataclasses import dataclass

import numpy as np

from lvba.lidar.normal_equations import Problem, damped_step, linearize, retract
from lvba.lidar.plane_feature import PlaneFits, fit

_COST_NOISE = 10.0
"""A change of the cost that means nothing. Weak directions are held against what the
planes' noise would have them do, so the cost of the planes may rise by about as much."""


@dataclass(frozen=True)
class Solution:
    """Poses (S, 4, 4), the cost before and after, and the accepted steps."""

    world_from_scan: np.ndarray
    cost_before: float
    cost_after: float
    steps: int


def solve(
    problem: Problem,
    world_from_scan: np.ndarray,
    damping_metric: np.ndarray,
    *,
    steps: int = 10,
    exact: bool = True,
    tolerance: float = 1e-9,
) -> Solution:
    """At most `steps` accepted steps, fewer where the cost stands still. The first pose stays.

    damping_metric: (6,), information about each scan's motion that one unit of damping adds: damping is absolute, for
    relative to the diagonal of the Hessian it would stop the slow common motions that close a loop.
    tolerance: decrease of the cost, relative to it, that ends it: of the last step, or of the next one. The next step of
    Newton's method gains about what the last one gained more or less than its model said: all that is not quadratic.
    """
    poses, damping = world_from_scan, 0.0
    fits = fit(problem.features, poses)
    start = cost = problem.cost(poses, fits)
    slack = 0.0 if problem.projector is None else _COST_NOISE
    for taken in range(steps):
        trial = _trial(problem, poses, fits, cost + slack, damping, damping_metric, exact)
        if trial is None:
            return Solution(poses, start, cost, taken)
        gained = cost - trial.cost
        left = abs(gained - trial.predicted) if trial.damping == 0.0 else np.inf
        poses, fits, cost, damping = trial.poses, trial.fits, trial.cost, trial.damping / 100
        if min(gained, left) <= tolerance * cost:
            return Solution(poses, start, cost, taken + 1)
    return Solution(poses, start, cost, steps)


@dataclass(frozen=True)
class _Trial:
    """Poses after a step, the planes and the cost there, and the decrease of the cost that the model promised."""

    poses: np.ndarray
    fits: PlaneFits
    cost: float
    predicted: float
    damping: float


_DAMPINGS = 8


def _trial(
    problem: Problem,
    poses: np.ndarray,
    fits: PlaneFits,
    limit: float,
    damping: float,
    metric: np.ndarray,
    exact: bool,
) -> _Trial | None:
    """The first step that keeps the cost below the limit, with more and more damping; None if there is none."""
    equations = linearize(problem, poses, exact, fits)
    for _ in range(_DAMPINGS):
        step = damped_step(equations, damping * metric)
        if step is None and exact:
            exact, equations = False, linearize(problem, poses, False, fits)
            step = damped_step(equations, damping * metric)
        if step is not None:
            moved = retract(poses, step)
            there = fit(problem.features, moved)
            cost = problem.cost(moved, there)
            if cost <= limit:
                return _Trial(moved, there, cost, -0.5 * float(equations.gradient @ step.ravel()), damping)
        damping = max(10.0 * damping, 1.0)
    return None
