"""Damped steps, factors and covariances of normal equations: dense, as a band, or by sparse LU, and a border.

The poses' part is factored by one of three back ends, by its size and pattern. The shared parameters beside it are few:
they are eliminated last, by the Schur complement of the border.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve, lapack
from scipy.sparse import csc_matrix, csr_matrix, diags
from scipy.sparse.linalg import SuperLU, splu

from lvba.arrays import Indices
from lvba.optim import banded_cholesky
from lvba.optim.banded_cholesky import BandedCholesky
from lvba.optim.normal_equations import NormalEquations, Step

_FULL = 0.25
"""Part of all pairs of blocks above which a pattern has no band: dense Cholesky, however many unknowns."""
_COLUMNS = 240
"""Columns of an inverse that are held at a time."""
_TINY_DAMPING = 1e-10
"""Of covariances: unknowns without information get a large variance instead of an infinite one."""


@dataclass(frozen=True)
class DenseCholesky:
    """A dense Cholesky factor (B b, B b), lower; free: (B, b) bool."""

    lower: np.ndarray
    free: np.ndarray

    def solve(self, right: np.ndarray) -> np.ndarray:
        """The solution (B b, n) for right sides (B b, n); zero for unknowns that are not free.

        right: (B b, n) float64
        """
        right = np.where(self.free.reshape(-1, 1), right, 0.0)
        return np.asarray(cho_solve((self.lower, True), right, check_finite=False))

    def inverse_blocks(self) -> np.ndarray:
        """The diagonal blocks (B, b, b) of the inverse; zero for unknowns that are not free."""
        count, size = self.free.shape
        whole, _ = lapack.dpotri(self.lower, lower=True)
        here = np.arange(count)
        blocks = whole.reshape(count, size, count, size)[here, :, here]
        blocks = np.tril(blocks) + np.swapaxes(np.tril(blocks, -1), 1, 2)
        return np.where(self.free[:, :, None] & self.free[:, None], blocks, 0.0)


@dataclass(frozen=True)
class SparseFactor:
    """Sparse LU factors over the unknowns `index` of blocks of `shape` (B, b)."""

    lu: SuperLU
    index: np.ndarray
    shape: tuple[int, ...]

    def solve(self, right: np.ndarray) -> np.ndarray:
        """The solution (B b, n) for right sides (B b, n); zero for unknowns that are not in `index`.

        right: (B b, n) float64
        """
        solution = np.zeros_like(right)
        solution[self.index] = self.lu.solve(np.ascontiguousarray(right[self.index]))
        return solution

    def inverse_blocks(self) -> np.ndarray:
        """The diagonal blocks (B, b, b) of the inverse, from its columns."""
        count, size = self.shape
        blocks = np.zeros((count, size, size))
        free = np.zeros(count * size, bool)
        free[self.index] = True
        for block in range(count):
            mine = slice(size * block, size * block + size)
            unit = np.zeros((count * size, size))
            unit[mine] = np.diag(free[mine].astype(float))
            blocks[block] = self.solve(unit)[mine]
        return blocks


@dataclass(frozen=True)
class Covariance:
    """Of all unknowns: diagonal blocks, and with the shared parameters.

    blocks: (B, b, b); with_shared: (B, b, k); shared: (k, k). Zero for unknowns that are held.
    """

    blocks: np.ndarray
    with_shared: np.ndarray
    shared: np.ndarray

    def given(self, index: Indices) -> np.ndarray:
        """(B, b, b): the blocks, were some of the shared parameters (n,) known."""
        cross = self.with_shared[..., index]
        explained = np.linalg.pinv(self.shared[np.ix_(index, index)], hermitian=True)
        return np.asarray(self.blocks - cross @ explained @ np.swapaxes(cross, 1, 2))


@dataclass(frozen=True)
class Factors:
    """A Hessian `[[poses, C], [C^T, S]]` in factors.

    poses: of the blocks of unknowns; through: (B b, k), their inverse times C; rest: (k, k) lower Cholesky factor of what
    is left of S without what the poses explain; free: (k,) bool, of the shared parameters
    """

    poses: DenseCholesky | BandedCholesky | SparseFactor
    through: np.ndarray
    rest: np.ndarray
    free: np.ndarray

    def solve(self, right: np.ndarray) -> np.ndarray:
        """The solution (B b + k, n) for right sides (B b + k, n); zero for unknowns that are held.

        right: (B b + k, n) float64
        """
        count = len(self.through)
        blocks = self.poses.solve(right[:count])
        if not len(self.rest):
            return blocks
        # C^T H^-1 r is through^T r: H is symmetric
        shared = np.where(self.free[:, None], right[count:] - self.through.T @ right[:count], 0.0)
        shared = cho_solve((self.rest, True), shared, check_finite=False)
        return np.concatenate([blocks - self.through @ shared, shared])

    def shared_covariance(self) -> np.ndarray:
        """(k, k), the inverse's block of the shared parameters alone."""
        unit = np.diag(self.free.astype(float))
        return np.asarray(cho_solve((self.rest, True), unit, check_finite=False))

    def covariance(self) -> Covariance:
        """Blocks of the inverse, without the inverse as a whole."""
        blocks = self.poses.inverse_blocks()
        count, size, _ = blocks.shape
        shared = self.shared_covariance()
        through = self.through.reshape(count, size, len(shared))
        with_shared = -through @ shared
        return Covariance(blocks - with_shared @ np.swapaxes(through, 1, 2), with_shared, shared)


def solve_step(
    equations: NormalEquations,
    damping: float,
    free: np.ndarray | None = None,
    dense_limit: int = 2500,
    metric: np.ndarray | None = None,
) -> Step | None:
    """The damped step, `-(H + damping D)^-1 g` over the free unknowns; None where that matrix is not positive.

    free: (B, b) bool; unknowns that are not free do not move. None: all are.
    dense_limit: most unknowns for which a sparse pattern is solved by dense Cholesky
    metric: (b,) float64, the diagonal of D for every block, absolute: what one unit of damping adds; None: the diagonal
    of H.
        That of shared parameters is always the diagonal of H
    """
    factors = factorize(equations, damping, free, dense_limit, metric)
    if factors is None:
        return None
    count, size = equations.gradient.shape
    gradient = equations.gradient.ravel()
    if equations.border is not None:
        gradient = np.concatenate([gradient, equations.border.gradient])
    step = -factors.solve(gradient[:, None])[:, 0]
    if not np.all(np.isfinite(step)):
        return None
    return Step(step[: count * size].reshape(count, size), step[count * size :])


def factorize(
    equations: NormalEquations,
    damping: float,
    free: np.ndarray | None = None,
    dense_limit: int = 2500,
    metric: np.ndarray | None = None,
) -> Factors | None:
    """The factors of `H + damping D`; None where the matrix is not positive. Arguments as in `solve_step`.

    free: (B, b) bool; metric: (b,) float64
    """
    free = np.ones(equations.gradient.shape, bool) if free is None else free
    added, added_shared = damped_diagonal(equations, damping, free, metric)
    dense = _is_dense(equations, int(free.sum()), dense_limit)
    poses = _dense(equations, added, free) if dense else _sparse(equations, added, free)
    if poses is None:
        return None
    if equations.border is None:
        return Factors(poses, np.zeros((free.size, 0)), np.zeros((0, 0)), np.zeros(0, bool))
    own = equations.border.free
    coupling = equations.border.coupling.reshape(free.size, -1) * (free.reshape(-1, 1) & own)
    through = poses.solve(coupling)
    rest = equations.border.hessian * (own[:, None] & own) - coupling.T @ through
    rest[np.diag_indices_from(rest)] += np.where(own, added_shared, 1.0)
    try:
        lower, _ = cho_factor(rest, lower=True, check_finite=False)
    except np.linalg.LinAlgError:
        return None
    return Factors(poses, through, np.tril(lower), own)


def _is_dense(equations: NormalEquations, unknowns: int, limit: int) -> bool:
    blocks = len(equations.gradient)
    return unknowns <= limit or len(equations.rows) > _FULL * blocks * (blocks + 1) / 2


def _dense(equations: NormalEquations, added: np.ndarray, free: np.ndarray) -> DenseCholesky | None:
    count, size = free.shape
    blocks = np.zeros((count, size, count, size))
    blocks[equations.rows, :, equations.columns] = equations.blocks
    upper = blocks.reshape(count * size, count * size)
    held = np.flatnonzero(~free)
    upper[held], upper[:, held] = 0.0, 0.0
    upper[np.diag_indices_from(upper)] += np.where(free, added, 1.0).ravel()
    try:
        # the transpose of rows is columns, as LAPACK has it in memory: factored in place
        lower, _ = cho_factor(upper.T, lower=True, overwrite_a=True, check_finite=False)
    except np.linalg.LinAlgError:
        return None
    return DenseCholesky(lower, free)


def _sparse(
    equations: NormalEquations, added: np.ndarray, free: np.ndarray
) -> BandedCholesky | SparseFactor | None:
    """By a band where there is one, else sparse LU."""
    try:
        return banded_cholesky.factor(equations.rows, equations.columns, equations.blocks, added, free)
    except MemoryError:
        index = np.flatnonzero(free)
    matrix = equations.sparse()[: free.size, : free.size] + diags(added.ravel())
    try:
        lu = splu(
            matrix.tocsc()[index][:, index].tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            options={"SymmetricMode": True},
        )
    except RuntimeError:
        return None
    return SparseFactor(lu, index, added.shape)


def damped_diagonal(
    equations: NormalEquations, damping: float, free: np.ndarray, metric: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """(B, b) and (k,): what damping adds to the diagonal.

    Relative to a diagonal with a floor, so that unknowns without information are damped too.
    free: (B, b) bool; metric: (b,) float64
    """
    own = equations.rows == equations.columns
    diagonal = np.zeros(free.shape)
    diagonal[equations.rows[own]] = np.diagonal(equations.blocks[own], axis1=1, axis2=2)
    shared = np.zeros(0) if equations.border is None else np.diagonal(equations.border.hessian)
    largest = max(float(diagonal[free].max(initial=0.0)), float(shared.max(initial=0.0)), 1e-30)
    added = damping * np.maximum(diagonal, 1e-9 * largest)
    if metric is not None:
        added = np.broadcast_to(damping * metric, free.shape)
    return added, damping * np.maximum(shared, 1e-9 * largest)


def covariance(
    equations: NormalEquations, free: np.ndarray | None = None, dense_limit: int = 2500
) -> Covariance:
    """Blocks of the inverse Hessian over the free unknowns.

    Unknowns without information get a tiny damping instead of an infinite variance; unknowns held fixed get zero.
    free: (B, b) bool
    Raises LinAlgError: the Hessian is not positive.
    """
    return _undamped(equations, free, dense_limit).covariance()


def shared_covariance(
    equations: NormalEquations, free: np.ndarray | None = None, dense_limit: int = 2500
) -> np.ndarray:
    """(k, k): the block of the shared parameters of `covariance`, without the others.

    free: (B, b) bool
    Raises LinAlgError: the Hessian is not positive.
    """
    return _undamped(equations, free, dense_limit).shared_covariance()


def _undamped(equations: NormalEquations, free: np.ndarray | None, dense_limit: int) -> Factors:
    factors = factorize(equations, _TINY_DAMPING, free, dense_limit)
    if factors is None:
        raise np.linalg.LinAlgError("the normal equations are not positive")
    return factors


def propagated(
    equations: NormalEquations,
    jacobian: csr_matrix,
    free: np.ndarray | None = None,
    dense_limit: int = 2500,
) -> np.ndarray:
    """J H^-1 J^T, (m, m): the covariance of quantities with these derivatives (m, B b + k).

    free: (B, b) bool
    Raises LinAlgError: the Hessian is not positive.
    """
    factors = _undamped(equations, free, dense_limit)
    covariance = np.zeros((jacobian.shape[0],) * 2)
    for start in range(0, len(covariance), _COLUMNS):
        part = slice(start, start + _COLUMNS)
        covariance[:, part] = jacobian @ factors.solve(jacobian[part].toarray().T)
    return covariance


def sandwich(
    equations: NormalEquations,
    gradients: csr_matrix,
    spread: NormalEquations | None,
    free: np.ndarray | None = None,
    dense_limit: int = 2500,
) -> Covariance:
    """Blocks of H^-1 M H^-1 with M = G^T G + P.

    gradients: (W, B b + k), G; spread: its Hessian is P; None: zero. M couples what H does not, so selected inversion
    does not do: columns of the inverse are made some at a time, never all of them.
    free: (B, b) bool
    Raises LinAlgError: the Hessian is not positive.
    """
    factors = _undamped(equations, free, dense_limit)
    count, size = equations.gradient.shape
    middle = _middle(gradients, spread)
    unknowns, k = count * size, equations.shared
    own, with_shared = np.zeros((count, size, size)), np.zeros((count, size, k))
    shared = _columns(factors, unknowns + k, unknowns, unknowns + k)
    shared_pull, shared_middle = gradients @ shared, middle @ shared
    per = max(_COLUMNS // size, 1)
    for start in range(0, count, per):
        stop = min(start + per, count)
        piece = _columns(factors, unknowns + k, start * size, stop * size)
        here = stop - start
        pull, each, through = (
            np.ascontiguousarray(part.reshape(-1, here, size).transpose(1, 2, 0))
            for part in (gradients @ piece, piece, middle @ piece)
        )
        own[start:stop] = pull @ np.swapaxes(pull, 1, 2) + each @ np.swapaxes(through, 1, 2)
        with_shared[start:stop] = pull @ shared_pull + each @ shared_middle
    return Covariance(own, with_shared, shared_pull.T @ shared_pull + shared.T @ shared_middle)


def with_errors_of_shared(
    known: Covariance, more: np.ndarray, plain: Covariance, index: np.ndarray
) -> Covariance:
    """The covariance, with how far all would move by errors of some shared parameters that it does not have.

    more: (k, k) float64, covariance of the shared parameters beyond that in `known`; where it is less, nothing changes
    plain: inverse of the information, by which all else follows these; index: (n,) int64, which they are
    """
    index = index[np.diagonal(plain.shared)[index] > 0]
    own = np.ix_(index, index)
    values, axes = np.linalg.eigh(more[own])
    errors = (axes * np.maximum(values, 0.0)) @ axes.T
    by_errors = np.linalg.inv(plain.shared[own])
    return with_errors(
        known, plain.with_shared[..., index] @ by_errors, plain.shared[:, index] @ by_errors, errors
    )


def with_errors(known: Covariance, blocks: np.ndarray, shared: np.ndarray, moments: np.ndarray) -> Covariance:
    """The covariance, with m errors that it does not have.

    blocks: (B, b, m) float64, how far the blocks of unknowns move by a unit of each; shared: (k, m) float64, how far the
        shared parameters do; moments: (m, m) float64, second moments of the errors
    """
    return Covariance(
        known.blocks + blocks @ moments @ np.swapaxes(blocks, 1, 2),
        known.with_shared + blocks @ moments @ shared.T,
        known.shared + shared @ moments @ shared.T,
    )


def shared_sandwich(
    equations: NormalEquations,
    gradients: csr_matrix,
    spread: NormalEquations | None,
    free: np.ndarray | None = None,
    dense_limit: int = 2500,
) -> np.ndarray:
    """(k, k): the block of the shared parameters of `sandwich` alone, which takes as many columns of the inverse.

    free: (B, b) bool; other arguments and errors as of `sandwich`
    """
    factors, size = _undamped(equations, free, dense_limit), gradients.shape[1]
    shared = _columns(factors, size, size - equations.shared, size)
    pull = gradients @ shared
    return np.asarray(pull.T @ pull + shared.T @ (_middle(gradients, spread) @ shared))


def _middle(gradients: csr_matrix, spread: NormalEquations | None) -> csc_matrix:
    """P of `sandwich`, (B b + k, B b + k)."""
    return csc_matrix((gradients.shape[1],) * 2) if spread is None else spread.sparse()


def _columns(factors: Factors, size: int, first: int, last: int) -> np.ndarray:
    """Columns from `first` to before `last` of the inverse, which is `size` wide, (size, last - first)."""
    unit = np.zeros((size, last - first))
    unit[np.arange(first, last), np.arange(last - first)] = 1.0
    return factors.solve(unit)
