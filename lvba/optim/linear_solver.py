"""Damped steps, factors and covariances of block-sparse normal equations: dense, as a band, or by sparse LU."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import diags
from scipy.sparse.linalg import SuperLU, splu

from lvba.optim import banded_cholesky
from lvba.optim.banded_cholesky import BandedCholesky
from lvba.optim.normal_equations import NormalEquations


@dataclass(frozen=True)
class SparseFactor:
    """Sparse LU factors over the unknowns `index` of blocks of `shape` (B, b)."""

    lu: SuperLU
    index: np.ndarray
    shape: tuple[int, ...]

    def solve(self, right: np.ndarray) -> np.ndarray:
        """The solution (B b, n) for right sides (B b, n); zero for unknowns that are not in `index`."""
        found = np.zeros_like(right)
        found[self.index] = self.lu.solve(np.ascontiguousarray(right[self.index]))
        return found

    def inverse_blocks(self) -> np.ndarray:
        """The diagonal blocks (B, b, b) of the inverse, from its columns."""
        count, size = self.shape
        found = np.zeros((count, size, size))
        free = np.zeros(count * size, bool)
        free[self.index] = True
        for block in range(count):
            mine = slice(size * block, size * block + size)
            unit = np.zeros((count * size, size))
            unit[mine] = np.diag(free[mine].astype(float))
            found[block] = self.solve(unit)[mine]
        return found


_FULL = 0.25
"""Part of all pairs of blocks above which a pattern has no band: dense Cholesky, however many unknowns."""


def solve_step(
    equations: NormalEquations,
    damping: float,
    free: np.ndarray | None = None,
    dense_limit: int = 2500,
    metric: np.ndarray | None = None,
) -> np.ndarray | None:
    """The damped step (B, b), `-(H + damping D)^-1 g` over the free unknowns; None where that matrix is not positive.

    free: (B, b) bool; unknowns that are not free do not move. None: all are.
    dense_limit: most unknowns for which a sparse pattern is solved by dense Cholesky
    metric: (b,), the diagonal of D for every block, absolute: what one unit of damping adds; None: the diagonal of H
    """
    free = np.ones(equations.gradient.shape, bool) if free is None else free
    gradient = np.where(free, equations.gradient, 0.0)
    if _is_dense(equations, int(free.sum()), dense_limit):
        hessian = _upper(equations, free)
        hessian[np.diag_indices_from(hessian)] += _damped_diagonal(equations, damping, free, metric).ravel()
        try:
            # the transpose of rows is columns, as LAPACK has it in memory: factored in place
            factor = cho_factor(hessian.T, lower=True, overwrite_a=True, check_finite=False)
        except np.linalg.LinAlgError:
            return None
        step = -cho_solve(factor, gradient.ravel(), check_finite=False)
    else:
        factors = factorize(equations, damping, free, metric)
        if factors is None:
            return None
        step = -factors.solve(gradient.reshape(-1, 1))[:, 0]
    return step.reshape(equations.gradient.shape) if np.all(np.isfinite(step)) else None


def _is_dense(equations: NormalEquations, unknowns: int, limit: int) -> bool:
    blocks = len(equations.gradient)
    return unknowns <= limit or len(equations.rows) > _FULL * blocks * (blocks + 1) / 2


def _upper(equations: NormalEquations, free: np.ndarray) -> np.ndarray:
    """(B b, B b), of which the upper triangle is the Hessian over the free unknowns; the others are apart, with zeros."""
    count, size = free.shape
    blocks = np.zeros((count, size, count, size))
    blocks[equations.rows, :, equations.columns] = equations.blocks
    full = blocks.reshape(count * size, count * size)
    held = np.flatnonzero(~free)
    full[held], full[:, held] = 0.0, 0.0
    return full


def _damped_diagonal(
    equations: NormalEquations, damping: float, free: np.ndarray, metric: np.ndarray | None
) -> np.ndarray:
    """(B, b): what damping adds to the diagonal of the free unknowns, and 1 for those that are not free."""
    own = equations.rows == equations.columns
    diagonal = np.zeros(free.shape)
    diagonal[equations.rows[own]] = np.diagonal(equations.blocks[own], axis1=1, axis2=2)
    added = np.ones(free.shape)
    if metric is None:
        added[free] = damping * _damped(diagonal[free])
    else:
        added[free] = np.broadcast_to(damping * metric, free.shape)[free]
    return added


def factorize(
    equations: NormalEquations,
    damping: float,
    free: np.ndarray | None = None,
    metric: np.ndarray | None = None,
) -> BandedCholesky | SparseFactor | None:
    """The factors of `H + damping D`; None where the matrix is not positive.

    free: (B, b) bool; unknowns that are not free are zero. None: all are. By a band where there is one, else sparse LU.
    metric: as in `solve_step`
    """
    free = np.ones(equations.gradient.shape, bool) if free is None else free
    more = _damped_diagonal(equations, damping, free, metric)
    try:
        return banded_cholesky.factor(equations.rows, equations.columns, equations.blocks, more, free)
    except MemoryError:
        return _sparse_lu(equations, more, np.flatnonzero(free))


def _sparse_lu(equations: NormalEquations, added: np.ndarray, index: np.ndarray) -> SparseFactor | None:
    matrix = (equations.sparse() + diags(added.ravel()))[index][:, index].tocsc()
    try:
        return SparseFactor(
            splu(matrix, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}), index, added.shape
        )
    except RuntimeError:
        return None


def _damped(diagonal: np.ndarray) -> np.ndarray:
    """The diagonal with a floor, so that unknowns without information are damped too."""
    return np.maximum(diagonal, 1e-9 * max(float(diagonal.max(initial=0.0)), 1e-30))


def covariance_blocks(
    equations: NormalEquations, free: np.ndarray | None = None, dense_limit: int = 2500
) -> tuple[np.ndarray, np.ndarray]:
    """Of the inverse Hessian over the free unknowns: (B, b, b) diagonal blocks, and (B, b, b) blocks with the last.

    Unknowns without information get a tiny damping instead of an infinite variance; unknowns held fixed get zero.
    """
    count, size = equations.gradient.shape
    index = np.arange(count * size) if free is None else np.flatnonzero(free)
    own, last = np.zeros((count, size, size)), np.zeros((count, size, size))
    if index.size > dense_limit:
        return _selected_blocks(equations, index)
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


def _selected_blocks(equations: NormalEquations, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """As `covariance_blocks`, without the inverse as a whole."""
    count, size = equations.gradient.shape
    free = np.zeros(count * size, bool)
    free[index] = True
    free = free.reshape(count, size)
    factors = factorize(equations, 1e-10, free)
    if factors is None:
        raise np.linalg.LinAlgError("the normal equations are not positive")
    unit = np.zeros((count * size, size))
    unit[-size:] = np.diag(free[-1].astype(float))
    return factors.inverse_blocks(), factors.solve(unit).reshape(count, size, size)


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
    factors = factorize(equations, 1e-10, free.reshape(count, size))

    def solve(columns: np.ndarray) -> np.ndarray:
        if factors is None:
            raise np.linalg.LinAlgError("the normal equations are not positive")
        unit = np.zeros((count * size, len(columns)))
        unit[index[columns], np.arange(len(columns))] = 1.0
        return np.asarray(factors.solve(unit)[index])

    return solve
