"""LiDAR bundle adjustment: from rough scan poses to the poses at which the scans agree on their planes.

Voxel map at the poses so far, planes in it, weights, a step of the poses; again, with planes found anew, coarse cells
first, until the poses stand still.
Source: Liu, Liu and Zhang 2023 (BALM2) for the cost and its derivatives; Li et al., section II-B. Different from both:
association in every round, surfaces kept apart by the side they are seen from, coarse planes refused where finer ones
contradict them, weights from each plane's own noise, degenerate directions held at the odometry.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from lvba import geometry
from lvba.arrays import Poses, Vector
from lvba.errors import DegenerateProblemError
from lvba.lidar import covariance as uncertainty
from lvba.lidar import degeneracy, density, noise_information, surface, voxel_map
from lvba.lidar.config import LidarConfig, Stage
from lvba.lidar.odometry_factor import OdometryPrior, odometry_prior, reestimated
from lvba.lidar.plane import PlanePoints, Planes
from lvba.lidar.plane_feature import fit
from lvba.lidar.problem import LidarSolution, Problem, solve
from lvba.lidar.scan import Scans, gather
from lvba.lidar.voxel_map import Association, VoxelMap
from lvba.lidar.weights import observation_weights
from lvba.progress import Progress, silent

__all__ = ["LidarConfig", "LidarResult", "Round", "Stage", "find_planes", "refine"]

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


@dataclass(frozen=True)
class LidarResult:
    """Refined scan poses and what is known about them.

    world_from_scan: (S, 4, 4) float64, in the world frame of the input, first pose unchanged
    covariance: (S, 6, 6) float64, local tangent [rotation | translation], rad and m, of the pose within the trajectory
        (what is left after aligning it with the truth)
    conditional_covariance: (S, 6, 6) float64, the same of each pose if all others were known: how far it may be off the
        map around it
    step_covariance: (S - 1, 6, 6) float64, the same of the motion from each scan to the next, in the later one's tangent
    variance_factor: actual over modeled variance of the planes' gradients; the covariances are multiplied by it
    cost_initial, cost_final: squared normalized residuals per point, of the last association's planes at the
        rough poses and at the refined ones
    degenerate_directions: motions of all scans together that planes do not determine: kept at the odometry
    degenerate_scans: (S,) int64, how many such directions each scan has
    odometry_dependence: (S - 1,) float64, of the motion to the next scan: its uncertainty with planes over that by the
        odometry alone, 0 to 1; (0,) where not known, in parts and with more than some hundred scans
    """

    world_from_scan: np.ndarray
    covariance: np.ndarray
    conditional_covariance: np.ndarray
    step_covariance: np.ndarray
    variance_factor: float
    planes: Planes
    plane_points: PlanePoints
    history: tuple[Round, ...]
    cost_initial: float
    cost_final: float
    iterations: int
    converged: bool
    degenerate_directions: tuple[degeneracy.DegenerateDirection, ...]
    degenerate_scans: np.ndarray
    odometry_dependence: np.ndarray
    warnings: tuple[str, ...]


def refine(
    scans: Sequence[np.ndarray],
    world_from_scan: Poses,
    *,
    sensor_position: Vector | None = None,
    config: LidarConfig | None = None,
    stages: tuple[Stage, ...] | None = None,
    progress: Progress = silent,
) -> LidarResult:
    """Poses at which the scans agree on their planes, and those planes.

    scans: S arrays (N, 3) float32, m, scan frame; NaN rows are passed over
    world_from_scan: (S, 4, 4), rough; the first pose stays
    sensor_position: (3,), m, where the LiDAR is in the scan frame
    stages: others than those of the settings, for comparisons
    Raises DegenerateProblemError: no plane is seen by two scans.
    """
    config = config or LidarConfig()
    sensor = np.zeros(3) if sensor_position is None else np.asarray(sensor_position, float)
    points = gather(scans)
    stages = density.adapted(stages or config.stages, points, config.dense_points)
    rough = np.array(world_from_scan, float)
    prior = odometry_prior(rough, config.prior_rotation, config.prior_translation)
    rounds = _Rounds(points=points, sensor=sensor, config=config, poses=rough, prior=prior)
    total, done = sum(stage.rounds for stage in stages), 0
    for stage in stages:
        problem, directions, converged = rounds.of_stage(stage, progress, done, total)
        done += stage.rounds
    if _may_have_drifted(directions, stage):
        problem, directions = rounds.beyond_noise(stage, progress)
    poses, history = rounds.poses, rounds.history
    del rounds
    progress("aligning scans", total, total)
    planes, plane_points = _planes_of_stage(points, poses, sensor, stages[-1])
    covariance = uncertainty.estimate(problem, poses)
    return LidarResult(
        world_from_scan=poses,
        covariance=covariance.marginal,
        conditional_covariance=covariance.conditional,
        step_covariance=covariance.step,
        variance_factor=covariance.variance_factor,
        planes=planes,
        plane_points=plane_points,
        history=tuple(history),
        cost_initial=2.0 * problem.cost(rough) / _points(problem),
        cost_final=2.0 * problem.cost(poses) / _points(problem),
        iterations=sum(entry.steps for entry in history),
        converged=converged,
        degenerate_directions=directions.common,
        degenerate_scans=directions.count,
        odometry_dependence=covariance.odometry_dependence,
        warnings=_warnings(points, history[-1], stages, converged, problem)
        + _warnings_of_dependence(covariance.odometry_dependence, directions, problem.prior),
    )


@dataclass
class _Rounds:
    """Rounds of association and solving, each from the poses of the one before. poses: (S, 4, 4)"""

    points: Scans
    sensor: np.ndarray
    config: LidarConfig
    poses: np.ndarray
    prior: OdometryPrior
    grid: VoxelMap | None = None
    history: list[Round] = field(default_factory=list)

    def of_stage(
        self, stage: Stage, progress: Progress, done: int, total: int
    ) -> tuple[Problem, degeneracy.DegenerateDirections, bool]:
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
        self.prior = reestimated(self.prior, self.poses, directions.count == 0, self.config.prior_sigmas)
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
        self.grid = self.grid.up_to(stage.sizes[-1]) if self.grid else _grid(self.points, self.poses, stage)
        return _associate(self.grid, self.poses, self.sensor, self.config, stage, self.prior)

    def _take(
        self, problem: Problem, directions: degeneracy.DegenerateDirections, solution: LidarSolution
    ) -> None:
        self.history.append(_round(problem, directions, self.poses, solution))
        _log.info("round %d: %s", len(self.history), self.history[-1])
        self.poses = solution.world_from_scan


def find_planes(
    scans: Sequence[np.ndarray] | Scans,
    world_from_scan: Poses,
    *,
    sensor_position: Vector | None = None,
    config: LidarConfig | None = None,
    stages: tuple[Stage, ...] | None = None,
) -> tuple[Planes, PlanePoints]:
    """The planes of the map at given poses (S, 4, 4), and every point with the plane it lies on.

    Raises DegenerateProblemError: no plane is seen by two scans.
    """
    config = config or LidarConfig()
    sensor = np.zeros(3) if sensor_position is None else np.asarray(sensor_position, float)
    points = scans if isinstance(scans, Scans) else gather(scans)
    stages = density.adapted(stages or config.stages, points, config.dense_points)
    return _planes_of_stage(points, world_from_scan, sensor, stages[-1])


def _planes_of_stage(
    points: Scans, world_from_scan: np.ndarray, sensor: np.ndarray, stage: Stage
) -> tuple[Planes, PlanePoints]:
    grid = _grid(points, world_from_scan, stage)
    planes = _planes(grid, world_from_scan, sensor, stage)
    weights = observation_weights(planes.features, world_from_scan, stage.weight_passes)
    return surface.extract(points, grid, planes, weights, world_from_scan, sensor)


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


def _grid(points: Scans, poses: np.ndarray, stage: Stage) -> VoxelMap:
    return voxel_map.build(points, poses, stage.sizes, OBLIQUE if stage.oblique_grid else None)


def _planes(grid: VoxelMap, poses: np.ndarray, sensor: np.ndarray, stage: Stage) -> Association:
    planes = voxel_map.find_planes(grid, poses, sensor, stage.plane_test)
    if len(planes.features) == 0:
        raise DegenerateProblemError(
            "no plane is seen by two scans: the scans do not overlap, or their poses are too far off"
        )
    return planes


def _associate(
    grid: VoxelMap,
    poses: np.ndarray,
    sensor: np.ndarray,
    config: LidarConfig,
    stage: Stage,
    prior: OdometryPrior,
) -> tuple[Problem, degeneracy.DegenerateDirections]:
    """The planes at the poses so far, with weights and degenerate directions: a problem to solve."""
    features = _planes(grid, poses, sensor, stage).features
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
    points = _points(problem)
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


def _points(problem: Problem) -> float:
    return float(np.sum(problem.features.clusters.count))


def _warnings(
    points: Scans,
    last: Round,
    stages: tuple[Stage, ...],
    converged: bool,
    problem: Problem,
) -> tuple[str, ...]:
    """What a user should know, one sentence each."""
    warnings = []
    unseen = len(points) - len(np.unique(problem.features.scan))
    if unseen:
        warnings.append(
            f"{unseen} of {len(points)} scans see no plane that others see: they move with the odometry"
        )
    if last.degenerate_scans:
        warnings.append(
            f"planes leave directions of {last.degenerate_scans} of {len(points)} scans open: these stay at the odometry"
        )
    single = len(stages) == 1 and stages[0].rounds == 1
    if not converged and not single:
        warnings.append(
            f"scan poses still moved by {last.moved * 1e3:.2f} mm in the last round of association"
        )
    return tuple(warnings)


_DEPENDENT = 0.5
"""Steps of which the planes leave more than this of the odometry's deviation are told. A group that hangs on the others
by the odometry at both its ends has sqrt(1/2) at each."""
_OUTLYING = 3.0
"""And more than this many times what they leave of most steps: an odometry as good as the planes tears no map."""
_NAMED = 8


def odometry_dependent_steps(odometry_dependence: np.ndarray, degenerate_scans: np.ndarray) -> np.ndarray:
    """Indices (K,) int64 of motions between scans that depend on the odometry, though planes determine each scan.

    odometry_dependence, degenerate_scans: as in `LidarResult`
    odometry_dependence: (S - 1,) float64; degenerate_scans: (S,) integers
    """
    if not len(odometry_dependence):
        return np.zeros(0, np.int64)
    held = degenerate_scans == 0
    dependent = (odometry_dependence > _DEPENDENT) & (
        odometry_dependence > _OUTLYING * np.median(odometry_dependence)
    )
    return np.flatnonzero(dependent & held[1:] & held[:-1])


def _warnings_of_dependence(
    odometry_dependence: np.ndarray, directions: degeneracy.DegenerateDirections, prior: OdometryPrior | None
) -> tuple[str, ...]:
    """Warnings about groups of scans that only the odometry connects, though planes determine each scan."""
    if prior is None or not len(odometry_dependence):
        return ()
    steps = odometry_dependent_steps(odometry_dependence, directions.count)
    if not len(steps):
        return ()
    named = ", ".join(map(str, steps[:_NAMED])) + (", ..." if len(steps) > _NAMED else "")
    off = 1e3 * float(np.sqrt(np.linalg.inv(prior.information[steps])[:, [3, 4, 5], [3, 4, 5]].max()))
    return (
        f"{len(steps)} of {len(odometry_dependence)} motions from scan to scan depend on the odometry alone, with errors "
        f"of about {off:.0f} mm (after scan {named}): scans before and after them share too few planes",
    )
