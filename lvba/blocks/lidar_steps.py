"""LiDAR stages of a recording in parts: each part by itself, merged, then one joint problem in rounds."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lvba.blocks import lidar_block, lidar_joint, merge
from lvba.blocks.lidar_block import Share, ShareEquations
from lvba.blocks.lidar_joint import JointState
from lvba.blocks.merge import MergedScans, PartPoses
from lvba.blocks.regions import regions
from lvba.blocks.split import Part
from lvba.blocks.survey import Survey
from lvba.dataset import Dataset
from lvba.errors import DegenerateProblemError
from lvba.io import dataset as recordings
from lvba.lidar import bundle_adjustment as lidar_ba
from lvba.lidar.bundle_adjustment import LidarConfig, LidarResult, Round
from lvba.lidar.plane import PlanePoints, Planes
from lvba.loop_closure import registration, submap
from lvba.loop_closure.candidates import Candidate
from lvba.loop_closure.registration import Loop
from lvba.loop_closure.submap import Submap
from lvba.progress import Progress, silent
from lvba.steps.outcomes import LidarStage


@dataclass(frozen=True)
class PartScans:
    """What the LiDAR bundle adjustment of one part leaves; the input's poses where it could not be solved.

    poses: with scan numbers of the whole; covariances of the odometry where it could not be solved
    excess, iterations, history, converged, warnings: as in `LidarResult`
    """

    poses: PartPoses
    surfaces: Submap | None
    excess: float
    history: tuple[Round, ...]
    converged: bool
    warnings: tuple[str, ...]
    problem: str = ""


def solve_part(
    dataset: Dataset, part: Part, config: LidarConfig, enabled: bool = True, progress: Progress = silent
) -> PartScans:
    """The scan poses of one part. dataset: of the part's frames."""
    if not enabled:
        return _unsolved(dataset, part, config, "LiDAR bundle adjustment is switched off (refine_scans)")
    try:
        result = lidar_ba.refine(
            recordings.load_scans(dataset),
            dataset.scans.world_from_sensor,
            sensor_position=dataset.sensor_position_scan,
            config=config,
            progress=progress,
        )
    except DegenerateProblemError as error:
        return _unsolved(dataset, part, config, str(error))
    surfaces = submap.build(
        result.planes,
        result.plane_points,
        result.world_from_scan,
        part.scan_numbers,
        sensor_position=dataset.sensor_position_scan,
        covariance=result.conditional_covariance,
    )
    return PartScans(
        PartPoses(part.scan_numbers, result.world_from_scan, result.step_covariance),
        surfaces,
        result.excess,
        result.history,
        result.converged,
        result.warnings,
    )


def _unsolved(dataset: Dataset, part: Part, config: LidarConfig, problem: str) -> PartScans:
    steps = np.diag([config.prior_rotation**2] * 3 + [config.prior_translation**2] * 3)
    poses = PartPoses(
        part.scan_numbers,
        dataset.scans.world_from_sensor,
        np.broadcast_to(steps, (len(dataset.scans) - 1, 6, 6)).copy(),
    )
    return PartScans(poses, None, 1.0, (), False, (), problem)


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
    found: Sequence[PartScans],
    closed: Sequence[Loop | None],
    survey: Survey,
    align: bool = True,
) -> MergedStage:
    """The parts tied in their overlaps and by loops.

    align: False: every scan is where the part whose core it is in put it, with steps at the seams (for comparison)
    """
    merged = merge.merge(
        tuple(part.poses for part in found), tuple(loop for loop in closed if loop is not None)
    )
    poses = merged.world_from_scan
    if not align:
        poses = _side_by_side(cores, found, dataset.scans.world_from_sensor)
    state = lidar_joint.begin(dataset.scans.world_from_sensor, poses, survey.lidar)
    if all(part.problem for part in found):
        state = replace(state, settled=len(survey.stages))
    return MergedStage(merged, state)


def start(stage: MergedStage) -> JointState:
    """Where the joint adjustment begins."""
    return stage.state


def _side_by_side(cores: Sequence[Part], found: Sequence[PartScans], rough: np.ndarray) -> np.ndarray:
    """(S, 4, 4): each core as its own part has it."""
    poses = rough.copy()
    for core, part in zip(cores, found, strict=True):
        poses[slice(*core.core_scans)] = part.poses.world_from_scan[core.core_of_scans]
    return poses


def collect_share(
    dataset: Dataset,
    cores: Sequence[Part],
    part: int,
    state: JointState,
    survey: Survey,
    number: int,
    progress: Progress = silent,
) -> Share | None:
    """The cells of a part's region at the poses so far; none where stage `number` has settled already."""
    if state.settled >= number:
        return None
    owned = regions(dataset, cores, state.world_from_scan)
    sizes = survey.stages[-1].sizes
    return lidar_block.collect(
        lambda scans: recordings.load_scans(dataset, scans),
        lidar_block.candidates(owned, part, survey.reach_m),
        state.world_from_scan,
        owned,
        part,
        size=sizes[0],
        largest=max(stage.sizes[-1] for stage in survey.stages[-2:]),
        grid_from_world=lidar_ba.OBLIQUE if survey.stages[-1].oblique_grid else np.eye(4),
        progress=progress,
    )


def linearize_share(
    dataset: Dataset,
    read_cells: Callable[[], Share | None],
    state: JointState,
    survey: Survey,
    number: int,
    final: bool = False,
) -> ShareEquations | None:
    """What the cells say about the scans in stage `number`; none where that has settled, but for the `final` account."""
    if state.settled >= number and not final:
        return None
    cells = read_cells()
    if cells is None:
        return None
    return lidar_block.linearize(
        cells,
        state.world_from_scan,
        dataset.sensor_position_scan,
        survey.stages[number],
    )


def step_scans(
    state: JointState, read_shares: Sequence[Callable[[], ShareEquations | None]], survey: Survey, number: int
) -> JointState:
    """One round of the joint problem."""
    if state.settled >= number:
        return state
    known = lidar_block.summed(each for read in read_shares if (each := read()) is not None)
    return lidar_joint.step(state, known, number, survey.stages[number], survey.lidar) if known else state


@dataclass(frozen=True)
class JointScans:
    """The scans of the whole recording.

    lidar: as of an undivided recording, but without planes, which stay with the parts
    """

    lidar: LidarStage
    merged: MergedScans
    rounds: tuple[lidar_joint.JointRound, ...]


def stage_of(found: JointScans) -> LidarStage:
    """What was found about the scans, as of an undivided recording."""
    return found.lidar


def finish_scans(
    merged: MergedStage,
    state: JointState,
    read_shares: Sequence[Callable[[], ShareEquations | None]],
    parts: Sequence[PartScans],
    survey: Survey,
) -> JointScans:
    """The result of all rounds; read_shares: of the account at the final poses."""
    final = lidar_block.summed(each for read in read_shares if (each := read()) is not None and each.planes)
    problems = [part.problem for part in parts if part.problem]
    if final is None or len(problems) == len(parts):
        return JointScans(
            LidarStage(None, problems[0] if problems else "no plane is seen by two scans"), merged.merged, ()
        )
    excess = float(np.median([part.excess for part in parts if not part.problem]))
    uncertainty = lidar_joint.covariance(state, final, survey.lidar, excess)
    history = tuple(
        Round(r.planes, r.observations, r.cost, r.cost, r.sigma, r.moved, 1, r.weak_scans)
        for r in state.history
    )
    last = len(survey.stages) - 1
    settled = state.settled >= last or not state.history
    result = LidarResult(
        world_from_scan=state.world_from_scan,
        covariance=uncertainty.marginal,
        conditional_covariance=uncertainty.conditional,
        step_covariance=np.zeros((0, 6, 6)),
        excess=excess,
        planes=_no_planes(),
        plane_points=PlanePoints(np.zeros((0, 3), np.float32), np.zeros(0, np.int32), np.zeros(1, np.int64)),
        history=(*(entry for part in parts for entry in part.history[:1]), *history),
        cost_initial=float(np.mean([part.history[0].cost_before for part in parts if part.history])),
        cost_final=2.0 * final.equations.cost / max(final.points, 1.0),
        iterations=len(state.history) + sum(len(part.history) for part in parts),
        converged=settled,
        weak_directions=uncertainty.weakness.common,
        weak_scans=uncertainty.weakness.count,
        loose=np.zeros(0),
        warnings=_warnings(state, parts, settled, uncertainty.weakness.count),
    )
    return JointScans(LidarStage(result), merged.merged, state.history)


def _no_planes() -> Planes:
    none = np.zeros(0)
    return Planes(
        np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3, 3)),
        none.astype(np.int64), none.astype(np.int32), none, none,
    )  # fmt: skip


def _warnings(
    state: JointState, parts: Sequence[PartScans], settled: bool, weak_scans: np.ndarray
) -> tuple[str, ...]:
    told = [
        f"part {number + 1} of {len(parts)} could not be solved by itself ({part.problem}); its scans began where the "
        "odometry has them"
        for number, part in enumerate(parts)
        if part.problem
    ]
    open_scans = int(np.count_nonzero(weak_scans))
    if open_scans:
        told.append(
            f"planes leave directions of {open_scans} of {len(weak_scans)} scans open: these stay at the odometry"
        )
    if not settled:
        told.append(
            f"scan poses still moved by {state.history[-1].moved * 1e3:.2f} mm in the last joint round; more rounds "
            "(merge.scan_rounds) may help"
        )
    return tuple(told)
