"""The cameras of all parts: merged, then one joint problem in rounds."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lvba import geometry
from lvba.blocks import visual_block, visual_joint
from lvba.blocks.lidar_steps import JointScans
from lvba.blocks.split import Frames, Part
from lvba.blocks.survey import Survey, keyframes_of
from lvba.blocks.visual_block import CameraPoints, CameraShare
from lvba.blocks.visual_joint import JointCameras
from lvba.blocks.visual_steps import Ground, PartCameras, inputs
from lvba.dataset import Dataset
from lvba.products.views import nearest_in_time
from lvba.steps.lidar import carry_cameras
from lvba.steps.outcomes import ScanPoses, VisualStage
from lvba.trajectory import Trajectory
from lvba.visual import covariance
from lvba.visual import trajectory_prior as priors
from lvba.visual.exposure_graph import Edges
from lvba.visual.image import measuring_camera
from lvba.visual.refine import VisualConfig, VisualResult
from lvba.visual.result import LevelReport
from lvba.visual.states import CameraStates, Mount, VisualState
from lvba.visual.trajectory_prior import Prior


@dataclass(frozen=True)
class ImageSeam:
    """Two neighboring parts at the images that both solved.

    images: how many; jump_m, jump_deg: median difference of their poses; exposure_ratio: by which the later part's
    exposures were off the earlier one's scale; spread_percent: what is left of the difference
    """

    first: int
    second: int
    images: int
    jump_m: float
    jump_deg: float
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
    found: Sequence[PartCameras],
    joint_scans: JointScans,
    scans: ScanPoses,
    survey: Survey,
    config: VisualConfig,
    align: bool = True,
) -> MergedCameras:
    """Each keyframe as the part has it whose core it is in; one scale of exposures; the mount all parts agree on."""
    solved = [part for part in found if part.result is not None]
    if not solved:
        return MergedCameras(None, (), found[0].problem)
    scale, seams = _exposure_scales(cores, found)
    if not align:
        scale = np.zeros(len(cores))
    carried = carry_cameras(dataset, scans.world_from_scan)
    poses, log_exposure = carried.copy(), np.zeros(len(carried))
    sigma = np.full(len(carried), np.inf)
    for core, part, shift in zip(cores, found, scale, strict=True):
        if part.result is None:
            continue
        mine, own = slice(*core.core_images), core.core_of_images
        poses[mine] = part.result.world_from_camera[own]
        log_exposure[mine] = part.result.log_exposure[own] + shift
        sigma[mine] = part.result.log_exposure_sigma[own]
    keyframes = survey.keyframes
    state = VisualState(
        CameraStates(poses[keyframes], log_exposure[keyframes] - log_exposure[keyframes[0]]),
        _common_mount(dataset, [part.result for part in solved if part.result is not None]),
    )
    prior = _prior(dataset, cores, found, joint_scans, scans, survey, config)
    settled = all(part.result is not None and len(part.result.weak_common) for part in solved)
    return MergedCameras(JointCameras(state, state, prior, sigma[keyframes], settled=settled), seams)


def _exposure_scales(
    cores: Sequence[Part], found: Sequence[PartCameras]
) -> tuple[np.ndarray, tuple[ImageSeam, ...]]:
    """What to add to each part's log exposures so that parts agree on the images they share, (parts,), and the seams."""
    rows, values, seams = [], [], []
    for b, later in enumerate(found):
        for a, earlier in enumerate(found[:b]):
            low = max(cores[a].images[0], cores[b].images[0])
            high = min(cores[a].images[1], cores[b].images[1])
            if high <= low or earlier.result is None or later.result is None:
                continue
            mine = slice(low - cores[a].images[0], high - cores[a].images[0])
            other = slice(low - cores[b].images[0], high - cores[b].images[0])
            difference = earlier.result.log_exposure[mine] - later.result.log_exposure[other]
            middle = float(np.median(difference))
            row = np.zeros(len(found))
            row[a], row[b] = -1.0, 1.0
            rows.append(row * np.sqrt(high - low))
            values.append(middle * np.sqrt(high - low))
            apart = (
                geometry.inverse(earlier.result.world_from_camera[mine])
                @ later.result.world_from_camera[other]
            )
            seams.append(
                ImageSeam(
                    a,
                    b,
                    high - low,
                    float(np.median(np.linalg.norm(apart[:, :3, 3], axis=1))),
                    float(np.median(geometry.rotation_angle_deg(apart))),
                    float(np.exp(-middle)),
                    float(100 * np.std(difference)),
                )
            )
    if not rows:
        return np.zeros(len(found)), ()
    scale = np.linalg.lstsq(np.array(rows), np.array(values), rcond=None)[0]
    return scale - scale[0], tuple(seams)


def _common_mount(dataset: Dataset, results: Sequence[VisualResult]) -> Mount:
    """The mean of the parts' mounts, each weighed by what its part knows of it."""
    calibrated = geometry.inverse(dataset.camera_from_scan)
    change = np.array(
        [
            [*geometry.log(geometry.inverse(calibrated) @ result.scan_from_camera), result.time_offset]
            for result in results
        ]
    )
    weight = np.array([1 / np.maximum(result.mount_sigma, 1e-12) ** 2 for result in results])
    mean = (weight * change).sum(0) / weight.sum(0)
    return Mount(geometry.retract(calibrated, mean[:6]), float(mean[6]))


def _prior_of_all(dataset: Dataset, joint_scans: JointScans, scans: ScanPoses, config: VisualConfig) -> Prior:
    """Of all images, with sigmas as first guessed."""
    off_map = None
    if joint_scans.lidar.result is not None and scans.verdict.accepted:
        off_map = joint_scans.lidar.result.conditional_covariance
    return priors.build(
        dataset.scans, scans.world_from_scan, dataset.images, dataset.camera_from_scan, config.prior, off_map
    )


def _prior(
    dataset: Dataset,
    cores: Sequence[Part],
    found: Sequence[PartCameras],
    joint_scans: JointScans,
    scans: ScanPoses,
    survey: Survey,
    config: VisualConfig,
) -> Prior:
    """Of all keyframes, with the sigmas that the parts found."""
    prior = priors.take(_prior_of_all(dataset, joint_scans, scans, config), survey.keyframes)
    sources = []
    for number, source in enumerate(prior.sources):
        rotation, position = source.sigma_rotation.copy(), source.sigma_position.copy()
        memories = []
        for core, part in zip(cores, found, strict=True):
            if part.tuning is None or number >= len(part.tuning.memory):
                continue
            local = core.image_numbers[keyframes_of(survey, core.frames)]
            inside = (local >= core.core_images[0]) & (local < core.core_images[1])
            mine = np.searchsorted(survey.keyframes, local[inside])
            rotation[mine] = part.tuning.sigma_rotation[number][inside]
            position[mine] = part.tuning.sigma_position[number][inside]
            memories.append(part.tuning.memory[number])
        memory = tuple(float(value) for value in np.mean(memories, axis=0)) if memories else source.memory
        sources.append(
            replace(source, sigma_rotation=rotation, sigma_position=position, memory=(memory[0], memory[1]))
        )
    tunings = [part.tuning for part in found if part.tuning is not None]
    counts = [tuning.mount_information for tuning in tunings if tuning.mount_information is not None]
    # what images tell and how far they contradict it both add up over the parts: their ratio is a mean
    mean = np.mean(counts, axis=0) if counts else None
    return replace(prior, sources=tuple(sources), mount_information=mean)


def lay_out(
    dataset: Dataset,
    frames: Frames,
    pictures: np.ndarray,
    below: Ground,
    found: PartCameras,
    merged: MergedCameras,
    survey: Survey,
    config: VisualConfig,
) -> CameraPoints | None:
    """The scene points of a part's core at the merged poses; none where the part has nothing to say.

    dataset, frames, pictures (`undistorted`), below: of the part with what others took at the same place; found: of the
    part
    """
    now = merged.cameras
    if now is None or found.tuning is None or below.problem:
        return None
    numbers = frames.images[below.keyframes]
    images = np.searchsorted(survey.keyframes, numbers)
    core = (numbers >= frames.core_images[0]) & (numbers < frames.core_images[1])
    given = inputs(dataset, pictures, below, config)
    return visual_block.lay_out(given, _state_of(now, images), images, core, found.tuning, config)


def _state_of(now: JointCameras, images: np.ndarray) -> VisualState:
    cameras = now.state.cameras
    return VisualState(
        CameraStates(cameras.world_from_camera[images], cameras.log_exposure[images]), now.state.mount
    )


def brightness(laid: CameraPoints | None) -> Edges | None:
    """What a part measured of the brightness of its images; None where it did not."""
    return None if laid is None else laid.edges


def tie_exposures(merged: MergedCameras, found: Sequence[Edges | None]) -> MergedCameras:
    """Exposures of all keyframes at once, from the brightness that all parts measured."""
    if merged.cameras is None:
        return merged
    return replace(
        merged,
        cameras=visual_joint.with_exposures(merged.cameras, [each for each in found if each is not None]),
    )


def linearize_cameras(
    dataset: Dataset,
    read_pictures: Callable[[], np.ndarray],
    found: PartCameras,
    read_laid: Callable[[], CameraPoints | None],
    merged: MergedCameras,
    config: VisualConfig,
) -> CameraShare | None:
    """A part's share at the state so far; none where that has settled, or the part has nothing to say."""
    now = merged.cameras
    if now is None or found.tuning is None or now.settled:
        return None
    laid = read_laid()
    if laid is None:
        return None
    state = _state_of(now, laid.images)
    camera = measuring_camera(dataset.camera)
    return visual_block.linearize(read_pictures(), camera, laid, state, found.tuning, config)


def step_cameras(merged: MergedCameras, found: Sequence[CameraShare | None]) -> MergedCameras:
    """One round of the joint problem."""
    known = [each for each in found if each is not None]
    if merged.cameras is None or not known:
        return merged
    return replace(merged, cameras=visual_joint.step(merged.cameras, known))


def finish_cameras(
    dataset: Dataset,
    cores: Sequence[Part],
    found: Sequence[PartCameras],
    merged: MergedCameras,
    joint_scans: JointScans,
    scans: ScanPoses,
    survey: Survey,
    config: VisualConfig,
) -> VisualStage:
    """The result for all images."""
    now = merged.cameras
    if now is None:
        return VisualStage(None, merged.problem)
    times, keyframes = dataset.images.times, survey.keyframes
    prior = _prior_of_all(dataset, joint_scans, scans, config)
    solved = now.prior if now.prior is not None else priors.take(prior, keyframes)
    poses, _ = priors.fill(prior, solved, now.state, keyframes, times)
    log_exposure = np.interp(times, times[keyframes], now.state.cameras.log_exposure)
    results = [part.result for part in found if part.result is not None]
    spread, on_map = _of_parts(cores, found, len(times))
    if joint_scans.lidar.result is not None and scans.verdict.accepted:
        where = Trajectory(dataset.scans.times, scans.world_from_scan)
        unsolved = ~np.isfinite(spread[:, 0, 0])
        spread[unsolved] = covariance.of_map(poses, times, where, joint_scans.lidar.result.covariance)[
            unsolved
        ]
    nearest = nearest_in_time(times[keyframes], times)
    weak = np.zeros(len(times), np.int32)
    for core, part in zip(cores, found, strict=True):
        if part.result is not None:
            weak[slice(*core.core_images)] = part.result.weak[core.core_of_images]
    fewest = min(results, key=lambda result: len(result.weak_common))
    return VisualStage(
        VisualResult(
            world_from_camera=poses,
            log_exposure=log_exposure - log_exposure[0],
            covariance=spread,
            covariance_on_map=on_map,
            log_exposure_sigma=now.exposure_sigma[nearest],
            keyframes=keyframes,
            scan_from_camera=now.state.mount.scan_from_camera,
            time_offset=now.state.mount.time_offset,
            mount_sigma=1 / np.sqrt(np.sum([1 / result.mount_sigma**2 for result in results], axis=0)),
            weak=weak,
            weak_common=fewest.weak_common,
            levels=_levels(results),
            cost_initial=float(sum(result.cost_initial for result in results)),
            cost_final=float(sum(result.cost_final for result in results)),
            converged=all(result.converged for result in results),
            warnings=_warnings(cores, found),
        )
    )


def _of_parts(
    cores: Sequence[Part], found: Sequence[PartCameras], images: int
) -> tuple[np.ndarray, np.ndarray]:
    """(I, 6, 6) covariance of each camera as the part of its core has it, and that relative to the map around it; NaN
    where that was not solved."""
    spread, on_map = np.full((2, images, 6, 6), np.nan)
    for core, part in zip(cores, found, strict=True):
        if part.result is not None:
            mine, own = slice(*core.core_images), core.core_of_images
            spread[mine] = part.result.covariance[own]
            on_map[mine] = part.result.covariance_on_map[own]
    return spread, on_map


def _levels(results: Sequence[VisualResult]) -> tuple[LevelReport, ...]:
    """The account of every level over all parts; images shared by two parts count in both."""
    return tuple(_level(rows) for rows in zip(*(result.levels for result in results), strict=True))


def _level(rows: Sequence[LevelReport]) -> LevelReport:
    return replace(
        rows[0],
        scene_points=sum(row.scene_points for row in rows),
        global_points=sum(row.global_points for row in rows),
        local_pairs=sum(row.local_pairs for row in rows),
        global_pairs=sum(row.global_pairs for row in rows),
        sigma=float(np.mean([row.sigma for row in rows])),
        shift=float(np.mean([row.shift for row in rows])),
        rms=float(np.mean([row.rms for row in rows])),
        inflation=max(row.inflation for row in rows),  # an alarm: one part is enough
        iterations=tuple(entry for row in rows for entry in row.iterations),
        converged=all(row.converged for row in rows),
    )


def _warnings(cores: Sequence[Part], found: Sequence[PartCameras]) -> tuple[str, ...]:
    told = []
    for core, part in zip(cores, found, strict=True):
        name = f"part {core.number + 1} of {len(cores)}"
        if part.result is None:
            told.append(f"{name} has no visual solution ({part.problem}); its cameras move with the scans")
        else:
            told += [f"{name}: {warning}" for warning in part.result.warnings]
    return tuple(told)
