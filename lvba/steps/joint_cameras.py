"""The steps that make the cameras of all parts one: merged, then one joint problem in rounds."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lvba import geometry
from lvba.arrays import Indices, Times
from lvba.blocks import visual_block, visual_joint
from lvba.blocks.decoded_images import Keyframes, keyframe_images
from lvba.blocks.pieces import Pieces
from lvba.blocks.split import Frames, Part
from lvba.blocks.survey import Survey
from lvba.blocks.visual_block import CameraBlock, CameraPoints
from lvba.blocks.visual_joint import JointCameras
from lvba.dataset import Dataset
from lvba.optim.shared_parameters import common_sigma
from lvba.steps import joint_prior
from lvba.steps.lidar import carry_cameras
from lvba.steps.outcomes import LidarStage, MapPlanes, ScanPoses, VisualStage
from lvba.steps.visual import inputs
from lvba.trajectory import Trajectory
from lvba.visual import (
    calibration_prior,
    covariance,
    exposures_between,
    fixed_calibration,
    image_groups,
    radiometry,
    trajectory_prior,
)
from lvba.visual.clock import common_calibration
from lvba.visual.config import VisualConfig
from lvba.visual.exposure_graph import Edges
from lvba.visual.image import measuring_camera
from lvba.visual.result import LevelReport, VisualResult
from lvba.visual.states import Calibration, CameraStates, VisualState
from lvba.visual.trajectory_prior import Prior
from lvba.wording import first_of

_NAMED = 8
"""Parts that a warning names."""


@dataclass(frozen=True)
class ImageSeam:
    """Two neighboring parts at the images that both solved.

    images: how many; offset_before_m, offset_before_deg: median difference of their poses
    exposure_ratio: scale of the later part's exposures over that of the earlier one; spread_percent: residual without it
    """

    first: int
    second: int
    images: int
    offset_before_m: float
    offset_before_deg: float
    exposure_ratio: float
    spread_percent: float


@dataclass(frozen=True)
class MergedCameras:
    """All keyframes in one frame and on one scale of exposures. cameras: None where no part could be solved."""

    cameras: JointCameras | None
    seams: tuple[ImageSeam, ...]
    problem: str = ""


def merge_cameras(
    dataset: Dataset,
    cores: Sequence[Part],
    stages: Sequence[VisualStage],
    lidar: LidarStage,
    scans: ScanPoses,
    survey: Survey,
    config: VisualConfig,
    align: bool = True,
) -> MergedCameras:
    """Each keyframe as the part has it whose core it is in; one scale of exposures; the parts' mean calibration."""
    results = joint_prior.results_of(stages)
    if not results:
        return MergedCameras(None, (), stages[0].problem)
    scale, seams = _exposure_scales(cores, stages)
    if not align:
        scale = np.zeros(len(cores))
    carried = carry_cameras(dataset, scans.world_from_scan)
    poses, log_exposure = carried.copy(), np.zeros(len(carried))
    sigma = np.full(len(carried), np.inf)
    for core, part, shift in zip(cores, stages, scale, strict=True):
        if part.result is None:
            continue
        mine, own = slice(*core.core_images), core.core_of_images
        poses[mine] = part.result.world_from_camera[own]
        log_exposure[mine] = part.result.log_exposure[own] + shift
        sigma[mine] = part.result.log_exposure_sigma[own]
    keyframes = survey.keyframes
    prior = joint_prior.prior_of_keyframes(dataset, cores, stages, lidar, scans, survey, config)
    state = VisualState(
        CameraStates(poses[keyframes], log_exposure[keyframes] - log_exposure[keyframes[0]]),
        common_calibration(results, prior.epoch),
        joint_prior.motion_of_keyframes(cores, stages, survey),
    )
    converged = all(len(result.degenerate_common) for result in results)
    return MergedCameras(
        JointCameras(
            state=state,
            before=state,
            prior=prior,
            exposure_sigma=sigma[keyframes],
            converged=converged,
            radiometry=radiometry.mean([result.radiometry for result in results]),
        ),
        seams,
    )


def _exposure_scales(
    cores: Sequence[Part], stages: Sequence[VisualStage]
) -> tuple[np.ndarray, tuple[ImageSeam, ...]]:
    """What to add to each part's log exposures so that parts agree on the images they share, (parts,), and the seams."""
    rows, values, seams = [], [], []
    for b, later in enumerate(stages):
        for a, earlier in enumerate(stages[:b]):
            low = max(cores[a].images[0], cores[b].images[0])
            high = min(cores[a].images[1], cores[b].images[1])
            if high <= low or earlier.result is None or later.result is None:
                continue
            mine = slice(low - cores[a].images[0], high - cores[a].images[0])
            other = slice(low - cores[b].images[0], high - cores[b].images[0])
            difference = earlier.result.log_exposure[mine] - later.result.log_exposure[other]
            middle = float(np.median(difference))
            row = np.zeros(len(stages))
            row[a], row[b] = -1.0, 1.0
            rows.append(row * np.sqrt(high - low))
            values.append(middle * np.sqrt(high - low))
            apart = (
                geometry.inverse(earlier.result.world_from_camera[mine])
                @ later.result.world_from_camera[other]
            )
            seams.append(
                ImageSeam(
                    first=a,
                    second=b,
                    images=high - low,
                    offset_before_m=float(np.median(np.linalg.norm(apart[:, :3, 3], axis=1))),
                    offset_before_deg=float(np.median(geometry.rotation_angle_deg(apart))),
                    exposure_ratio=float(np.exp(-middle)),
                    spread_percent=float(100 * np.std(difference)),
                )
            )
    if not rows:
        return np.zeros(len(stages)), ()
    scale = np.linalg.lstsq(np.array(rows), np.array(values), rcond=None)[0]
    return scale - scale[0], tuple(seams)


def select_points(
    dataset: Dataset,
    frames: Frames,
    keyframes: Pieces[Keyframes],
    lidar: LidarStage,
    planes: MapPlanes,
    stage: VisualStage,
    merged: MergedCameras,
    survey: Survey,
    config: VisualConfig,
) -> CameraPoints | None:
    """The scene points of a part's core at the merged poses; None where the part has nothing to say.

    dataset, frames, keyframes, planes: of the part with what others took at the same place; stage: of the part
    """
    now = merged.cameras
    if now is None or stage.tuning is None or planes.problem:
        return None
    numbers = frames.images[planes.keyframes]
    among = np.searchsorted(survey.keyframes, numbers)
    core = (numbers >= frames.core_images[0]) & (numbers < frames.core_images[1])
    given = inputs(dataset, frames, keyframes, lidar, planes, config)
    prior = None if now.prior is None else trajectory_prior.take(now.prior, among)
    return visual_block.select_scene_points(
        given, _state_of(now, among), among, core, stage.tuning, prior, now.radiometry, config
    )


def _state_of(now: JointCameras, images: np.ndarray) -> VisualState:
    cameras, motion = now.state.cameras, now.state.motion
    return VisualState(
        CameraStates(cameras.world_from_camera[images], cameras.log_exposure[images]),
        now.state.calibration,
        None if motion is None else motion[images],
    )


def exposure_pairs(points: CameraPoints | None) -> Edges | None:
    """How much brighter images of a part are than others; None where that was not measured."""
    return None if points is None else points.edges


def solve_exposures(merged: MergedCameras, edges: Sequence[Edges | None]) -> MergedCameras:
    """Exposures of all keyframes at once, from the pairs that all parts measured."""
    if merged.cameras is None:
        return merged
    return replace(
        merged,
        cameras=visual_joint.with_exposures(merged.cameras, [each for each in edges if each is not None]),
    )


def linearize_cameras(
    dataset: Dataset,
    keyframes: Pieces[Keyframes],
    stage: VisualStage,
    read_points: Callable[[], CameraPoints | None],
    merged: MergedCameras,
    survey: Survey,
    config: VisualConfig,
) -> CameraBlock | None:
    """A part's normal equations at the state so far; None where that has converged, or the part has nothing to say."""
    now = merged.cameras
    if now is None or stage.tuning is None or now.converged:
        return None
    points = read_points()
    if points is None:
        return None
    state = _state_of(now, points.images)
    camera = measuring_camera(dataset.camera)
    images = keyframe_images(keyframes, survey.keyframes[points.images])
    prior = None if now.prior is None else trajectory_prior.take(now.prior, points.images)
    return visual_block.linearize(
        images, camera, points, state, stage.tuning, prior, dataset.camera, now.radiometry, config
    )


def step_cameras(merged: MergedCameras, blocks: Sequence[CameraBlock | None]) -> MergedCameras:
    """One round of the joint problem."""
    known = [each for each in blocks if each is not None]
    if merged.cameras is None or not known:
        return merged
    return replace(merged, cameras=visual_joint.step(merged.cameras, known))


def finish_cameras(
    dataset: Dataset,
    cores: Sequence[Part],
    stages: Sequence[VisualStage],
    merged: MergedCameras,
    lidar: LidarStage,
    scans: ScanPoses,
    survey: Survey,
    config: VisualConfig,
) -> VisualStage:
    """The result for all images."""
    now = merged.cameras
    if now is None:
        return VisualStage(None, merged.problem)
    times, keyframes = dataset.images.times, survey.keyframes
    prior = joint_prior.prior_of_all(dataset, lidar, scans, config)
    poses, calibration = cameras_of_all(now, prior, stages, keyframes, times)
    log_exposure, exposure_sigma = exposures_between.of_all(
        times, keyframes, now.state.cameras.log_exposure, now.exposure_sigma
    )
    results = joint_prior.results_of(stages)
    spread, local_covariance, own_covariance = _of_parts(cores, stages, len(times))
    if lidar.result is not None and scans.verdict.accepted:
        where = Trajectory(dataset.scans.times, scans.world_from_scan)
        known = lidar.result.shared_factor * lidar.result.covariance
        if (unsolved := ~np.isfinite(spread[:, 0, 0])).any():
            own = trajectory_prior.expected_spread(
                prior, _of_keyframes(now, prior, keyframes), calibration, keyframes
            )
            spread[unsolved] = (covariance.of_map(poses, times, where, known) + own)[unsolved]
    degenerate = np.zeros(len(times), np.int32)
    for core, part in zip(cores, stages, strict=True):
        if part.result is not None:
            degenerate[slice(*core.core_images)] = part.result.degenerate[core.core_of_images]
    sigma = common_sigma([result.calibration_sigma for result in results])
    balance = _white_balance(cores, stages, len(times))
    fewest = min(results, key=lambda result: len(result.degenerate_common))
    return VisualStage(
        VisualResult(
            world_from_camera=poses,
            log_exposure=log_exposure,
            covariance=spread,
            local_covariance=local_covariance,
            own_covariance=own_covariance,
            log_exposure_sigma=np.hypot(exposure_sigma, balance),
            keyframes=keyframes,
            calibration=calibration,
            calibration_sigma=sigma,
            degenerate=degenerate,
            degenerate_common=fewest.degenerate_common,
            levels=_levels(results),
            cost_initial=float(sum(result.cost_initial for result in results)),
            cost_final=float(sum(result.cost_final for result in results)),
            converged=all(result.converged for result in results),
            warnings=(*_warnings(cores, stages), *_of_white_balance(balance)),
            radiometry=now.radiometry,
            extrinsic_change=calibration_prior.extrinsic_change(
                calibration, prior.calibration, np.diag(sigma**2)
            ),
            clock_epoch=prior.epoch,
            turns=_turns(cores, stages, len(times)),
            group=_groups(cores, stages, keyframes, len(times)),
        )
    )


def cameras_of_all(
    now: JointCameras, prior: Prior, stages: Sequence[VisualStage], keyframes: Indices, times: Times
) -> tuple[np.ndarray, Calibration]:
    """Poses (I, 4, 4) of all images, and the calibration, after the last round.

    prior: of all I images; keyframes: (K,); times: (I,) s
    """
    poses, _ = trajectory_prior.fill(prior, _of_keyframes(now, prior, keyframes), now.state, keyframes, times)
    reference = prior.calibration.reference
    return poses, fixed_calibration.restored(
        now.state.calibration, reference, joint_prior.fixed_in_all(stages)
    )


def _of_keyframes(now: JointCameras, prior: Prior, keyframes: Indices) -> Prior:
    """The prior of keyframes (K,) with the sigmas of the last round; as that of all images has it where there is none."""
    return trajectory_prior.take(prior, keyframes) if now.prior is None else now.prior


def _of_parts(
    cores: Sequence[Part], stages: Sequence[VisualStage], images: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(I, 6, 6) covariance of each camera as the part of its core has it, that relative to the map around it, and the
    part of that that is its own; NaN where that was not solved."""
    spread, local_covariance, own_covariance = np.full((3, images, 6, 6), np.nan)
    for core, part in zip(cores, stages, strict=True):
        if part.result is not None:
            mine, own = slice(*core.core_images), core.core_of_images
            spread[mine] = part.result.covariance[own]
            local_covariance[mine] = part.result.local_covariance[own]
            own_covariance[mine] = part.result.own_covariance[own]
    return spread, local_covariance, own_covariance


def _turns(cores: Sequence[Part], stages: Sequence[VisualStage], images: int) -> np.ndarray | None:
    """As `VisualResult.turns`, each image as the part of its core has it."""
    turns = np.zeros((images, 3))
    for core, part in zip(cores, stages, strict=True):
        if part.result is not None and part.result.turns is not None:
            turns[slice(*core.core_images)] = part.result.turns[core.core_of_images]
    return turns if turns.any() else None


def _groups(
    cores: Sequence[Part], stages: Sequence[VisualStage], keyframes: Indices, images: int
) -> np.ndarray:
    """As `VisualResult.group`, of so many images. keyframes: (K,), of all parts"""
    known = []
    for core, part in zip(cores, stages, strict=True):
        if part.result is not None and len(part.result.group):
            own = part.result.keyframes
            known.append((core.images[0] + own, part.result.group[own]))
    group = np.full(images, -1)
    group[keyframes] = image_groups.of_all(known, images)[keyframes]
    return group


def _levels(results: Sequence[VisualResult]) -> tuple[LevelReport, ...]:
    """The report of every level over all parts; images shared by two parts count in both."""
    return tuple(_level(rows) for rows in zip(*(result.levels for result in results), strict=True))


def _level(rows: Sequence[LevelReport]) -> LevelReport:
    # of the part where fewest patches look alike: wrong images of one are an alarm, however many parts are right
    strangest = min(rows, key=lambda row: row.alike / row.compared if row.compared else np.inf)
    # nor are images of one that contradict each other
    worst = max(rows, key=lambda row: row.variance_factor / row.noise_variance_factor)
    return replace(
        rows[0],
        scene_points=sum(row.scene_points for row in rows),
        global_points=sum(row.global_points for row in rows),
        local_pairs=sum(row.local_pairs for row in rows),
        global_pairs=sum(row.global_pairs for row in rows),
        sigma=float(np.mean([row.sigma for row in rows])),
        shift=float(np.mean([row.shift for row in rows])),
        rms=float(np.mean([row.rms for row in rows])),
        variance_factor=worst.variance_factor,
        noise_variance_factor=worst.noise_variance_factor,
        iterations=tuple(entry for row in rows for entry in row.iterations),
        converged=all(row.converged for row in rows),
        compared=strangest.compared,
        alike=strangest.alike,
    )


def _warnings(cores: Sequence[Part], stages: Sequence[VisualStage]) -> tuple[str, ...]:
    """What the parts warn of; what several warn of, once."""
    parts_of: dict[str, list[int]] = {}
    for core, part in zip(cores, stages, strict=True):
        texts = (
            [f"no visual solution ({part.problem}); cameras move with the scans there"]
            if part.result is None
            else part.result.warnings
        )
        for text in texts:
            parts_of.setdefault(text, []).append(core.number + 1)
    return tuple(f"{_parts(numbers)} of {len(cores)}: {text}" for text, numbers in parts_of.items())


def _parts(numbers: Sequence[int]) -> str:
    return f"part{'s' if len(numbers) > 1 else ''} {first_of([str(number) for number in numbers], _NAMED)}"


def _white_balance(cores: Sequence[Part], stages: Sequence[VisualStage], images: int) -> np.ndarray:
    """(images,): root mean square over the colors of how far each is off the exposure of its image (logarithms)."""
    off = np.zeros(images)
    for core, part in zip(cores, stages, strict=True):
        if part.result is not None and part.result.white_balance is not None:
            gain = part.result.white_balance[core.core_of_images]
            off[slice(*core.core_images)] = np.sqrt(np.square(gain).mean(axis=1))
    return off


def _of_white_balance(off: np.ndarray) -> tuple[str, ...]:
    if not off.any():
        return ()
    size = 100 * float(np.sqrt(np.square(off).mean()))
    return (
        f"The white balance changes between images by {size:.1f} % (root mean square). In a recording in parts, "
        "exposures are those of grey values, and depend on what images show by about as much",
    )
