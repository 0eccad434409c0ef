"""Levenberg-Marquardt over anything that can linearize itself."""

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy as np

from lvba.optim.linear_solver import solve_step
from lvba.optim.normal_equations import NormalEquations

logger = logging.getLogger(__name__)

State = TypeVar("State")


@dataclass(frozen=True)
class SolverConfig:
    """How Levenberg-Marquardt damps, accepts and stops."""

    max_iterations: int = 20
    """Steps tried at most, accepted or not; 1 to 1000."""
    initial_damping: float = 1e-4
    """First damping, relative to the Hessian's diagonal; 1e-12 to 1e3."""
    relative_decrease: float = 1e-6
    """Stop when a step lowers the cost by less than this fraction; 0 to 0.1."""
    refusals: int = 3
    """Stop when this many steps in a row are refused: what the cost still promises is below its own noise; 1 to 100."""
    step_tolerance: float = 1e-7
    """Stop when no unknown moves by more than this, in the unknowns' units (rad, m); 0 to 1e-2."""
    dense_limit: int = 2500
    """Up to this many unknowns the equations are solved by dense Cholesky, beyond as a band; 0 to 20000."""

    def __post_init__(self) -> None:
        _check("max_iterations", self.max_iterations, 1, 1000)
        _check("initial_damping", self.initial_damping, 1e-12, 1e3)
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
    equations: NormalEquations
    """At `state`, without damping."""
    cost_initial: float
    converged: bool
    history: tuple[Iteration, ...] = field(default=())


def levenberg_marquardt(
    state: State,
    linearize: Callable[[State], NormalEquations],
    retract: Callable[[State, np.ndarray], State],
    config: SolverConfig = SolverConfig(),
    free: np.ndarray | None = None,
) -> Solution[State]:
    """The state of least cost that was reached, with its equations and the history of steps.

    linearize: state -> NormalEquations, with its cost
    retract: (state, (B, b) step) -> state
    Damping by gain ratio (Nielsen 1999; Madsen et al. 2004, section 3.2).
    """
    equations = linearize(state)
    cost_initial, damping, growth = equations.cost, config.initial_damping, 2.0
    history: list[Iteration] = []
    converged, refused = False, 0
    for _ in range(config.max_iterations):
        step = solve_step(equations, damping, free, config.dense_limit)
        if step is None:
            damping, growth = damping * growth, growth * 2
            history.append(Iteration(equations.cost, 0.0, damping, -1.0, False))
            continue
        size = float(np.abs(step).max(initial=0.0))
        trial = retract(state, step)
        at_trial = linearize(trial)
        predicted = _predicted(equations, step)
        decrease = equations.cost - at_trial.cost
        gain = decrease / predicted if predicted > 0 else -1.0
        accepted = decrease > 0 and np.isfinite(at_trial.cost)
        small = size <= config.step_tolerance or predicted <= config.relative_decrease * abs(equations.cost)
        done = small or (accepted and decrease <= config.relative_decrease * abs(equations.cost))
        if accepted:
            state, equations = trial, at_trial
            damping, growth, refused = damping * max(1 / 3, 1 - (2 * gain - 1) ** 3), 2.0, 0
        else:
            damping, growth, refused = damping * growth, growth * 2, refused + 1
        history.append(Iteration(equations.cost, size, damping, gain, accepted))
        logger.debug("cost %.6g step %.2g damping %.2g gain %.2f", equations.cost, size, damping, gain)
        # a step that promised little and was refused: the cost's own noise (samples that come and go) is reached
        if done or (refused >= config.refusals and predicted <= 1e-3 * abs(equations.cost)):
            converged = True
            break
    return Solution(state, equations, cost_initial, converged, tuple(history))


def _predicted(equations: NormalEquations, step: np.ndarray) -> float:
    """How much the undamped quadratic model falls over a (B, b) step."""
    product = np.einsum("mij,mj->mi", equations.blocks, step[equations.columns])
    quadratic = np.einsum("mi,mi->m", step[equations.rows], product)
    double = np.where(equations.rows == equations.columns, 1.0, 2.0)
    by_step = -(equations.gradient * step).sum() - 0.5 * (double * quadratic).sum()
    return float(by_step) + equations.eliminated
