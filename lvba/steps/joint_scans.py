"""The steps that make the scans of all parts one: each part by itself, merged, then one joint problem in rounds."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce

import numpy as np

from lvba.blocks import lidar_block, lidar_joint, merge
from lvba.blocks.decoded_scans import ScanPoints, ScanReader
from lvba.blocks.lidar_block import BlockClusters, BlockEquations
from lvba.blocks.lidar_joint import JointState
from lvba.blocks.merge import MergedScans, PartPoses
from lvba.blocks.pieces import Pieces
from lvba.blocks.regions import regions
from lvba.blocks.split import Part
from lvba.blocks.survey import Survey
from lvba.dataset import Dataset
from lvba.lidar.bundle_adjustment import LidarConfig, LidarResult, Round
from lvba.lidar.odometry_factor import with_pauses
from lvba.lidar.plane import no_plane_points, no_planes
from lvba.lidar.plane_feature import PlaneFeatures
from lvba.lidar.rounds import OBLIQUE
from lvba.lidar.scan_errors import ScanErrors
from lvba.loop_closure import registration, rough_poses, submap
from lvba.loop_closure.candidates import Candidate
from lvba.loop_closure.registration import Loop
from lvba.loop_closure.rough_poses import RoughError
from lvba.loop_closure.submap import Submap
from lvba.progress import Progress, silent
from lvba.steps.lidar import solve_lidar, with_errors
from lvba.steps.outcomes import LidarStage


@dataclass(frozen=True)
class PartScans:
    """What the LiDAR bundle adjustment of one part leaves; the input's poses where it could not be solved.

    poses: with scan numbers of the whole; covariances of the odometry where it could not be solved
    variance_factor, shared_factor, history, converged, warnings: as in `LidarResult`
    rough_error, confirmed: as in `LidarStage`, with scan numbers of the whole
    """

    poses: PartPoses
    surfaces: Submap | None
    variance_factor: float
    history: tuple[Round, ...]
    converged: bool
    warnings: tuple[str, ...]
    shared_factor: float = 1.0
    problem: str = ""
    rough_error: RoughError | None = None
    confirmed: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    mixed: PlaneFeatures | None = None
    """As in `LidarResult`, with scan numbers of the part."""


def solve_part(
    dataset: Dataset,
    part: Part,
    points: Pieces[ScanPoints],
    config: LidarConfig,
    enabled: bool = True,
    progress: Progress = silent,
) -> PartScans:
    """The scan poses of one part, as `steps.lidar.solve_lidar` finds them. dataset: of the part's frames."""
    lidar = solve_lidar(dataset, part, points, config, enabled, progress=progress)
    result = lidar.result
    if result is None:
        return _unsolved(dataset, part, config, lidar.problem)
    surfaces = submap.of_result(result, part.scan_numbers, dataset.sensor_position_scan)
    return PartScans(
        poses=PartPoses(part.scan_numbers, result.world_from_scan, result.step_covariance),
        surfaces=surfaces,
        variance_factor=result.variance_factor,
        history=result.history,
        converged=result.converged,
        warnings=result.warnings,
        shared_factor=result.shared_factor,
        rough_error=lidar.rough_error and lidar.rough_error.numbered(part.scan_numbers),
        confirmed=part.scan_numbers[lidar.confirmed],
        mixed=result.mixed,
    )


def _unsolved(dataset: Dataset, part: Part, config: LidarConfig, problem: str) -> PartScans:
    steps = np.diag([config.prior_rotation**2] * 3 + [config.prior_translation**2] * 3)
    poses = PartPoses(
        part.scan_numbers,
        dataset.scans.world_from_sensor,
        np.broadcast_to(steps, (len(dataset.scans) - 1, 6, 6)).copy(),
    )
    return PartScans(
        poses=poses,
        surfaces=None,
        variance_factor=1.0,
        history=(),
        converged=False,
        warnings=(),
        problem=problem,
    )


def close_loop(first: PartScans, second: PartScans, candidate: Candidate) -> Loop | None:
    """Whether two parts see the same place, and their relative pose; none where one of them was not solved."""
    if first.surfaces is None or second.surfaces is None:
        return None
    return registration.register(first.surfaces, second.surfaces, candidate)


@dataclass(frozen=True)
class MergedStage:
    """All scans in one world frame: where the joint adjustment begins, and how the parts fitted."""

    merged: MergedScans
    state: JointState


def merge_parts(
    dataset: Dataset,
    cores: Sequence[Part],
    parts: Sequence[PartScans],
    closed: Sequence[Loop | None],
    survey: Survey,
    align: bool = True,
) -> MergedStage:
    """The parts tied in their overlaps and by loops.

    align: False: every scan is where the part whose core it is in put it, with steps at the seams (for comparison)
    """
    merged = merge.merge(
        tuple(part.poses for part in parts), tuple(loop for loop in closed if loop is not None)
    )
    poses = merged.world_from_scan
    if not align:
        poses = _side_by_side(cores, parts, dataset.scans.world_from_sensor)
    error = rough_poses.of_all([part.rough_error for part in parts if part.rough_error is not None])
    odometry = rough_poses.odometry_of(dataset.scans.world_from_sensor, error, poses, survey.lidar)
    odometry = with_pauses(odometry, dataset.scans.times)
    state = lidar_joint.begin(odometry, poses, survey.reach_m)
    if all(part.problem for part in parts):
        state = replace(state, converged_stage=len(survey.stages))
    return MergedStage(merged, state)


def start(stage: MergedStage) -> JointState:
    """Where the joint adjustment begins."""
    return stage.state


def _side_by_side(cores: Sequence[Part], parts: Sequence[PartScans], rough: np.ndarray) -> np.ndarray:
    """(S, 4, 4): each core as its own part has it."""
    poses = rough.copy()
    for core, part in zip(cores, parts, strict=True):
        poses[slice(*core.core_scans)] = part.poses.world_from_scan[core.core_of_scans]
    return poses


def collect_clusters(
    dataset: Dataset,
    cores: Sequence[Part],
    part: int,
    points: Pieces[ScanPoints],
    state: JointState,
    survey: Survey,
    number: int,
    solved: Sequence[Callable[[], PartScans]] = (),
    progress: Progress = silent,
) -> BlockClusters | None:
    """The point clusters of a part's region at the poses so far; none where stage `number` has converged already.

    solved: read the parts whose scans have their cores in this region
    """
    if state.converged_stage >= number:
        return None
    owned = regions(dataset, cores, state.world_from_scan)
    mixed = (
        _mixed_of(cores[part], solved)
        if survey.stages[min(number, len(survey.stages) - 1)].mixed_cells
        else None
    )
    sizes = survey.stages[-1].sizes
    return lidar_block.collect(
        ScanReader(points, whole=dataset).load,
        lidar_block.candidates(owned, part, survey.reach_m),
        state.world_from_scan,
        owned,
        part,
        size=sizes[0],
        largest=max(stage.sizes[-1] for stage in survey.stages[-2:]),
        grid_from_world=OBLIQUE if survey.stages[-1].oblique_grid else np.eye(4),
        mixed=mixed,
        progress=progress,
    )


def _mixed_of(core: Part, solved: Sequence[Callable[[], PartScans]]) -> PlaneFeatures | None:
    """Planes in cells of several surfaces as parts have them, of scans in a core and with their numbers in the whole.

    Scans of two parts are tied by all other planes: to tell points of such cells apart takes points.
    """
    made = []
    for read in solved:
        part = read()
        if part.mixed is not None:
            numbers = part.poses.scans[part.mixed.scan]
            inside = (core.core_scans[0] <= numbers) & (numbers < core.core_scans[1])
            made.append(replace(part.mixed, scan=numbers.astype(np.int32)).observations_where(inside))
    return None if not made else reduce(PlaneFeatures.joined, made)


def linearize_scans(
    dataset: Dataset,
    read_clusters: Callable[[], BlockClusters | None],
    state: JointState,
    survey: Survey,
    number: int,
    final: bool = False,
) -> BlockEquations | None:
    """The normal equations of a region's clusters in stage `number`; none where that has converged, unless `final`."""
    if state.converged_stage >= number and not final:
        return None
    clusters = read_clusters()
    if clusters is None:
        return None
    return lidar_block.linearize(
        clusters,
        state.world_from_scan,
        dataset.sensor_position_scan,
        survey.stages[number],
        state.groups,
    )


def step_scans(
    state: JointState,
    read_equations: Sequence[Callable[[], BlockEquations | None]],
    survey: Survey,
    number: int,
) -> JointState:
    """One round of the joint problem."""
    if state.converged_stage >= number:
        return state
    known = lidar_block.summed(each for read in read_equations if (each := read()) is not None)
    return lidar_joint.step(state, known, number, survey.stages[number], survey.lidar) if known else state


@dataclass(frozen=True)
class JointScans:
    """The scans of the whole recording.

    lidar: as of an undivided recording, but without planes, which stay with the parts
    """

    lidar: LidarStage
    merged: MergedScans
    rounds: tuple[lidar_joint.JointRound, ...]


def stage_of(joint: JointScans) -> LidarStage:
    """What was found about the scans, as of an undivided recording."""
    return joint.lidar


def finish_scans(
    merged: MergedStage,
    state: JointState,
    read_equations: Sequence[Callable[[], BlockEquations | None]],
    parts: Sequence[PartScans],
    survey: Survey,
    scan_errors: ScanErrors | None = None,
) -> JointScans:
    """The result of all rounds; read_equations: of all regions at the final poses; scan_errors: as of `solve_lidar`."""
    final = lidar_block.summed(
        each for read in read_equations if (each := read()) is not None and each.planes
    )
    problems = [part.problem for part in parts if part.problem]
    if final is None or len(problems) == len(parts):
        return JointScans(
            LidarStage(None, problems[0] if problems else "no plane is seen by two scans"), merged.merged, ()
        )
    variance_factor, shared_factor = (
        float(np.median([getattr(part, name) for part in parts if not part.problem]))
        for name in ("variance_factor", "shared_factor")
    )
    uncertainty = lidar_joint.covariance(state, final, survey.lidar, variance_factor)
    last = len(survey.stages) - 1
    converged = state.converged_stage >= last or not state.history
    result = LidarResult(
        world_from_scan=state.world_from_scan,
        covariance=uncertainty.marginal,
        conditional_covariance=uncertainty.conditional,
        map_covariance=uncertainty.in_map,
        step_covariance=np.zeros((0, 6, 6)),
        variance_factor=variance_factor,
        shared_factor=shared_factor,
        planes=no_planes(),
        plane_points=no_plane_points(),
        history=(*(entry for part in parts for entry in part.history[:1]), *_rounds(state)),
        cost_initial=float(np.mean([part.history[0].cost_before for part in parts if part.history])),
        cost_final=2.0 * final.equations.cost / max(final.points, 1.0),
        iterations=len(state.history) + sum(len(part.history) for part in parts),
        converged=converged,
        degenerate_directions=uncertainty.directions.common,
        degenerate_scans=uncertainty.directions.count,
        odometry_dependence=np.zeros(0),
        warnings=_warnings(state, parts, converged, uncertainty.directions.count),
    )
    errors = [part.rough_error for part in parts if part.rough_error is not None]
    confirmed = np.unique(np.concatenate([part.confirmed for part in parts]))
    result = with_errors(result, scan_errors, np.arange(len(result.covariance)))
    stage = LidarStage(
        result,
        rough_error=rough_poses.of_all(errors),
        confirmed=confirmed,
        planes_off=None if scan_errors is None else scan_errors.planes_off,
    )
    return JointScans(stage, merged.merged, state.history)


def _rounds(state: JointState) -> Iterator[Round]:
    """The joint rounds, as of an undivided recording."""
    for each in state.history:
        yield Round(
            planes=each.planes,
            observations=each.observations,
            cost_before=each.cost,
            cost_after=each.cost,
            sigma=each.sigma,
            moved=each.moved,
            steps=1,
            degenerate_scans=each.degenerate_scans,
        )


def _warnings(
    state: JointState, parts: Sequence[PartScans], converged: bool, degenerate_scans: np.ndarray
) -> tuple[str, ...]:
    warnings = [
        f"part {number + 1} of {len(parts)} could not be solved by itself ({part.problem}); its scans began where the "
        "odometry has them"
        for number, part in enumerate(parts)
        if part.problem
    ]
    open_scans = int(np.count_nonzero(degenerate_scans))
    if open_scans:
        warnings.append(
            f"planes leave directions of {open_scans} of {len(degenerate_scans)} scans open: these stay at the odometry"
        )
    if not converged:
        warnings.append(
            f"scan poses still moved by {state.history[-1].moved * 1e3:.2f} mm in the last joint round; more rounds "
            "(merge.scan_rounds) may help"
        )
    return tuple(warnings)
