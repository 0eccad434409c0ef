"""The one step strategy: Levenberg-Marquardt over anything that can linearize itself, and single damped steps.

`levenberg_marquardt` solves a cost that stays the same from step to step: a step is accepted if the cost falls, that is
if its gain ratio (achieved over predicted decrease) is positive, or if the cost rises by less than its own noise.

Joint rounds find planes, scene points and weights anew before every step, so the costs of two rounds are those of two
problems. They take one `damped_step` per round, and refuse what a round that converges never does: a cost per observation
that rises by more than COST_RISE (`cost_rises`; scene points are many, and much the same from round to round), or a step
that is more than STEP_GROWTH times as long as the last one (`step_grows`; planes come and go). After a refusal the
damping is `raised`, after a step `eased`.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Generic, TypeVar

import numpy as np

from lvba.optim import two_level
from lvba.optim.linear_solver import solve_step
from lvba.optim.normal_equations import NormalEquations, Step
from lvba.optim.two_level import TwoLevelEquations

logger = logging.getLogger(__name__)

State = TypeVar("State")


@dataclass(frozen=True)
class SolverConfig:
    """How Levenberg-Marquardt damps, accepts and stops."""

    max_iterations: int = 20
    """Steps tried at most, accepted or not; 1 to 1000."""
    initial_damping: float = 1e-4
    """First damping, relative to the Hessian's diagonal; 0 to 1e3."""
    relative_decrease: float = 1e-6
    """Stop when a step lowers the cost by less than this fraction; 0 to 0.1."""
    refusals: int = 3
    """Stop when this many steps in a row are refused: what is still predicted is below the cost's own noise; 1 to 100."""
    step_tolerance: float = 1e-7
    """Stop when no unknown moves by more than this, in the unknowns' units (rad, m); 0 to 1e-2."""
    dense_limit: int = 2500
    """Up to this many unknowns the equations are solved by dense Cholesky, beyond as a band; 0 to 20000."""

    def __post_init__(self) -> None:
        _check("max_iterations", self.max_iterations, 1, 1000)
        _check("initial_damping", self.initial_damping, 0.0, 1e3)
        _check("relative_decrease", self.relative_decrease, 0.0, 0.1)
        _check("refusals", self.refusals, 1, 100)
        _check("step_tolerance", self.step_tolerance, 0.0, 1e-2)
        _check("dense_limit", self.dense_limit, 0, 20000)


def _check(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise ValueError(f"{name} is {value}, must be between {low} and {high}")


@dataclass(frozen=True)
class Iteration:
    """One tried step."""

    cost: float
    """Cost at the state kept after the step."""
    step: float
    """Largest change of an unknown."""
    damping: float
    gain: float
    """Achieved over predicted decrease; below zero: refused."""
    accepted: bool


@dataclass(frozen=True)
class Solution(Generic[State]):
    """Where Levenberg-Marquardt ended. Not to converge is a result, not an error."""

    state: State
    cost_initial: float
    cost: float
    """At `state`."""
    converged: bool
    history: tuple[Iteration, ...] = field(default=())


DAMPING_TRIES = 8
"""Dampings, each ten times the one before, until normal equations count as not positive."""
COST_RISE = 0.01
"""Part of the cost per observation by which it may rise from round to round."""
STEP_GROWTH = 2.0
"""Times the length of the last step that a step of a round may have."""


def levenberg_marquardt(
    state: State,
    linearize: Callable[[State], NormalEquations],
    retract: Callable[[State, Step], State],
    config: SolverConfig = SolverConfig(),
    free: np.ndarray | None = None,
    *,
    cost: Callable[[State], float] | None = None,
    convex: Callable[[State], NormalEquations] | None = None,
    metric: np.ndarray | None = None,
    cost_noise: float = 0.0,
    most_accepted: int | None = None,
) -> Solution[State]:
    """The state of least cost that was reached, and the history of steps.

    linearize: state -> NormalEquations, with its cost
    retract: (state, step) -> state
    free: (B, b) bool, what may move; None: all
    cost: state -> cost, where that takes less than to linearize
    convex: a linearization that is never indefinite (Gauss-Newton), for where `linearize` (Newton) is
    metric: (b,) float64, what one unit of damping adds to the diagonal of every block: slow motions common to many blocks
    are
        damped by no more than the motion of one. None: damping relative to the diagonal
    cost_noise: a rise of the cost that means nothing
    most_accepted: stop after so many accepted steps
    Damping by gain ratio (Nielsen 1999; Madsen et al. 2004, section 3.2).
    """
    at = _evaluated(state, linearize, None)
    cost_initial, damping = at.cost, _Damping(config.initial_damping)
    history: list[Iteration] = []
    refused = 0
    while len(history) < config.max_iterations:
        equations = at.equations or linearize(at.state)
        step = solve_step(equations, damping.value, free, config.dense_limit, metric)
        if step is None and convex is not None:
            equations = convex(at.state)
            step = solve_step(equations, damping.value, free, config.dense_limit, metric)
        if step is None:
            at, damping = replace(at, equations=equations), damping.refused()
            history.append(Iteration(at.cost, 0.0, damping.value, -1.0, False))
            continue
        trial = _evaluated(retract(at.state, step), linearize, cost)
        predicted, decrease = equations.predicted(step), at.cost - trial.cost
        gain = decrease / predicted if predicted > 0 else -1.0
        accepted = bool(decrease > -cost_noise and np.isfinite(trial.cost))
        size, least = step.largest, config.relative_decrease * abs(at.cost)
        done = size <= config.step_tolerance or predicted <= least or (accepted and decrease <= least)
        if accepted:
            at, damping, refused = trial, damping.accepted(gain), 0
        else:
            at, damping, refused = replace(at, equations=equations), damping.refused(), refused + 1
        history.append(Iteration(at.cost, size, damping.value, gain, accepted))
        logger.debug("cost %.6g step %.2g damping %.2g gain %.2f", at.cost, size, damping.value, gain)
        # a step of little predicted decrease that was refused: the cost's own noise (samples that come and go) is reached
        if done or (refused >= config.refusals and predicted <= 1e-3 * abs(at.cost)):
            return Solution(at.state, cost_initial, at.cost, True, tuple(history))
        if most_accepted is not None and sum(entry.accepted for entry in history) >= most_accepted:
            break
    return Solution(at.state, cost_initial, at.cost, False, tuple(history))


@dataclass(frozen=True)
class _Evaluated(Generic[State]):
    """A state, its cost, and its equations if they are known."""

    state: State
    cost: float
    equations: NormalEquations | None


def _evaluated(
    state: State, linearize: Callable[[State], NormalEquations], cost: Callable[[State], float] | None
) -> _Evaluated[State]:
    if cost is not None:
        return _Evaluated(state, cost(state), None)
    equations = linearize(state)
    return _Evaluated(state, equations.cost, equations)


@dataclass(frozen=True)
class _Damping:
    """The damping, and by how much it grows at the next refusal."""

    value: float
    growth: float = 2.0

    def accepted(self, gain: float) -> "_Damping":
        return _Damping(self.value * max(1 / 3, 1 - (2 * gain - 1) ** 3))

    def refused(self) -> "_Damping":
        return _Damping(self.value * self.growth if self.value > 0 else 1.0, 2 * self.growth)


def damped_step(
    equations: NormalEquations | TwoLevelEquations,
    damping: float,
    free: np.ndarray | None = None,
    metric: np.ndarray | None = None,
) -> tuple[Step | None, float]:
    """One step, and its damping: more than the given one where the equations are not positive without.

    None: they are not with any of DAMPING_TRIES dampings. free, metric: as in `levenberg_marquardt`
    free: (B, b) bool; metric: (b,) float64
    """
    for _ in range(DAMPING_TRIES):
        if isinstance(equations, TwoLevelEquations):
            step = two_level.solve_step(equations, damping, free, metric)
        else:
            step = solve_step(equations, damping, free, metric=metric)
        if step is not None:
            return step, damping
        damping = raised(damping)
    return None, damping


def raised(damping: float) -> float:
    """The damping after a round that was refused."""
    return max(10.0 * damping, 1.0)


def eased(damping: float) -> float:
    """The damping after a round's step was taken."""
    return damping / 100.0


def cost_rises(cost: float, before: float) -> bool:
    """Whether the cost per observation of a round says that the step before it was wrong."""
    return cost > before * (1.0 + COST_RISE)


def step_grows(length: float, before: float) -> bool:
    """Whether the length of a round's step (m) is so much more than that of the last one that it leads away.

    length, before: m
    """
    return length > STEP_GROWTH * before
