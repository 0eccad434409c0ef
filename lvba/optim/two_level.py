"""Normal equations of very many poses, at two levels: groups of successive poses, and the poses within each.

Where everything sees everything, all pairs of B poses are coupled: B^2 / 2 blocks, and a factor that takes the cube. Here
a group of successive poses moves as a rigid body, and within a group poses move in all ways that its common motion does
not have. What is kept is the coupling within groups, pose by pose, and between groups, body by body. A step is the sum
of both solutions. The gradient is that of all poses: where it vanishes the step does, so rounds of such steps end where
those of the whole Hessian end; only their way there differs. Poses that see the same surfaces are coupled to all others
alike, so that what is left out (bending of one group against bending of another) is little. Along a path whose poses see
few others it is not: there all pairs are a band, which has factors of its own.

Source: aggregation with an additive Schwarz method (Toselli and Widlund 2005, chapter 3); groups as in Liu et al. 2023
(HBA).
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from lvba import geometry
from lvba.arrays import PoseBlocks, Poses
from lvba.optim import linear_solver, normal_equations
from lvba.optim.linear_solver import Covariance, Factors
from lvba.optim.normal_equations import NormalEquations, Step


@dataclass(frozen=True)
class Groups:
    """Successive poses that move as one.

    size: poses of a group; the last group may have fewer
    motion: (B, 6, 6) float64, the step of each pose when its group's first pose takes one and the group is a rigid body;
        zero for poses that are held
    """

    size: int
    motion: np.ndarray

    @property
    def number(self) -> np.ndarray:
        """(B,) int64: the group of each pose."""
        return np.arange(len(self.motion)) // self.size

    @property
    def count(self) -> int:
        """How many groups there are."""
        return -(-len(self.motion) // self.size)

    def projected(self, projector: PoseBlocks) -> "Groups":
        """The same groups, without the motions that a projector (B, 6, 6) takes out of each pose's."""
        return replace(self, motion=projector @ self.motion)


def groups_of(world_from_pose: Poses, size: int) -> Groups:
    """Groups of `size` successive poses (B, 4, 4), of which the very first is held."""
    first = np.arange(len(world_from_pose)) // size * size
    motion = geometry.adjoint(geometry.inverse(world_from_pose) @ world_from_pose[first])
    motion[0] = 0.0
    return Groups(size, motion)


@dataclass(frozen=True)
class TwoLevelEquations:
    """A cost linearized at a state, at two levels. Terms add with `+`.

    inner: over all poses: pairs of poses of one group, all of the gradient and the cost
    bodies: over groups, by steps of their first poses: pairs of different groups, neither gradient nor cost
    """

    groups: Groups
    inner: NormalEquations
    bodies: NormalEquations

    def __add__(self, other: "TwoLevelEquations") -> "TwoLevelEquations":
        """The sum of two terms over the same groups."""
        return replace(self, inner=self.inner + other.inner, bodies=self.bodies + other.bodies)

    @property
    def gradient(self) -> np.ndarray:
        """(B, 6) float64, of all poses."""
        return self.inner.gradient

    def diagonal_blocks(self) -> np.ndarray:
        """(B, 6, 6) float64."""
        return self.inner.diagonal_blocks()


def split(equations: NormalEquations, groups: Groups) -> TwoLevelEquations:
    """Normal equations of all pairs of poses at two levels."""
    number = groups.number
    same = number[equations.rows] == number[equations.columns]
    rows, columns = equations.rows[~same], equations.columns[~same]
    bodies = normal_equations.from_blocks(
        number[rows],
        number[columns],
        np.swapaxes(groups.motion[rows], 1, 2) @ equations.blocks[~same] @ groups.motion[columns],
        np.zeros((groups.count, 6)),
        0.0,
    )
    inner = replace(
        equations,
        rows=equations.rows[same],
        columns=equations.columns[same],
        blocks=equations.blocks[same],
    )
    return TwoLevelEquations(groups, inner, bodies)


@dataclass(frozen=True)
class TwoLevelFactors:
    """What solves at two levels.

    bodies: of the groups' motions; within: a symmetric matrix for each group, over all unknowns of its poses, which takes
    a right side to the motions within the group
    """

    groups: Groups
    bodies: Factors
    within: tuple[np.ndarray, ...]

    def solve(self, right: np.ndarray) -> np.ndarray:
        """The solution (6 B, n) for right sides (6 B, n); zero for unknowns that are held.

        right: (6 B, n) float64
        """
        groups, poses = self.groups, len(self.groups.motion)
        each = right.reshape(poses, 6, -1)
        pull = np.zeros((groups.count, 6, each.shape[2]))
        np.add.at(pull, groups.number, np.swapaxes(groups.motion, 1, 2) @ each)
        moved = self.bodies.solve(pull.reshape(6 * groups.count, -1)).reshape(pull.shape)
        solution = np.asarray((groups.motion @ moved[groups.number]).reshape(right.shape))
        for number, inverse in enumerate(self.within):
            mine = slice(6 * groups.size * number, 6 * groups.size * number + len(inverse))
            solution[mine] += inverse @ right[mine]
        return solution

    def covariance(self) -> Covariance:
        """Diagonal blocks of what `solve` multiplies with; there are no shared parameters."""
        groups = self.groups
        bodies = self.bodies.covariance().blocks[groups.number]
        blocks = groups.motion @ bodies @ np.swapaxes(groups.motion, 1, 2)
        for number, inverse in enumerate(self.within):
            first, count = groups.size * number, len(inverse) // 6
            here = np.arange(count)
            blocks[first : first + count] += inverse.reshape(count, 6, count, 6)[here, :, here]
        return Covariance(blocks, np.zeros((len(blocks), 6, 0)), np.zeros((0, 0)))


def factorize(
    equations: TwoLevelEquations,
    damping: float,
    free: np.ndarray | None = None,
    metric: np.ndarray | None = None,
) -> TwoLevelFactors | None:
    """The factors of the damped equations; None where they are not positive. Arguments as in `linear_solver`.

    free: (B, 6) bool, false for the poses that the groups hold; metric: (6,) float64
    """
    groups = equations.groups
    free = np.ones(equations.gradient.shape, bool) if free is None else free
    added, _ = linear_solver.damped_diagonal(equations.inner, damping, free, metric)
    here = np.arange(len(added), dtype=np.int32)
    own = NormalEquations(
        rows=here, columns=here, blocks=added[:, :, None] * np.eye(6), gradient=np.zeros_like(added), cost=0.0
    )
    inner = equations.inner + own
    factors = linear_solver.factorize(_folded(inner, groups) + equations.bodies, 0.0)
    if factors is None:
        return None
    try:
        within = tuple(_within(inner, groups, number, free) for number in range(groups.count))
    except np.linalg.LinAlgError:
        return None
    return TwoLevelFactors(groups, factors, within)


def _folded(inner: NormalEquations, groups: Groups) -> NormalEquations:
    """What the pairs within groups say of the groups' motions, each coupled to itself."""
    left = np.swapaxes(groups.motion[inner.rows], 1, 2)
    blocks = left @ inner.blocks @ groups.motion[inner.columns]
    off = inner.rows != inner.columns
    blocks[off] += np.swapaxes(blocks[off], 1, 2)
    number = groups.number[inner.rows]
    return normal_equations.from_blocks(number, number, blocks, np.zeros((groups.count, 6)), 0.0)


def _within(inner: NormalEquations, groups: Groups, number: int, free: np.ndarray) -> np.ndarray:
    """The inverse of a group's own matrix A over the motions that are orthogonal, in A, to its motion as a body:
    A^-1 - M (M' A M)^-1 M'.
    """
    first = groups.size * number
    count = min(groups.size, len(groups.motion) - first)
    begin, end = np.searchsorted(inner.rows, [first, first + count])
    rows, columns, blocks = (each[begin:end] for each in (inner.rows, inner.columns, inner.blocks))
    whole = np.zeros((count, 6, count, 6))
    whole[rows - first, :, columns - first] = blocks
    whole[columns - first, :, rows - first] = np.swapaxes(blocks, 1, 2)
    matrix = whole.reshape(6 * count, 6 * count)
    moves = free[first : first + count].ravel()
    matrix[~moves], matrix[:, ~moves] = 0.0, 0.0
    matrix[~moves, ~moves] = 1.0
    inverse = cho_solve(cho_factor(matrix, check_finite=False), np.diag(moves * 1.0), check_finite=False)
    motion = groups.motion[first : first + count].reshape(-1, 6)
    common = cho_factor(motion.T @ matrix @ motion, check_finite=False)
    return np.asarray(inverse - motion @ cho_solve(common, motion.T, check_finite=False))


def solve_step(
    equations: TwoLevelEquations,
    damping: float,
    free: np.ndarray | None = None,
    metric: np.ndarray | None = None,
) -> Step | None:
    """The damped step over the free unknowns; None where the equations are not positive. Arguments as in `factorize`.

    free: (B, 6) bool; metric: (6,) float64
    """
    factors = factorize(equations, damping, free, metric)
    if factors is None:
        return None
    step = -factors.solve(equations.gradient.reshape(-1, 1))
    return Step(step.reshape(equations.gradient.shape), np.zeros(0)) if np.all(np.isfinite(step)) else None
