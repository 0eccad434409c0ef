"""Sparse pose graph on SE(3): many nodes, measured relative poses between them, and loop edges that may be false.

Which loop edges are used is decided as a whole: of all sets of loop edges, the one that leaves the least
`cost(set) + gate * refused`, where cost is that of odometry and used loops together after the poses have given way. A
refused edge has no effect at all, a used one its full weight. Weights that look at an edge's own residual alone (Huber,
dynamic covariance scaling, graduated non-convexity) do not do here: odometry is soft over a long way and loops are stiff,
so the poses bend to any single false loop, whose residual is then nothing.
Source of the joint test: Neira and Tardos 2001, "Data association in stochastic mapping using the joint compatibility
test"; Latif et al. 2013 (RRR) for testing loops against the odometry's covariance.
"""

import logging
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components

from lvba import geometry
from lvba.arrays import Pose, PoseBlocks, Poses, Tangents
from lvba.errors import DegenerateProblemError
from lvba.optim import levenberg_marquardt, linear_solver, loop_selection, normal_equations
from lvba.optim.levenberg_marquardt import SolverConfig
from lvba.optim.loop_selection import Choice
from lvba.optim.normal_equations import NormalEquations, Step
from lvba.settings import check_ranges

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Edges:
    """E measured relative poses.

    first, second: (E,) int64, nodes
    first_from_second: (E, 4, 4) float64
    information: (E, 6, 6) float64, inverse covariance of the local tangent [rotation | translation] at the second node;
        directions without information are allowed in loop edges
    is_loop: (E,) bool: may be false, and is then refused
    """

    first: np.ndarray
    second: np.ndarray
    first_from_second: np.ndarray
    information: np.ndarray
    is_loop: np.ndarray

    def __len__(self) -> int:
        return len(self.first)

    def take(self, index: np.ndarray) -> "Edges":
        """The edges at `index` (any numpy index).

        index: (N,) integers, or (E,) bool
        """
        return Edges(
            self.first[index],
            self.second[index],
            self.first_from_second[index],
            self.information[index],
            self.is_loop[index],
        )


def information_of(covariance: PoseBlocks) -> np.ndarray:
    """Inverses (E, 6, 6) of covariances (E, 6, 6), symmetric to the last bit."""
    inverse = np.linalg.inv(covariance)
    return np.asarray(0.5 * (inverse + np.swapaxes(inverse, -1, -2)))


def concatenate(parts: list[Edges]) -> Edges:
    """The edges of all parts, in order."""
    return Edges(
        np.concatenate([part.first for part in parts]),
        np.concatenate([part.second for part in parts]),
        np.concatenate([part.first_from_second for part in parts]),
        np.concatenate([part.information for part in parts]),
        np.concatenate([part.is_loop for part in parts]),
    )


@dataclass(frozen=True)
class PoseGraphConfig:
    """How a pose graph is solved and when a loop edge is refused."""

    gate: float = 22.46
    """Largest squared error over its variance that one more loop may cost; 22.46 is passed by 99.9 % of the true ones
    (chi square of 6); 1 to 1000."""
    odometry_variance_factor: float = 3.0
    """How many times larger than they say the errors of the other edges may be, when a loop is judged: errors of
    neighbors go together, and a true loop that is refused costs more than the wider gate; 1 to 100."""
    margin: float = 6.0
    """Sets of loops that contradict each other, and differ by less than this in cost, are both refused; 0 to 100."""
    solver: SolverConfig = field(
        # damping relative to the diagonal would hold the slow common motions that close a loop
        default_factory=lambda: SolverConfig(
            max_iterations=50,
            initial_damping=1e-12,
            relative_decrease=1e-9,
            step_tolerance=1e-8,
            dense_limit=600,
        )
    )
    """Of the steps."""

    def __post_init__(self) -> None:
        check_ranges(
            self,
            "pose_graph",
            gate=(1, 1000),
            odometry_variance_factor=(1, 100),
            margin=(0, 100),
        )


@dataclass(frozen=True)
class PoseGraph:
    """Poses at which the edges agree best.

    world_from_node: (N, 4, 4) float64; the fixed node stays
    loop_weight: (E,) float64, 1 used, 0 refused; 1 for edges that are no loops
    residual_before, residual_after: (E, 6) float64, rad and m, at the given and at the solved poses
    loop_distance: (E,) float64, squared error over its variance that the edge costs beside the used loops, with the
        poses giving way (6 is expected of a true one); NaN for edges that are no loops
    loop_reason: E sentences; empty for edges that are no loops
    cost_before, cost_after: half the squared errors over variances, of the edges that are used
    converged: False: the last step still moved poses
    """

    world_from_node: np.ndarray
    loop_weight: np.ndarray
    residual_before: np.ndarray
    residual_after: np.ndarray
    loop_distance: np.ndarray
    loop_reason: tuple[str, ...]
    cost_before: float
    cost_after: float
    converged: bool


def solve(
    world_from_node: Poses, edges: Edges, *, fixed: int = 0, config: PoseGraphConfig = PoseGraphConfig()
) -> PoseGraph:
    """The poses of least squared error, with loop edges that fit together.

    world_from_node: (N, 4, 4), first guess; node `fixed` stays
    Raises DegenerateProblemError: edges that are no loops do not connect all nodes.
    """
    start = np.array(world_from_node, float)
    odometry, loops = edges.take(~edges.is_loop), edges.take(edges.is_loop)
    _check_connected(len(start), odometry)
    poses, converged = _optimize(start, odometry, fixed, config)
    choice = Choice.none(len(loops))
    for _ in range(_TURNS if len(loops) else 0):
        solution = _judge(poses, odometry, loops, fixed, config)
        if np.array_equal(solution.used, choice.used):
            choice = solution
            break
        choice = solution
        used = concatenate([odometry, loops.take(choice.used)])
        poses, converged = _optimize(poses, used, fixed, config)
        logger.info("pose graph: %d of %d loops used", np.count_nonzero(choice.used), len(loops))
    return _result(start, poses, edges, choice, converged)


_TURNS = 10
"""Most rounds of choosing loops at the poses that the chosen ones lead to."""


def residuals(world_from_node: Poses, edges: Edges) -> np.ndarray:
    """`log(measured^-1 . relative pose)`, (E, 6), rad and m, tangent at the second node."""
    relative = geometry.inverse(world_from_node[edges.first]) @ world_from_node[edges.second]
    return np.asarray(geometry.log(geometry.inverse(edges.first_from_second) @ relative))


def jacobians(world_from_node: Poses, edges: Edges, error: Tangents) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives (E, 6, 6) of the residuals by the first and the second node's right perturbation.

    error: (E, 6), `residuals` there
    """
    by_second = _inverse_right_jacobian(error)
    second_from_first = geometry.inverse(world_from_node[edges.second]) @ world_from_node[edges.first]
    return -by_second @ geometry.adjoint(second_from_first), by_second


def linearize(world_from_node: Poses, edges: Edges) -> NormalEquations:
    """Normal equations of half the squared errors over their variances; every edge counts in full."""
    error = residuals(world_from_node, edges)
    by_first, by_second = jacobians(world_from_node, edges, error)
    pull = np.einsum("eij,ej->ei", edges.information, error)
    first_t, second_t = np.swapaxes(by_first, -1, -2), np.swapaxes(by_second, -1, -2)
    gradient = np.zeros((len(world_from_node), 6))
    np.add.at(gradient, edges.first, np.einsum("eij,ej->ei", first_t, pull))
    np.add.at(gradient, edges.second, np.einsum("eij,ej->ei", second_t, pull))
    weighted_first, weighted_second = edges.information @ by_first, edges.information @ by_second
    return normal_equations.from_blocks(
        np.concatenate([edges.first, edges.second, edges.first]),
        np.concatenate([edges.first, edges.second, edges.second]),
        np.concatenate([first_t @ weighted_first, second_t @ weighted_second, first_t @ weighted_second]),
        gradient,
        cost(error, edges),
    )


def cost(error: Tangents, edges: Edges) -> float:
    """Half the squared residuals (E, 6) over their variances."""
    return 0.5 * float(np.einsum("ei,eij,ej->", error, edges.information, error))


def propagate(count: int, edges: Edges, root: int, world_from_root: Pose) -> np.ndarray:
    """Poses (count, 4, 4) of all nodes from that of one, along the fewest edges that are no loops.

    Raises DegenerateProblemError: these do not connect all nodes.
    """
    chain = edges.take(~edges.is_loop)
    _check_connected(count, chain)
    order, before = breadth_first_order(_adjacency(count, chain), root, directed=False)
    edge_of = {(int(a), int(b)): e for e, (a, b) in enumerate(zip(chain.first, chain.second, strict=True))}
    second_from_first = geometry.inverse(chain.first_from_second)
    poses = np.zeros((count, 4, 4))
    poses[root] = world_from_root
    for node in order[1:].tolist():
        near = int(before[node])
        forward = edge_of.get((near, node))
        step = (
            chain.first_from_second[forward]
            if forward is not None
            else second_from_first[edge_of[node, near]]
        )
        poses[node] = poses[near] @ step
    poses = geometry.orthonormalize(poses)
    poses[root] = world_from_root  # to the last bit
    return poses


def _adjacency(count: int, edges: Edges) -> coo_matrix:
    return coo_matrix((np.ones(len(edges)), (edges.first, edges.second)), shape=(count, count)).tocsr()


def _check_connected(count: int, odometry: Edges) -> None:
    pieces, label = connected_components(_adjacency(count, odometry), directed=False)
    if pieces > 1:
        apart = int(np.flatnonzero(label != label[0])[0])
        raise DegenerateProblemError(
            f"no measured motion connects pose 0 with pose {apart}: the parts do not overlap"
        )


def _free(count: int, fixed: int) -> np.ndarray:
    free = np.ones((count, 6), bool)
    free[fixed] = False
    return free


def _optimize(
    poses: np.ndarray, edges: Edges, fixed: int, config: PoseGraphConfig
) -> tuple[np.ndarray, bool]:
    """Poses of least squares, all edges in full, and whether they stand still."""

    def moved(at: np.ndarray, step: Step) -> np.ndarray:
        there = geometry.retract(at, step.blocks)
        there[fixed] = poses[fixed]  # to the last bit
        return there

    free = _free(len(poses), fixed)
    minimum = levenberg_marquardt.levenberg_marquardt(
        poses, lambda at: linearize(at, edges), moved, config.solver, free
    )
    return minimum.state, minimum.converged


def _judge(poses: np.ndarray, odometry: Edges, loops: Edges, fixed: int, config: PoseGraphConfig) -> Choice:
    """Which loops fit the odometry and each other, to first order around the poses."""
    soft = replace(odometry, information=odometry.information / config.odometry_variance_factor**2)
    equations = linearize(poses, soft)
    free = _free(len(poses), fixed)
    back = linear_solver.solve_step(equations, 0.0, free, config.solver.dense_limit)
    if back is None:
        raise DegenerateProblemError("the measured motions leave poses open")
    error = residuals(poses, loops)
    by_first, by_second = jacobians(poses, loops, error)
    moves = _times(by_first, back.blocks[loops.first]) + _times(by_second, back.blocks[loops.second])
    covariance = linear_solver.propagated(
        equations, _derivative(loops, by_first, by_second, len(poses)), free, config.solver.dense_limit
    )
    return loop_selection.choose(error + moves, covariance, loops.information, config.gate, config.margin)


def _derivative(edges: Edges, by_first: np.ndarray, by_second: np.ndarray, nodes: int) -> csr_matrix:
    """Of all residuals by all nodes, (6 E, 6 N)."""
    shape = (len(edges), 6, 6)
    here = np.arange(6)
    rows = np.broadcast_to(6 * np.arange(len(edges))[:, None, None] + here[:, None], shape).ravel()
    columns = [
        np.broadcast_to(6 * node[:, None, None] + here, shape).ravel() for node in (edges.first, edges.second)
    ]
    values = np.concatenate([by_first.ravel(), by_second.ravel()])
    return csr_matrix(
        (values, (np.tile(rows, 2), np.concatenate(columns))), shape=(6 * len(edges), 6 * nodes)
    )


def _times(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    return np.asarray(np.einsum("eij,ej->ei", matrix, vector))


def _result(start: np.ndarray, poses: np.ndarray, edges: Edges, choice: Choice, converged: bool) -> PoseGraph:
    loop = np.flatnonzero(edges.is_loop)
    weight, distance, reason = np.ones(len(edges)), np.full(len(edges), np.nan), [""] * len(edges)
    weight[loop], distance[loop] = choice.used, choice.distance
    for edge, why in zip(loop, choice.reason, strict=True):
        reason[edge] = why
    before, after = residuals(start, edges), residuals(poses, edges)
    used = replace(edges, information=weight[:, None, None] * edges.information)
    costs = [cost(residual, used) for residual in (before, after)]
    return PoseGraph(
        world_from_node=poses,
        loop_weight=weight,
        residual_before=before,
        residual_after=after,
        loop_distance=distance,
        loop_reason=tuple(reason),
        cost_before=costs[0],
        cost_after=costs[1],
        converged=converged,
    )


def _inverse_right_jacobian(tangent: np.ndarray) -> np.ndarray:
    """(..., 6, 6): `log(exp(t) exp(d)) = t + J d` to first order; series in ad(t), good for rotations below pi.

    Source: Sola et al. 2018, section III; coefficients are Bernoulli numbers over factorials.
    """
    ad = np.zeros((*tangent.shape[:-1], 6, 6))
    ad[..., :3, :3] = ad[..., 3:, 3:] = geometry.hat(tangent[..., :3])
    ad[..., 3:, :3] = geometry.hat(tangent[..., 3:])
    square = ad @ ad
    power, total = np.broadcast_to(np.eye(6), ad.shape), np.eye(6) + 0.5 * ad
    for coefficient in (1 / 12, -1 / 720, 1 / 30240, -1 / 1209600, 1 / 47900160):
        power = power @ square
        total = total + coefficient * power
    return np.asarray(total)
