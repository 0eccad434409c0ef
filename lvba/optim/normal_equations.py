"""Block-sparse normal equations that add up: what every term of a cost, LiDAR or visual, is linearized to.

A term is half the sum of its squared normalized residuals. Its unknowns are increments as in `lvba.geometry`: a pose
takes six, [rotation | translation] on its right side. What all poses share (an extrinsic, a time offset, intrinsics) is a
border of the Hessian beside the blocks of the poses: an arrow matrix. `optim.shared_parameters` names its columns.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import block_array, bsr_matrix, csc_matrix

from lvba.kernels.plane_offsets import add_blocks


@dataclass(frozen=True)
class Step:
    """A change of all unknowns. blocks: (B, b); shared: (k,), of the shared parameters, empty where there are none."""

    blocks: np.ndarray
    shared: np.ndarray

    @property
    def largest(self) -> float:
        """Largest change of an unknown."""
        return float(max(np.abs(each).max(initial=0.0) for each in (self.blocks, self.shared)))


@dataclass(frozen=True)
class Border:
    """What a term says of k shared parameters.

    coupling: (B, b, k) float64, the Hessian's blocks between each block of unknowns and the parameters
    hessian: (k, k) float64; gradient: (k,) float64; a parameter with zeros on the diagonal does not occur, and is held
    """

    coupling: np.ndarray
    hessian: np.ndarray
    gradient: np.ndarray

    def __add__(self, other: "Border") -> "Border":
        """The sum of two terms."""
        if self.coupling.shape != other.coupling.shape:
            raise ValueError(f"unknowns differ: {self.coupling.shape} and {other.coupling.shape}")
        return Border(
            self.coupling + other.coupling, self.hessian + other.hessian, self.gradient + other.gradient
        )

    @property
    def free(self) -> np.ndarray:
        """(k,) bool: the parameters that occur."""
        return np.diagonal(self.hessian) > 0.0


@dataclass(frozen=True)
class NormalEquations:
    """A cost linearized at a state: `cost + gradient . d + d . hessian . d / 2`, d (B, b) the step. Terms add with `+`.

    rows, columns: (M,) int32, block indices with rows <= columns, ascending by (row, column), no pair twice
    blocks: (M, b, b) float64; the lower triangle of the Hessian is the transpose of what is stored
    gradient: (B, b) float64
    cost: the value at the state
    eliminated: what unknowns that were eliminated lower the cost by when the others stay
    border: of the shared parameters; None: the term knows of none
    """

    rows: np.ndarray
    columns: np.ndarray
    blocks: np.ndarray
    gradient: np.ndarray
    cost: float
    eliminated: float = 0.0
    border: Border | None = None

    def __add__(self, other: "NormalEquations") -> "NormalEquations":
        """The sum of two parts over the same unknowns; patterns may differ."""
        if self.gradient.shape != other.gradient.shape:
            raise ValueError(f"unknowns differ: {self.gradient.shape} and {other.gradient.shape}")
        gradient, cost = self.gradient + other.gradient, self.cost + other.cost
        eliminated, border = self.eliminated + other.eliminated, _sum_of(self.border, other.border)
        if np.array_equal(self.rows, other.rows) and np.array_equal(self.columns, other.columns):
            blocks = self.blocks + other.blocks
            return NormalEquations(
                rows=self.rows,
                columns=self.columns,
                blocks=blocks,
                gradient=gradient,
                cost=cost,
                eliminated=eliminated,
                border=border,
            )
        both = [(each.rows, each.columns, each.blocks) for each in (self, other)]
        return replace(_summed(both, gradient, cost), eliminated=eliminated, border=border)

    def scaled(self, factor: float) -> "NormalEquations":
        """The same equations for `factor` times the cost."""
        border = self.border
        return replace(
            self,
            blocks=self.blocks * factor,
            gradient=self.gradient * factor,
            cost=self.cost * factor,
            eliminated=self.eliminated * factor,
            border=None
            if border is None
            else Border(border.coupling * factor, border.hessian * factor, border.gradient * factor),
        )

    def projected(self, jacobian: np.ndarray) -> "NormalEquations":
        """The same equations by other unknowns d', d = J d' for each block; (B, b, b') float64.

        A projector J takes out what the equations say about the directions that it removes. An adjoint carries poses of
        one sensor to those of another that it is fixed to.
        jacobian: (B, b, b') float64, J
        """
        left = np.swapaxes(jacobian, -1, -2)
        gradient = np.einsum("nij,nj->ni", left, self.gradient)
        size = self.gradient.shape[1]
        square = jacobian.shape[-1] == size
        changed = np.any(jacobian != np.eye(size), (1, 2)) if square else np.ones(len(jacobian), bool)
        at = np.flatnonzero(changed[self.rows] | changed[self.columns])
        rows, columns = self.rows[at], self.columns[at]
        products = left[rows] @ self.blocks[at] @ jacobian[columns]
        if len(at) < len(self.rows):
            blocks = self.blocks.copy()
            blocks[at] = products
            products = blocks
        border = None if self.border is None else replace(self.border, coupling=left @ self.border.coupling)
        return replace(self, blocks=products, gradient=gradient, border=border)

    def together(self, jacobian: np.ndarray) -> "NormalEquations":
        """The same equations for motions common to all blocks, as one block: d_i = J_i m; J (B, b, m) float64.

        jacobian: (B, b, m) float64, J
        """
        each = self.projected(jacobian)
        own = each.rows == each.columns
        off = each.blocks[~own].sum(axis=0)
        block = each.blocks[own].sum(axis=0) + off + off.T
        gradient = each.gradient.sum(axis=0, keepdims=True)
        border = None
        if each.border is not None:
            border = replace(each.border, coupling=each.border.coupling.sum(axis=0, keepdims=True))
        at = np.zeros(1, np.int32)
        return NormalEquations(
            rows=at,
            columns=at,
            blocks=block[None],
            gradient=gradient,
            cost=self.cost,
            eliminated=self.eliminated,
            border=border,
        )

    def predicted(self, step: Step) -> float:
        """By how much the quadratic model falls over a step, that of eliminated unknowns included."""
        product = np.einsum("mij,mj->mi", self.blocks, step.blocks[self.columns])
        quadratic = np.einsum("mi,mi->m", step.blocks[self.rows], product)
        double = np.where(self.rows == self.columns, 1.0, 2.0)
        fall = -float((self.gradient * step.blocks).sum()) - 0.5 * float((double * quadratic).sum())
        if self.border is not None:
            half = np.einsum("nik,ni->k", self.border.coupling, step.blocks)
            half += 0.5 * self.border.hessian @ step.shared
            fall -= float((self.border.gradient + half) @ step.shared)
        return fall + self.eliminated

    def diagonal_blocks(self) -> np.ndarray:
        """(B, b, b) float64; zero where the pattern has none."""
        own = self.rows == self.columns
        diagonal = np.zeros((*self.gradient.shape, self.gradient.shape[1]))
        diagonal[self.rows[own]] = self.blocks[own]
        return diagonal

    @property
    def shared(self) -> int:
        """How many numbers the shared parameters have, k."""
        return 0 if self.border is None else len(self.border.gradient)

    def dense(self) -> np.ndarray:
        """The whole Hessian, (B b + k, B b + k) float64, the shared parameters last."""
        count, size = self.gradient.shape
        full = np.zeros((count, size, count, size))
        full[self.rows, :, self.columns] = self.blocks
        full[self.columns, :, self.rows] = self.blocks.transpose(0, 2, 1)
        whole = full.reshape(count * size, count * size)
        if self.border is None:
            return whole
        coupling = self.border.coupling.reshape(count * size, -1)
        return np.block([[whole, coupling], [coupling.T, self.border.hessian]])

    def sparse(self) -> csc_matrix:
        """The whole Hessian, as `dense`, sparse."""
        count, size = self.gradient.shape
        off = self.rows != self.columns
        rows = np.concatenate([self.rows, self.columns[off]])
        columns = np.concatenate([self.columns, self.rows[off]])
        blocks = np.concatenate([self.blocks, self.blocks[off].transpose(0, 2, 1)])
        order = np.lexsort((columns, rows))
        starts = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=count))])
        shape = (count * size, count * size)
        upper = bsr_matrix((blocks[order], columns[order], starts), shape=shape)
        if self.border is None:
            return upper.tocsc()
        coupling = csc_matrix(self.border.coupling.reshape(count * size, -1))
        return block_array([[upper, coupling], [coupling.T, csc_matrix(self.border.hessian)]]).tocsc()


def _sum_of(first: Border | None, second: Border | None) -> Border | None:
    if first is None or second is None:
        return second if first is None else first
    return first + second


def empty(blocks: int, size: int, *, border: Border | None = None, cost: float = 0.0) -> NormalEquations:
    """Normal equations that say nothing about (B, b) unknowns, but for what their border says."""
    none = np.zeros(0, np.int32)
    gradient = np.zeros((blocks, size))
    return NormalEquations(
        rows=none, columns=none, blocks=np.zeros((0, size, size)), gradient=gradient, cost=cost, border=border
    )


def from_blocks(
    rows: np.ndarray,
    columns: np.ndarray,
    blocks: np.ndarray,
    gradient: np.ndarray,
    cost: float,
    border: Border | None = None,
) -> NormalEquations:
    """Normal equations of (M,) block indices in any order, repeated or below the diagonal, summed in that order.

    rows, columns: (M,) integers; blocks: (M, b, b) float64; gradient: (B, b) float64
    """
    return replace(_summed([(rows, columns, blocks)], gradient, cost), border=border)


def from_dense(hessian: np.ndarray, gradient: np.ndarray, cost: float) -> NormalEquations:
    """Normal equations of a whole symmetric Hessian (B b, B b) and a gradient (B, b): blocks of all pairs.

    hessian: (B b, B b) float64; gradient: (B, b) float64
    """
    count, size = gradient.shape
    rows, columns = np.triu_indices(count)
    blocks = np.ascontiguousarray(hessian.reshape(count, size, count, size)[rows, :, columns])
    return NormalEquations(
        rows=rows.astype(np.int32),
        columns=columns.astype(np.int32),
        blocks=blocks,
        gradient=gradient,
        cost=cost,
    )


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
        rows=(unique // count).astype(np.int32),
        columns=(unique % count).astype(np.int32),
        blocks=summed,
        gradient=gradient,
        cost=cost,
    )


def scattered(parts: Sequence[tuple[np.ndarray, NormalEquations]], count: int) -> NormalEquations:
    """The sum, in this order, of equations over some of `count` blocks of unknowns each.

    parts: (n,) which blocks, and the equations over these n
    """
    size = parts[0][1].gradient.shape[1]
    gradient = np.zeros((count, size))
    border: Border | None = None
    for index, equations in parts:
        gradient[index] += equations.gradient
        if equations.border is not None:
            coupling = np.zeros((count, size, equations.shared))
            coupling[index] = equations.border.coupling
            border = _sum_of(border, replace(equations.border, coupling=coupling))
    total = _summed(
        [(index[equations.rows], index[equations.columns], equations.blocks) for index, equations in parts],
        gradient,
        float(sum(equations.cost for _, equations in parts)),
    )
    return replace(total, border=border)
