"""Block-sparse normal equations that add up, and Levenberg-Marquardt over anything that can linearize itself."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Generic, TypeVar

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import bsr_matrix, csc_matrix, diags
from scipy.sparse.linalg import splu

from lvba import banded
from lvba.kernels.plane_offsets import add_blocks

logger = logging.getLogger(__name__)

State = TypeVar("State")


@dataclass(frozen=True)
class NormalEquations:
    """A cost linearized at a state: `cost + gradient . d + d . hessian . d / 2`. Sums over parts of the cost.

    rows, columns: (M,) int32, block indices with rows <= columns, ascending by (row, column), no pair twice
    blocks: (M, b, b) float64; the lower triangle of the Hessian is the transpose of what is stored
    gradient: (B, b) float64
    cost: the value at the state
    eliminated: what unknowns that were eliminated lower the cost by when the others stay
    """

    rows: np.ndarray
    columns: np.ndarray
    blocks: np.ndarray
    gradient: np.ndarray
    cost: float
    eliminated: float = 0.0

    def __add__(self, other: "NormalEquations") -> "NormalEquations":
        """The sum of two parts over the same unknowns; patterns may differ."""
        if self.gradient.shape != other.gradient.shape:
            raise ValueError(f"unknowns differ: {self.gradient.shape} and {other.gradient.shape}")
        gradient, cost = self.gradient + other.gradient, self.cost + other.cost
        eliminated = self.eliminated + other.eliminated
        if np.array_equal(self.rows, other.rows) and np.array_equal(self.columns, other.columns):
            blocks = self.blocks + other.blocks
            return replace(self, blocks=blocks, gradient=gradient, cost=cost, eliminated=eliminated)
        both = [(each.rows, each.columns, each.blocks) for each in (self, other)]
        return replace(_summed(both, gradient, cost), eliminated=eliminated)

    def scaled(self, factor: float) -> "NormalEquations":
        """The same equations for `factor` times the cost."""
        return replace(
            self,
            blocks=self.blocks * factor,
            gradient=self.gradient * factor,
            cost=self.cost * factor,
            eliminated=self.eliminated * factor,
        )

    def padded(self, count: int) -> "NormalEquations":
        """The same equations among `count` blocks of unknowns; the added ones do not occur."""
        gradient = np.zeros((count, self.gradient.shape[1]))
        gradient[: len(self.gradient)] = self.gradient
        return replace(self, gradient=gradient)

    def dense(self) -> np.ndarray:
        """The whole Hessian, (B b, B b) float64."""
        count, size = self.gradient.shape
        full = np.zeros((count, size, count, size))
        full[self.rows, :, self.columns] = self.blocks
        full[self.columns, :, self.rows] = self.blocks.transpose(0, 2, 1)
        return full.reshape(count * size, count * size)

    def sparse(self) -> csc_matrix:
        """The whole Hessian, sparse."""
        count, size = self.gradient.shape
        off = self.rows != self.columns
        rows = np.concatenate([self.rows, self.columns[off]])
        columns = np.concatenate([self.columns, self.rows[off]])
        blocks = np.concatenate([self.blocks, self.blocks[off].transpose(0, 2, 1)])
        order = np.lexsort((columns, rows))
        starts = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=count))])
        shape = (count * size, count * size)
        return bsr_matrix((blocks[order], columns[order], starts), shape=shape).tocsc()


def from_blocks(
    rows: np.ndarray, columns: np.ndarray, blocks: np.ndarray, gradient: np.ndarray, cost: float
) -> NormalEquations:
    """Normal equations of (M,) block indices in any order, repeated or below the diagonal, summed in that order."""
    return _summed([(rows, columns, blocks)], gradient, cost)


def _summed(
    parts: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]], gradient: np.ndarray, cost: float
) -> NormalEquations:
    """Normal equations of the blocks of all parts (rows, columns, blocks); never a copy of all blocks at once."""
    count, size = len(gradient), gradient.shape[1]
    keys = [
        np.minimum(rows, columns).astype(np.int64) * count + np.maximum(rows, columns)
        for rows, columns, _ in parts
    ]
    unique = np.unique(np.concatenate(keys))
    summed = np.zeros((len(unique), size, size))
    for key, (rows, columns, blocks) in zip(keys, parts, strict=True):
        below = rows > columns
        if below.any():
            blocks = np.where(below[:, None, None], blocks.transpose(0, 2, 1), blocks)
        add_blocks(summed, np.searchsorted(unique, key), blocks)
    return NormalEquations(
        (unique // count).astype(np.int32), (unique % count).astype(np.int32), summed, gradient, cost
    )


def scattered(parts: Sequence[tuple[np.ndarray, NormalEquations]], count: int) -> NormalEquations:
    """The sum, in this order, of equations over some of `count` blocks of unknowns each.

    parts: (n,) which blocks, and the equations over these n
    """
    gradient = np.zeros((count, parts[0][1].gradient.shape[1]))
    for index, equations in parts:
        gradient[index] += equations.gradient
    return _summed(
        [(index[equations.rows], index[equations.columns], equations.blocks) for index, equations in parts],
        gradient,
        float(sum(equations.cost for _, equations in parts)),
    )


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


def solve_step(
    equations: NormalEquations,
    damping: float,
    free: np.ndarray | None = None,
    dense_limit: int = 2500,
    added: np.ndarray | None = None,
) -> np.ndarray | None:
    """The damped step (B, b), `-(H + damping diag(H))^-1 g` over the free unknowns; None where H is not positive.

    free: (B, b) bool; unknowns that are not free do not move. None: all are.
    added: (b,), to the diagonal of every block of H beside the damping
    """
    gradient = equations.gradient.ravel()
    index = np.arange(gradient.size) if free is None else np.flatnonzero(free)
    step = np.zeros(gradient.size)
    if index.size <= dense_limit:
        hessian = equations.dense()[np.ix_(index, index)]
        diagonal = _damped(np.diag(hessian))
        more = 0.0 if added is None else np.tile(added, len(equations.gradient))[index]
        hessian[np.diag_indices_from(hessian)] += damping * diagonal + more
        try:
            step[index] = cho_solve(cho_factor(hessian, lower=True, overwrite_a=True), -gradient[index])
        except np.linalg.LinAlgError:
            return None
    else:
        solve = factorize(equations, damping, free, added)
        if solve is None:
            return None
        step = -solve(gradient[:, None])[:, 0]
    return step.reshape(equations.gradient.shape) if np.all(np.isfinite(step)) else None


def factorize(
    equations: NormalEquations,
    damping: float,
    free: np.ndarray | None = None,
    added: np.ndarray | None = None,
) -> banded.Solve | None:
    """A function that solves `(H + damping diag(H)) x = r` for (B b, n) right sides; None where H is not positive.

    free: (B, b) bool; unknowns that are not free are zero. None: all are. By a band where there is one, else sparse LU.
    added: as in `solve_step`
    """
    count, size = equations.gradient.shape
    free = np.ones((count, size), bool) if free is None else free
    own = equations.rows == equations.columns
    diagonal = np.zeros((count, size))
    diagonal[equations.rows[own]] = np.diagonal(equations.blocks[own], axis1=1, axis2=2)
    index = np.flatnonzero(free)
    more = np.zeros(count * size)
    more[index] = damping * _damped(diagonal.ravel()[index])
    more = more.reshape(count, size)
    if added is not None:
        more += added * free
    try:
        return banded.factor(equations.rows, equations.columns, equations.blocks, more, free)
    except MemoryError:
        return _sparse_lu(equations, more, index)


def _sparse_lu(equations: NormalEquations, added: np.ndarray, index: np.ndarray) -> banded.Solve | None:
    matrix = (equations.sparse() + diags(added.ravel()))[index][:, index].tocsc()
    try:
        factor = splu(matrix, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
    except RuntimeError:
        return None

    def solve(right: np.ndarray) -> np.ndarray:
        found = np.zeros_like(right)
        found[index] = factor.solve(right[index])
        return found

    return solve


def _damped(diagonal: np.ndarray) -> np.ndarray:
    """The diagonal with a floor, so that unknowns without information are damped too."""
    return np.maximum(diagonal, 1e-9 * max(float(diagonal.max(initial=0.0)), 1e-30))


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


def covariance_blocks(
    equations: NormalEquations, free: np.ndarray | None = None, dense_limit: int = 2500
) -> tuple[np.ndarray, np.ndarray]:
    """Of the inverse Hessian over the free unknowns: (B, b, b) diagonal blocks, and (B, b, b) blocks with the last.

    Unknowns without information get a tiny damping instead of an infinite variance; unknowns held fixed get zero.
    """
    count, size = equations.gradient.shape
    index = np.arange(count * size) if free is None else np.flatnonzero(free)
    own, last = np.zeros((count, size, size)), np.zeros((count, size, size))
    inverse = inverse_columns(equations, index, dense_limit)
    final = np.flatnonzero(index >= (count - 1) * size)
    with_last = np.zeros((count * size, size))
    with_last[np.ix_(index, index[final] - (count - 1) * size)] = inverse(final)
    last[:] = with_last.reshape(count, size, size)
    starts = np.searchsorted(index, np.arange(count + 1) * size)
    for block in range(count):
        mine = np.arange(starts[block], starts[block + 1])
        local = index[mine] - block * size
        own[block][np.ix_(local, local)] = inverse(mine)[mine]
    return own, last


def inverse_columns(
    equations: NormalEquations, index: np.ndarray, dense_limit: int
) -> Callable[[np.ndarray], np.ndarray]:
    """A function that gives columns (len(index), n) of the inverse Hessian over the unknowns `index`."""
    if index.size <= dense_limit:
        hessian = equations.dense()[np.ix_(index, index)]
        hessian[np.diag_indices_from(hessian)] += 1e-10 * _damped(np.diag(hessian))
        whole = cho_solve(cho_factor(hessian, lower=True, overwrite_a=True), np.eye(index.size))
        return lambda columns: whole[:, columns]
    count, size = equations.gradient.shape
    free = np.zeros(count * size, bool)
    free[index] = True
    factor = factorize(equations, 1e-10, free.reshape(count, size))

    def solve(columns: np.ndarray) -> np.ndarray:
        if factor is None:
            raise np.linalg.LinAlgError("the normal equations are not positive")
        unit = np.zeros((count * size, len(columns)))
        unit[index[columns], np.arange(len(columns))] = 1.0
        return np.asarray(factor(unit)[index])

    return solve


def _predicted(equations: NormalEquations, step: np.ndarray) -> float:
    """How much the undamped quadratic model falls over a (B, b) step."""
    product = np.einsum("mij,mj->mi", equations.blocks, step[equations.columns])
    quadratic = np.einsum("mi,mi->m", step[equations.rows], product)
    double = np.where(equations.rows == equations.columns, 1.0, 2.0)
    by_step = -(equations.gradient * step).sum() - 0.5 * (double * quadratic).sum()
    return float(by_step) + equations.eliminated
