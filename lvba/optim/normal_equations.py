"""Block-sparse normal equations that add up: what every term of a cost, LiDAR or visual, is linearized to.

A term is half the sum of its squared normalized residuals. Its unknowns are increments as in `lvba.geometry`: a pose
takes six, [rotation | translation] on its right side.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import bsr_matrix, csc_matrix

from lvba.kernels.plane_offsets import add_blocks


@dataclass(frozen=True)
class NormalEquations:
    """A cost linearized at a state: `cost + gradient . d + d . hessian . d / 2`, d (B, b) the step. Terms add with `+`.

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

    def projected(self, jacobian: np.ndarray) -> "NormalEquations":
        """The same equations by other unknowns d', d = J d' for each block; (B, b, b') float64.

        A projector J takes out what the equations say about the directions that it removes. An adjoint carries poses of
        one sensor to those of another that it is fixed to.
        """
        left = np.swapaxes(jacobian, -1, -2)
        gradient = np.einsum("nij,nj->ni", left, self.gradient)
        size = self.gradient.shape[1]
        square = jacobian.shape[-1] == size
        changed = np.any(jacobian != np.eye(size), (1, 2)) if square else np.ones(len(jacobian), bool)
        at = np.flatnonzero(changed[self.rows] | changed[self.columns])
        rows, columns = self.rows[at], self.columns[at]
        found = left[rows] @ self.blocks[at] @ jacobian[columns]
        if len(at) < len(self.rows):
            blocks = self.blocks.copy()
            blocks[at] = found
            found = blocks
        return replace(self, blocks=found, gradient=gradient)

    def diagonal_blocks(self) -> np.ndarray:
        """(B, b, b) float64; zero where the pattern has none."""
        own = self.rows == self.columns
        found = np.zeros((*self.gradient.shape, self.gradient.shape[1]))
        found[self.rows[own]] = self.blocks[own]
        return found

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


def from_dense(hessian: np.ndarray, gradient: np.ndarray, cost: float) -> NormalEquations:
    """Normal equations of a whole symmetric Hessian (B b, B b) and a gradient (B, b): blocks of all pairs."""
    count, size = gradient.shape
    rows, columns = np.triu_indices(count)
    blocks = np.ascontiguousarray(hessian.reshape(count, size, count, size)[rows, :, columns])
    return NormalEquations(rows.astype(np.int32), columns.astype(np.int32), blocks, gradient, cost)


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
