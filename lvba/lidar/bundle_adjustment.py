"""LiDAR bundle adjustment: from rough scan poses to the poses at which the scans agree on their planes.

Voxel map at the poses so far, planes in it, weights, a step of the poses; again, with planes found anew, coarse cells
first, until the poses stand still.
Source: Liu, Liu and Zhang 2023 (BALM2) for the cost and its derivatives; Li et al., section II-B. Different from both:
association in every round, surfaces kept apart by the side they are seen from, coarse planes refused where finer ones
contradict them, weights from each plane's own noise, degenerate directions held at the odometry.
"""

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from lvba.arrays import Poses, Vector
from lvba.errors import DegenerateProblemError
from lvba.inertial.consistency import InertialResult
from lvba.inertial.readings import Imu
from lvba.lidar import covariance as uncertainty
from lvba.lidar import degeneracy, density, inertial_rounds, surface
from lvba.lidar.config import LidarConfig, Stage
from lvba.lidar.odometry_factor import OdometryPrior, by_turns, odometry_prior
from lvba.lidar.plane import PlanePoints, Planes
from lvba.lidar.plane_feature import PlaneFeatures
from lvba.lidar.problem import Problem
from lvba.lidar.rounds import Round, Rounds, Solved, build_grid, count_points, planes_in
from lvba.lidar.scan import Scans, gather
from lvba.lidar.weights import observation_weights
from lvba.progress import Progress, silent

__all__ = ["Aligned", "LidarConfig", "LidarResult", "Round", "Stage", "align", "find_planes", "refine"]


@dataclass(frozen=True)
class LidarResult:
    """Refined scan poses and what is known about them.

    world_from_scan: (S, 4, 4) float64, in the world frame of the input, first pose unchanged
    covariance: (S, 6, 6) float64, local tangent [rotation | translation], rad and m, of the pose within the trajectory
        (what is left after aligning it with the truth)
    conditional_covariance: (S, 6, 6) float64, the same of each pose if all others were known: how far it may be off the
        map around it
    map_covariance: (S, 6, 6) float64, as `covariance`, but after aligning the map (`lidar.covariance.Covariance.in_map`)
    step_covariance: (S - 1, 6, 6) float64, of the motion from each scan to the next, in the later one's tangent
    variance_factor: actual over modeled variance of the planes' gradients; the covariances are multiplied by it
    shared_factor: what `covariance` is to be multiplied by for expected errors, see `lidar.covariance.Covariance`
    own_covariance: (S, 6, 6) float64, local tangent, rad and m, of what each scan is off by itself beside that, because
        the motion that was taken out of its points is uncertain; (0, 6, 6): nothing. Neighbors do not share it, and the
        other covariances do not hold it
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
    map_covariance: np.ndarray
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
    inertial: InertialResult | None = None
    """What the IMU said; None: there is none."""
    shared_factor: float = 1.0
    own_covariance: np.ndarray = field(default_factory=lambda: np.zeros((0, 6, 6)))
    mixed: PlaneFeatures | None = None
    """Planes of the last association in cells of several surfaces, which clusters of cells do not tell of; None: others
    leave no scan open."""

    @property
    def pose_covariance(self) -> uncertainty.Covariance:
        """Of the poses, without what each scan is off by itself."""
        return uncertainty.Covariance(
            marginal=self.covariance,
            conditional=self.conditional_covariance,
            in_map=self.map_covariance,
            step=self.step_covariance,
            shared_factor=self.shared_factor,
        )

    @property
    def whole_covariance(self) -> uncertainty.Covariance:
        """Of the poses, with what each scan is off by itself."""
        return self.pose_covariance.with_own(self.own_covariance, self.world_from_scan)


def refine(
    scans: Sequence[np.ndarray],
    world_from_scan: Poses,
    *,
    sensor_position: Vector | None = None,
    config: LidarConfig | None = None,
    odometry: OdometryPrior | None = None,
    stages: tuple[Stage, ...] | None = None,
    imu: Imu | None = None,
    progress: Progress = silent,
) -> LidarResult:
    """Poses at which the scans agree on their planes, and those planes.

    scans: S arrays (N, 3) float32, m, scan frame; NaN rows are passed over
    world_from_scan: (S, 4, 4), rough; the first pose stays
    sensor_position: (3,), m, where the LiDAR is in the scan frame
    odometry: what is known of the motions from scan to scan; None: that they are about as world_from_scan has them. Poses
        that come of the scans themselves are no odometry: they would be taken for a second, very good witness
    stages: others than those of the settings, for comparisons
    imu: used where it does not contradict the planes
    Raises DegenerateProblemError: no plane is seen by two scans.
    """
    config = config or LidarConfig()
    sensor = np.zeros(3) if sensor_position is None else np.asarray(sensor_position, float)
    points = gather(scans)
    stages = density.adapted(stages or config.stages, points, config.dense_points)
    rough = np.array(world_from_scan, float)
    prior = odometry or odometry_prior(rough, config.prior_rotation, config.prior_translation)
    rounds = Rounds(points=points, sensor=sensor, config=config, poses=rough, prior=prior)
    solved, total = _through(rounds, stages, progress), sum(stage.rounds for stage in stages)
    inertial = None
    if imu is not None:
        rounds, solved, inertial = inertial_rounds.with_imu(rounds, imu, stages[-1], solved, progress)
    problem, directions, converged = solved
    poses, history, mixed = rounds.poses, rounds.history, rounds.mixed
    del rounds
    progress("aligning scans", total, total)
    planes, plane_points = _planes_of_stage(points, poses, sensor, stages[-1])
    if problem.prior is not None:
        problem = replace(problem, prior=by_turns(problem.prior, poses, directions.count == 0))
    covariance = uncertainty.estimate(problem, poses)
    return LidarResult(
        world_from_scan=poses,
        covariance=covariance.marginal,
        conditional_covariance=covariance.conditional,
        map_covariance=covariance.in_map,
        step_covariance=covariance.step,
        variance_factor=covariance.variance_factor,
        shared_factor=covariance.shared_factor,
        planes=planes,
        plane_points=plane_points,
        history=tuple(history),
        cost_initial=2.0 * problem.cost(rough) / count_points(problem),
        cost_final=2.0 * problem.cost(poses) / count_points(problem),
        iterations=sum(entry.steps for entry in history),
        converged=converged,
        degenerate_directions=directions.common,
        degenerate_scans=directions.count,
        odometry_dependence=covariance.odometry_dependence,
        inertial=None if inertial is None else inertial.among(covariance.marginal),
        mixed=mixed,
        warnings=_warnings(points, history[-1], stages, converged, problem)
        + inertial_rounds.warnings(inertial)
        + _warnings_of_dependence(covariance.odometry_dependence, directions, problem.prior),
    )


def _through(rounds: Rounds, stages: tuple[Stage, ...], progress: Progress) -> Solved:
    """All stages, one after the other: what the last one leaves. Cells of the others may hold no plane: clutter."""
    total, done = sum(stage.rounds for stage in stages), 0
    for stage in stages[:-1]:
        with contextlib.suppress(DegenerateProblemError):
            rounds.of_stage(stage, progress, done, total)
        done += stage.rounds
    return rounds.last(stages[-1], progress, done, total)


@dataclass(frozen=True)
class Aligned:
    """world_from_scan: (S, 4, 4) float64, refined poses; planes: of the map that they make; plane_points: its points"""

    world_from_scan: np.ndarray
    planes: Planes
    plane_points: PlanePoints


def align(
    scans: Sequence[np.ndarray],
    world_from_scan: Poses,
    start: Poses | None = None,
    *,
    sensor_position: Vector,
    config: LidarConfig,
) -> Aligned:
    """What `refine` gives without saying how certain it is, also by the last stage alone.

    scans: S arrays (N, 3) float32, m, scan frame; world_from_scan: (S, 4, 4), rough; sensor_position: (3,), m
    start: (S, 4, 4), as refined with about the same points, from where the last stage continues; None: nothing is known
    Raises DegenerateProblemError: no plane is seen by two scans.
    """
    points = gather(scans)
    stages = density.adapted(config.stages, points, config.dense_points)
    rough = np.array(world_from_scan, float)
    prior = odometry_prior(rough, config.prior_rotation, config.prior_translation)
    poses = rough if start is None else np.array(start, float)
    rounds = Rounds(points=points, sensor=sensor_position, config=config, poses=poses, prior=prior)
    _through(rounds, stages if start is None else stages[-1:], silent)
    poses = rounds.poses
    del rounds
    return Aligned(poses, *_planes_of_stage(points, poses, sensor_position, stages[-1]))


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
    grid = build_grid(points, world_from_scan, stage)
    planes = planes_in(grid, world_from_scan, sensor, stage)
    weights = observation_weights(planes.features, world_from_scan, stage.weight_passes)
    return surface.extract(points, grid, planes, weights, world_from_scan, sensor)


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
        by = "the IMU holds them" if problem.inertial else "these stay at the odometry"
        warnings.append(
            f"planes leave directions of {last.degenerate_scans} of {len(points)} scans open: {by}"
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
