"""Rounds of association and solving: planes at the poses so far, weights, a step of the poses; and again."""

import logging
from dataclasses import dataclass, field, replace

import numpy as np

from lvba import geometry
from lvba.arrays import Poses, Vector
from lvba.errors import DegenerateProblemError
from lvba.inertial.factor import InertialFactor
from lvba.lidar import degeneracy, mixed_cells, noise_information, voxel_map
from lvba.lidar.config import LidarConfig, Stage
from lvba.lidar.odometry_factor import OdometryPrior, reestimated
from lvba.lidar.plane_feature import PlaneFeatures, fit
from lvba.lidar.problem import LidarSolution, Problem, solve
from lvba.lidar.scan import Scans
from lvba.lidar.voxel_map import Association, VoxelMap
from lvba.lidar.weights import observation_weights
from lvba.progress import Progress

_log = logging.getLogger(__name__)

OBLIQUE = geometry.exp(np.array([0.31, 0.47, 0.58, 0.0, 0.0, 0.0]))
"""grid_from_world: any rotation far from all symmetries of a cube."""


@dataclass(frozen=True)
class Round:
    """One association and the steps that followed it.

    planes, observations: how many; cost_before, cost_after: squared normalized residuals per point, same planes;
    sigma: m, typical distance of a point to its plane; moved: m, the furthest that a scan moved;
    degenerate_scans: scans with a degenerate direction
    """

    planes: int
    observations: int
    cost_before: float
    cost_after: float
    sigma: float
    moved: float
    steps: int
    degenerate_scans: int


Solved = tuple[Problem, degeneracy.DegenerateDirections, bool]
"""The last problem, what it leaves open, and whether the rounds of a stage came to an end."""


@dataclass
class Rounds:
    """Rounds of association and solving, each from the poses of the one before.

    poses: (S, 4, 4) float64; mixed: the planes of the last association in cells of several surfaces; None: not needed
    """

    points: Scans
    sensor: np.ndarray
    config: LidarConfig
    poses: np.ndarray
    prior: OdometryPrior
    grid: VoxelMap | None = None
    inertial: InertialFactor | None = None
    mixed: PlaneFeatures | None = None
    history: list[Round] = field(default_factory=list)

    def of_stage(self, stage: Stage, progress: Progress, done: int, total: int) -> Solved:
        """The last problem, what it leaves open, and whether the rounds of a stage came to an end."""
        converged = False
        for turn in range(stage.rounds):
            progress("aligning scans", done + turn, total)
            problem, directions = self._associated(stage)
            solution = solve(problem, self.poses, _metric(self.config), steps=stage.steps, exact=stage.exact)
            self._take(problem, directions, solution)
            converged = _has_converged(solution, self.history[-1], stage)
            if converged:
                break
        self.prior = reestimated(self.prior, self.poses, directions.count == 0)
        return problem, directions, converged

    def last(self, stage: Stage, progress: Progress, done: int, total: int) -> Solved:
        """The same of the last stage, with what follows where scans may have drifted on noise."""
        problem, directions, converged = self.of_stage(stage, progress, done, total)
        if _may_have_drifted(directions, stage):
            problem, directions = self.beyond_noise(stage, progress)
        return problem, directions, converged

    def beyond_noise(
        self, stage: Stage, progress: Progress
    ) -> tuple[Problem, degeneracy.DegenerateDirections]:
        """The same, with planes that count by what they say beyond noise."""
        for turn in range(_NOISE_ROUNDS):
            progress("weighing scans against the odometry", turn, _NOISE_ROUNDS)
            problem, directions = self._associated(stage)
            self._take(
                problem, directions, noise_information.solve(problem, self.poses, self.config.prior_sigmas)
            )
        return problem, directions

    def _associated(self, stage: Stage) -> tuple[Problem, degeneracy.DegenerateDirections]:
        if self.grid is not None and _stale(self.grid, self.poses, stage):
            self.grid = None  # never two at a time
        self.grid = (
            self.grid.up_to(stage.sizes[-1]) if self.grid else build_grid(self.points, self.poses, stage)
        )
        association = planes_in(self.grid, self.poses, self.sensor, stage)
        features, self.mixed = association.features, None
        problem, directions = _weighed(features, self.poses, self.config, stage, self.prior)
        if stage.mixed_cells and directions.count.any():
            self.mixed = self._mixed(self.grid, association, stage, problem.sigma, directions.count > 0)
            features = features.joined(self.mixed)
            problem, directions = _weighed(features, self.poses, self.config, stage, self.prior)
        return replace(problem, inertial=self.inertial), directions

    def _mixed(
        self, grid: VoxelMap, association: Association, stage: Stage, sigma: float, is_open: np.ndarray
    ) -> PlaneFeatures:
        """The planes in the finest cells that hold several surfaces, as far as scans see them that are open, (S,) bool.

        sigma: m, of a point about its plane
        Normals of small planes are uncertain: where scans are held without them, they add more noise than they tell.
        """
        test = stage.plane_test
        planes = mixed_cells.find(grid, association, self.points, self.poses, self.sensor, sigma, test)
        seen = np.bincount(planes.feature, is_open[planes.scan], len(planes)) > 0
        return planes.select(seen)

    def _take(
        self, problem: Problem, directions: degeneracy.DegenerateDirections, solution: LidarSolution
    ) -> None:
        self.history.append(_round(problem, directions, self.poses, solution))
        _log.info("round %d: %s", len(self.history), self.history[-1])
        self.poses = solution.world_from_scan


_NOISE_ROUNDS = 6
"""Associations in which planes count by what they say beyond noise: poses that drifted on noise are back by then."""


def _may_have_drifted(directions: degeneracy.DegenerateDirections, stage: Stage) -> bool:
    """Whether some scans are held so little that they, and others with them, may have drifted on noise. Where all
    together are open in a direction, holding it says all there is to say."""
    return (
        stage.project_degenerate
        and bool(directions.count.any())
        and not directions.common
        and len(directions.count) <= noise_information.MOST_SCANS
    )


_STALE = 0.02
"""Part of the finest cells' edge that points may have moved by until they are put into cells anew. Besides time that
spares rounds: points that change cells at each come and go, and poses never quite stand still."""


def _stale(grid: VoxelMap, poses: np.ndarray, stage: Stage) -> bool:
    """Whether points have left their cells, or a stage has others."""
    finest = stage.sizes[0]
    return grid.levels[0].size != finest or grid.shift(poses) > _STALE * finest


def build_grid(points: Scans, poses: Poses, stage: Stage) -> VoxelMap:
    """The cells of all points at poses (S, 4, 4)."""
    return voxel_map.build(points, poses, stage.sizes, OBLIQUE if stage.oblique_grid else None)


def planes_in(grid: VoxelMap, poses: Poses, sensor: Vector, stage: Stage) -> Association:
    """The planes in the cells, seen from sensors at `sensor` (m, scan frame).

    Raises DegenerateProblemError: no plane is seen by two scans.
    """
    planes = voxel_map.find_planes(grid, poses, sensor, stage.plane_test)
    if len(planes.features) == 0:
        raise DegenerateProblemError(
            "no plane is seen by two scans: the scans do not overlap, or their poses are too far off"
        )
    return planes


def _weighed(
    features: PlaneFeatures, poses: np.ndarray, config: LidarConfig, stage: Stage, prior: OdometryPrior
) -> tuple[Problem, degeneracy.DegenerateDirections]:
    """The planes with weights and degenerate directions: a problem to solve."""
    weights = observation_weights(features, poses, stage.weight_passes)
    features = features.with_weight(weights.weight)
    directions = degeneracy.find(features, fit(features, poses), poses, weights.sigma, config.prior_sigmas)
    projector = directions.projector if stage.project_degenerate and directions.count.any() else None
    return Problem(features, weights.sigma, prior, projector), directions


def _has_converged(solution: LidarSolution, last: Round, stage: Stage) -> bool:
    """Whether the poses stand still after a round."""
    # costs are half the sums of squares
    gain = 2.0 * abs(solution.cost_before - solution.cost_after) / (6 * len(solution.world_from_scan))
    return last.moved < stage.pose_tolerance or gain < stage.cost_tolerance


def _metric(config: LidarConfig) -> np.ndarray:
    return np.asarray(1.0 / config.prior_sigmas**2)


def _round(
    problem: Problem, directions: degeneracy.DegenerateDirections, before: np.ndarray, solution: LidarSolution
) -> Round:
    features = problem.features
    points = count_points(problem)
    moved = np.linalg.norm(solution.world_from_scan[:, :3, 3] - before[:, :3, 3], axis=1)
    return Round(
        planes=len(features),
        observations=len(features.scan),
        cost_before=2.0 * solution.cost_before / points,
        cost_after=2.0 * solution.cost_after / points,
        sigma=problem.sigma,
        moved=float(moved.max()),
        steps=solution.steps,
        degenerate_scans=int(np.count_nonzero(directions.count)),
    )


def count_points(problem: Problem) -> float:
    """How many points lie on the planes of a problem."""
    return float(np.sum(problem.features.clusters.count))
