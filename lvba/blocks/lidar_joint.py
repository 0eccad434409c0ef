"""One LiDAR bundle adjustment over all parts of a recording: their blocks add up, one sparse solve moves all scans.

The blocks' normal equations are those of the whole recording, so this is its solution, not an approximation by parts; the
memory of a block is that of its region. Where too many pairs of scans see the same planes, as in a compact place, steps
are solved at two levels (`optim.two_level`): the gradient is that of all scans, so rounds end at the same poses.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from lvba import geometry
from lvba.arrays import Poses
from lvba.blocks import lidar_block
from lvba.blocks.lidar_block import BlockEquations
from lvba.errors import DegenerateProblemError
from lvba.kernels.lidar import TILE
from lvba.lidar import degeneracy
from lvba.lidar.config import LidarConfig, Stage
from lvba.lidar.covariance import MAP_M
from lvba.lidar.degeneracy import DegenerateDirections
from lvba.lidar.dense_covariance import alignment
from lvba.lidar.odometry_factor import OdometryPrior, reestimated
from lvba.optim import levenberg_marquardt, linear_solver, two_level
from lvba.optim.normal_equations import NormalEquations
from lvba.optim.two_level import Groups, TwoLevelEquations, TwoLevelFactors

MOST_PAIRS = 200_000
"""Pairs of scans near each other up to which all of them are coupled: 58 MB, and three times that while block
equations add up."""
NEAR = 0.25
"""Part of all pairs of scans that are near each other above which more of them are not coupled. Along a street each scan
sees few others, and their number per scan stays: all pairs are a band, and steps at two levels converge slowly there."""
MOST_GROUPS = 600
"""Groups that are coupled to each other, 52 MB; a factor of them takes 104 MB."""


@dataclass(frozen=True)
class JointRound:
    """One association over all blocks and the step that followed it.

    cost: squared normalized residuals per point; moved: m, the furthest that a scan moved; refused: that it was to
    move, but did not; small: that it moved scans by less than poses that stand still may
    """

    stage: int
    planes: int
    observations: int
    cost: float
    sigma: float
    moved: float
    degenerate_scans: int
    refused: bool
    small: bool


@dataclass(frozen=True)
class JointState:
    """Where all scans are, and what the next round needs.

    world_from_scan: (S, 4, 4); prior: odometry; damping: of the next step
    converged_stage: the last stage whose poses stand still, -1: none
    group_size: scans of a group, where steps are solved at two levels; 0: they are not
    projector: (S, 6, 6), local tangent, what the planes determine, as the last round found; at two levels only, None: it
        is not known yet
    """

    world_from_scan: np.ndarray
    prior: OdometryPrior
    damping: float = 0.0
    converged_stage: int = -1
    history: tuple[JointRound, ...] = ()
    group_size: int = 0
    projector: np.ndarray | None = None

    @property
    def groups(self) -> Groups | None:
        """Of all scans, with the motions that planes determine; None: steps are not solved at two levels."""
        if not self.group_size:
            return None
        groups = two_level.groups_of(self.world_from_scan, self.group_size)
        return groups if self.projector is None else groups.projected(self.projector)


def group_size(world_from_scan: Poses, reach: float) -> int:
    """How many scans make a group; 0: so few scans, or so few of all, are near each other that all pairs are coupled.

    world_from_scan: (S, 4, 4); reach: m, of the LiDAR: scans twice as far apart see no plane in common
    """
    scans = len(world_from_scan)
    near = near_pairs(world_from_scan, reach)
    if near <= max(MOST_PAIRS, NEAR * scans * (scans + 1) / 2):
        return 0
    return TILE * -(-scans // (TILE * MOST_GROUPS))


def near_pairs(world_from_scan: Poses, reach: float) -> int:
    """Pairs of scans, each with itself among them, that may see a plane in common: twice the LiDAR's reach (m) apart.

    world_from_scan: (S, 4, 4); reach: m
    """
    path = cKDTree(world_from_scan[:, :3, 3])
    return (int(path.count_neighbors(path, 2.0 * reach)) + len(world_from_scan)) // 2


def begin(odometry: OdometryPrior, world_from_scan: Poses, reach: float | None = None) -> JointState:
    """The state of merged poses (S, 4, 4) beside an odometry.

    reach: m, of the LiDAR; None: all pairs of scans are coupled, however many
    """
    everything = np.ones(len(world_from_scan), bool)
    prior = reestimated(odometry, world_from_scan, everything)
    size = 0 if reach is None else group_size(world_from_scan, reach)
    return JointState(world_from_scan=world_from_scan, prior=prior, group_size=size)


def step(
    state: JointState, whole: BlockEquations, number: int, stage: Stage, config: LidarConfig
) -> JointState:
    """The state after one round: the sum of all blocks, solved.

    number: of the stage. A state that stands still in this stage comes back as it is.
    """
    if state.converged_stage >= number:
        return state
    scans = len(state.world_from_scan)
    equations, directions = assemble(state, whole, config)
    cost = 2.0 * whole.equations.cost / max(whole.points, 1.0)
    if state.group_size and state.projector is None and directions.count.any():
        # block equations did not know what planes leave open: a step would slide along it
        return replace(state, projector=directions.projector)
    change = _solve(equations, state.damping, config)
    moved = geometry.retract(state.world_from_scan, change)
    distance = _moved(moved, state.world_from_scan)
    gain = abs(float(np.sum(equations.gradient * change))) / (6 * scans)
    entry = JointRound(
        stage=number,
        planes=whole.planes,
        observations=whole.observations,
        cost=cost,
        sigma=whole.sigma,
        moved=distance,
        degenerate_scans=int(np.count_nonzero(directions.count)),
        refused=_grows(state, distance, number, stage),
        small=distance < stage.pose_tolerance or gain < stage.cost_tolerance,
    )
    projector = directions.projector if state.group_size else None
    if entry.refused:
        damping = levenberg_marquardt.raised(state.damping)
        return replace(state, damping=damping, history=(*state.history, entry), projector=projector)
    # a step at two levels goes part of the way: how far it is still is what the next one tells
    still = entry.small and (not state.group_size or _was_small(state, number))
    held = directions.count == 0
    prior = reestimated(state.prior, moved, held) if still else state.prior
    return replace(
        state,
        world_from_scan=moved,
        prior=prior,
        damping=levenberg_marquardt.eased(state.damping),
        converged_stage=number if still else state.converged_stage,
        history=(*state.history, entry),
        projector=projector,
    )


def _was_small(state: JointState, number: int) -> bool:
    """Whether the last round was of this stage, and small."""
    return bool(state.history) and state.history[-1].stage == number and state.history[-1].small


def _grows(state: JointState, distance: float, number: int, stage: Stage) -> bool:
    """Whether a step of this length (m) is much longer than the last one of the same stage."""
    if not state.history or state.history[-1].stage != number or distance < 10 * stage.pose_tolerance:
        return False
    return levenberg_marquardt.step_grows(distance, state.history[-1].moved)


def assemble(
    state: JointState, block: BlockEquations, config: LidarConfig
) -> tuple[NormalEquations | TwoLevelEquations, DegenerateDirections]:
    """The equations of the sum of all blocks and of the prior, degenerate directions held at the odometry.

    At two levels these directions are those that the block equations knew of, of the round before.
    """
    whole = lidar_block.over_all(block, len(state.world_from_scan))
    directions = degeneracy.judge(
        whole.information, whole.noise_information, state.world_from_scan, config.prior_sigmas
    )
    prior = state.prior.linearize(state.world_from_scan)
    if whole.bodies is None:
        return whole.equations.projected(directions.projector) + prior, directions
    groups = two_level.groups_of(state.world_from_scan, state.group_size)
    inner = whole.equations if state.projector is None else whole.equations.projected(state.projector)
    return TwoLevelEquations(groups, inner, whole.bodies) + two_level.split(prior, groups), directions


def _moved(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.linalg.norm(a[:, :3, 3] - b[:, :3, 3], axis=1).max())


def _solve(equations: NormalEquations | TwoLevelEquations, damping: float, config: LidarConfig) -> np.ndarray:
    """The step (S, 6); the first scan stays. More damping where the equations are not positive."""
    scans = len(equations.gradient)
    free = np.ones((scans, 6), bool)
    free[0] = False
    step, _ = levenberg_marquardt.damped_step(equations, damping, free, 1.0 / config.prior_sigmas**2)
    return np.zeros((scans, 6)) if step is None else step.blocks


@dataclass(frozen=True)
class JointCovariance:
    """How certain the poses are, as in `covariance.Covariance`, and what the planes leave open."""

    marginal: np.ndarray
    conditional: np.ndarray
    in_map: np.ndarray
    directions: DegenerateDirections


def covariance(
    state: JointState, whole: BlockEquations, config: LidarConfig, variance_factor: float
) -> JointCovariance:
    """Of all poses, from the equations at them; variance_factor: as of the parts.

    Raises DegenerateProblemError: planes and odometry do not determine the scans.
    """
    equations, directions = assemble(state, whole, config)
    poses = state.world_from_scan
    scans = len(poses)
    diagonal = equations.diagonal_blocks()
    conditional = variance_factor * np.linalg.inv(diagonal + 1e-9 * np.eye(6) * diagonal.max())
    free = np.ones((scans, 6), bool)
    free[0] = False
    factors: linear_solver.Factors | TwoLevelFactors | None
    if isinstance(equations, TwoLevelEquations):
        factors = two_level.factorize(equations, 1e-12, free)
    else:
        factors = linear_solver.factorize(equations, 1e-12, free)
    if factors is None:
        raise DegenerateProblemError("the planes and the odometry do not determine the scans")

    blocks = factors.covariance().blocks
    marginal, in_map = (
        variance_factor * _aligned(factors, blocks, poses, lever_m) for lever_m in (None, MAP_M)
    )
    return JointCovariance(marginal, conditional, in_map, directions)


def _aligned(
    factors: linear_solver.Factors | TwoLevelFactors,
    blocks: np.ndarray,
    poses: np.ndarray,
    lever_m: float | None,
) -> np.ndarray:
    """(S, 6, 6), of each pose after an alignment, as by `dense_covariance.aligned`. blocks: (S, 6, 6), before it"""
    motion, pick = alignment(poses, lever_m)
    through = factors.solve(pick)
    lever = (motion @ np.linalg.inv(pick.T @ motion)).reshape(-1, 6, 6)
    cross = lever @ np.swapaxes(through.reshape(-1, 6, 6), 1, 2)
    own = lever @ (pick.T @ through) @ np.swapaxes(lever, 1, 2)
    return np.asarray(blocks - cross - np.swapaxes(cross, 1, 2) + own)
