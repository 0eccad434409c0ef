"""Damped steps, factors and covariances of block-sparse normal equations: dense, as a band, or by sparse LU."""

from collections.abc import Callable

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import diags
from scipy.sparse.linalg import splu

from lvba.optim import banded_cholesky
from lvba.optim.normal_equations import NormalEquations


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
) -> banded_cholesky.Solve | None:
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
        return banded_cholesky.factor(equations.rows, equations.columns, equations.blocks, more, free)
    except MemoryError:
        return _sparse_lu(equations, more, index)


def _sparse_lu(
    equations: NormalEquations, added: np.ndarray, index: np.ndarray
) -> banded_cholesky.Solve | None:
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
