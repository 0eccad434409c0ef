"""The stages of the chain as plain functions: each reads what it needs from the recording and the stages before it."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lvba import gate, geometry, recorded_images, trajectory
from lvba.dataset import Dataset, Scan
from lvba.errors import DegenerateProblemError
from lvba.gate import CARRIED, EXPOSED, ROUGH, VISUAL, GateConfig, Verdict
from lvba.io import dataset as recordings
from lvba.lidar import bundle_adjustment as lidar_ba
from lvba.lidar.bundle_adjustment import LidarConfig, LidarResult
from lvba.lidar.covariance import Covariance
from lvba.lidar.plane import PlanePoints, Planes
from lvba.products import evaluate as evaluation
from lvba.products import map_file, map_quality, pictures
from lvba.products.cloud import Cloud, assemble, thin
from lvba.products.evaluate import EvaluateConfig, Scores, State
from lvba.products.map_file import MapConfig, PointMap
from lvba.products.map_quality import EntropyConfig
from lvba.products.pictures import Pictures
from lvba.progress import Progress, silent
from lvba.recorded_images import views_of
from lvba.visual import image, keyframes
from lvba.visual import refine as visual_refine
from lvba.visual.refine import VisualConfig, VisualResult


@dataclass(frozen=True)
class LidarStage:
    """What the LiDAR stage found; nothing where it could not be solved."""

    result: LidarResult | None
    problem: str = ""


@dataclass(frozen=True)
class ScanPoses:
    """The scan poses that everything after uses.

    world_from_scan: (S, 4, 4) float64
    entropy_rough, entropy_refined: mean map entropy, nats
    """

    world_from_scan: np.ndarray
    verdict: Verdict
    entropy_rough: float
    entropy_refined: float


@dataclass(frozen=True)
class VisualStage:
    """What the visual stage found; nothing where there are no images or it could not be solved."""

    result: VisualResult | None
    problem: str = ""


@dataclass(frozen=True)
class VisualLevel:
    """What the visual stage found down to one pyramid level; nothing where it could not be solved."""

    found: visual_refine.Coarser | None
    problem: str = ""


@dataclass(frozen=True)
class Accepted:
    """The state that is the result.

    world_from_scan: (S, 4, 4), world_from_camera: (I, 4, 4) float64; log_exposure: (I,) float64
    """

    world_from_scan: np.ndarray
    world_from_camera: np.ndarray
    log_exposure: np.ndarray
    scans: Verdict
    cameras: Verdict
    exposures: Verdict
    state: str
    """Which of the judged states this is."""
    remark: str = ""


def solve_lidar(
    dataset: Dataset, config: LidarConfig, enabled: bool = True, progress: Progress = silent
) -> LidarStage:
    """Scan poses, planes and what is known about them, from the scans and their rough poses."""
    if not enabled:
        return LidarStage(None, "LiDAR bundle adjustment is switched off (refine_scans)")
    try:
        scans = recordings.load_scans(dataset)
        result = lidar_ba.refine(
            scans,
            dataset.scans.world_from_sensor,
            sensor_position=dataset.sensor_position_scan,
            config=config,
            progress=progress,
        )
    except DegenerateProblemError as error:
        return LidarStage(None, str(error))
    return LidarStage(result)


def judge_lidar(
    dataset: Dataset,
    lidar: LidarStage,
    entropy: EntropyConfig,
    config: GateConfig,
    progress: Progress = silent,
) -> ScanPoses:
    """The refined scan poses where they make a crisper map, else the input's."""
    rough = dataset.scans.world_from_sensor
    before = map_quality.mean_map_entropy(cloud_of(dataset, rough, progress), entropy)
    if lidar.result is None:
        verdict = Verdict(False, f"input poses kept: {lidar.problem}")
        return ScanPoses(rough, verdict, before, before)
    refined = lidar.result.world_from_scan
    after = map_quality.mean_map_entropy(cloud_of(dataset, refined, progress), entropy)
    verdict = gate.judge_scans(before, after, config)
    return ScanPoses(refined if verdict.accepted else rough, verdict, before, after)


def carry_cameras(dataset: Dataset, world_from_scan: np.ndarray) -> np.ndarray:
    """Rough camera poses moved along with the scans, (I, 4, 4). Source: Li et al., eq. (1)."""
    moved = trajectory.interpolate_corrections(dataset.scans, world_from_scan, dataset.images.times)
    return geometry.orthonormalize(moved @ dataset.images.world_from_sensor)


def cloud_of(dataset: Dataset, world_from_scan: np.ndarray, progress: Progress = silent) -> Cloud:
    """All scans in the world frame."""
    return assemble(
        lambda index: recordings.load_scan(dataset, index).points,
        world_from_scan,
        dataset.scans.times,
        progress,
    )


def visual_levels(dataset: Dataset, config: VisualConfig) -> int:
    """How many pyramid levels the visual stage goes through."""
    return image.usable_levels(dataset.camera, config.levels) if dataset.image_paths else 1


def solve_visual_level(
    dataset: Dataset,
    lidar: LidarStage,
    scans: ScanPoses,
    coarser: VisualLevel,
    lidar_config: LidarConfig,
    config: VisualConfig,
    enabled: bool = True,
    progress: Progress = silent,
) -> VisualLevel:
    """One pyramid level more than `coarser`, which is empty at first."""
    problem = _why_not(dataset, enabled) or coarser.problem
    if problem:
        return VisualLevel(None, problem)
    try:
        given = visual_inputs(dataset, lidar, scans, lidar_config, config, progress, keep=True)
        found = visual_refine.refine_level(given, coarser.found, config, progress)
    except DegenerateProblemError as error:
        return VisualLevel(None, str(error))
    return VisualLevel(found)


def solve_visual(
    dataset: Dataset,
    lidar: LidarStage,
    scans: ScanPoses,
    coarser: VisualLevel,
    lidar_config: LidarConfig,
    config: VisualConfig,
    enabled: bool = True,
    progress: Progress = silent,
) -> VisualStage:
    """Camera poses and exposures from the images, over the planes of the scan poses in use: the finest level."""
    problem = _why_not(dataset, enabled) or coarser.problem
    if problem:
        return VisualStage(None, problem)
    try:
        given = visual_inputs(dataset, lidar, scans, lidar_config, config, progress)
        result = visual_refine.refine_finest(given, coarser.found, config, progress)
    except DegenerateProblemError as error:
        return VisualStage(None, str(error))
    return VisualStage(result)


def _why_not(dataset: Dataset, enabled: bool) -> str:
    """Why there is no visual stage; empty: there is one."""
    if not dataset.image_paths:
        return "the recording has no images"
    return "" if enabled else "visual bundle adjustment is switched off (refine_cameras)"


def visual_inputs(
    dataset: Dataset,
    lidar: LidarStage,
    scans: ScanPoses,
    lidar_config: LidarConfig,
    config: VisualConfig,
    progress: Progress = silent,
    *,
    keep: bool = False,
) -> visual_refine.Inputs:
    """What all levels of the visual stage work on.

    keep: the images stay in memory for the next level
    Raises DegenerateProblemError: the scans hold no planes.
    """
    planes, points = planes_in_use(dataset, lidar, scans, lidar_config)
    chosen = keyframes.select(
        dataset.images.times, dataset.images.world_from_sensor, typical_range(dataset), config.keyframes
    )
    levels = visual_levels(dataset, config)
    pyramid = recorded_images.pyramid(dataset, chosen, levels, config.images, progress, keep=keep)
    return visual_refine.Inputs(
        pyramid,
        chosen,
        dataset.images,
        dataset.scans,
        scans.world_from_scan,
        dataset.camera_from_scan,
        dataset.sensor_position_scan,
        planes,
        points,
        _scan_covariance(lidar, scans),
    )


def _scan_covariance(lidar: LidarStage, scans: ScanPoses) -> Covariance | None:
    if lidar.result is None or not scans.verdict.accepted:
        return None
    return Covariance(lidar.result.covariance, lidar.result.conditional_covariance)


def planes_in_use(
    dataset: Dataset, lidar: LidarStage, scans: ScanPoses, config: LidarConfig
) -> tuple[Planes, PlanePoints]:
    """The planes and points of the map at the scan poses in use.

    Raises DegenerateProblemError: the scans hold no planes.
    """
    if lidar.result is not None and scans.verdict.accepted:
        return lidar.result.planes, lidar.result.plane_points
    return lidar_ba.find_planes(
        recordings.load_scans(dataset),
        scans.world_from_scan,
        sensor_position=dataset.sensor_position_scan,
        config=config,
    )


def typical_range(dataset: Dataset, scans: int = 16) -> float:
    """Median distance of the points from the LiDAR, m, over some scans."""
    chosen = np.unique(np.linspace(0, len(dataset.scan_paths) - 1, scans).astype(int))
    ranges = [
        np.linalg.norm(points - dataset.sensor_position_scan, axis=1)
        for points in recordings.load_scans(dataset, list(chosen))
    ]
    every = np.concatenate(ranges)
    every = every[np.isfinite(every)]
    return float(np.median(every)) if len(every) else 1.0


def evaluate(
    dataset: Dataset,
    scans: ScanPoses,
    visual: VisualStage,
    config: EvaluateConfig,
    gates: GateConfig,
    progress: Progress = silent,
) -> dict[str, Scores]:
    """The scores of the input and of what each stage made of it, by name (see `lvba.gate`); empty without images.

    Of states that are neither input nor result there are only the figures that decide; the others are NaN.
    """
    if not dataset.image_paths:
        return {}
    states = judged_states(dataset, scans, visual, progress)
    entropies = {ROUGH: scans.entropy_rough}
    if scans.verdict.accepted:
        entropies[CARRIED] = scans.entropy_refined
    between = {CARRIED, EXPOSED} if VISUAL in states else set()
    scores = evaluation.evaluate(states, config, entropies=entropies, brief=between, progress=progress)
    if choose(scores, visual, gates)[0] in between:
        scores = evaluation.evaluate(states, config, entropies=entropies, progress=progress)
    return scores


def judged_states(
    dataset: Dataset, scans: ScanPoses, visual: VisualStage, progress: Progress = silent
) -> dict[str, State]:
    """Cloud and views of each state that is judged, by name."""
    clouds = {ROUGH: cloud_of(dataset, dataset.scans.world_from_sensor, progress)}
    clouds[CARRIED] = (
        cloud_of(dataset, scans.world_from_scan, progress) if scans.verdict.accepted else clouds[ROUGH]
    )
    base = views_of(dataset)
    return {
        name: State(
            clouds[ROUGH if name == ROUGH else CARRIED],
            dataclasses.replace(base, world_from_camera=poses, log_exposure=log_exposure),
        )
        for name, (poses, log_exposure) in camera_states(dataset, scans, visual).items()
    }


def camera_states(
    dataset: Dataset, scans: ScanPoses, visual: VisualStage
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """World_from_camera (I, 4, 4) and log exposure (I,) of each state that is judged, by name."""
    equal = np.zeros(len(dataset.image_paths))
    carried = carry_cameras(dataset, scans.world_from_scan)
    states = {ROUGH: (dataset.images.world_from_sensor, equal), CARRIED: (carried, equal)}
    if visual.result is not None:
        states[EXPOSED] = (carried, visual.result.log_exposure)
        states[VISUAL] = (visual.result.world_from_camera, visual.result.log_exposure)
    return states


def choose(
    scores: Mapping[str, Scores], visual: VisualStage, config: GateConfig
) -> tuple[str, Verdict, Verdict]:
    """The state that what the visual stage found is used in, with the verdicts on its camera poses and exposures."""
    cameras = exposures = Verdict(False, f"input kept: {visual.problem}")
    if visual.result is not None:
        cameras, exposures = gate.judge_cameras(dict(scores), config)
    return VISUAL if cameras.accepted else EXPOSED if exposures.accepted else CARRIED, cameras, exposures


def decide(
    dataset: Dataset, scans: ScanPoses, visual: VisualStage, scores: Mapping[str, Scores], config: GateConfig
) -> Accepted:
    """The state that predicts the images best, never worse than the input."""
    states = camera_states(dataset, scans, visual)
    chosen, cameras, exposures = choose(scores, visual, config)
    remark = ""
    if scores:
        verdict = gate.judge_all(scores[ROUGH], scores[chosen], config)
        if not verdict.accepted:
            rough = dataset.scans.world_from_sensor
            return Accepted(rough, *states[ROUGH], verdict, verdict, verdict, ROUGH)
        remark = verdict.reason
    return Accepted(scans.world_from_scan, *states[chosen], scans.verdict, cameras, exposures, chosen, remark)


def color_map(
    dataset: Dataset,
    accepted: Accepted,
    config: MapConfig,
    progress: Progress = silent,
    gain: float | None = None,
) -> PointMap:
    """The map that users keep, in the dataset's world frame; without images it shows intensity.

    gain: the exposure it is shown at; None: the typical one
    """
    cloud = cloud_of(dataset, accepted.world_from_scan, progress)
    if not dataset.image_paths:
        return _map_of_intensity(dataset, cloud, config)
    views = dataclasses.replace(
        views_of(dataset), world_from_camera=accepted.world_from_camera, log_exposure=accepted.log_exposure
    )
    return map_file.build(cloud, views, config, progress, gain)


def _map_of_intensity(dataset: Dataset, cloud: Cloud, config: MapConfig) -> PointMap:
    """The thinned cloud, gray by intensity (1st to 99th percentile), all one gray where the scans have none."""
    voxel = max(config.voxel_m, 0.0)
    kept = thin(cloud.points_world, voxel)
    intensity = np.concatenate(
        [_intensities(recordings.load_scan(dataset, i)) for i in range(len(dataset.scans))]
    )
    shown = intensity[kept]
    known = shown[np.isfinite(shown)]
    low, high = np.percentile(known, [1, 99]) if len(known) else (0.0, 0.0)
    gray = np.full(len(kept), map_file.UNCOLORED, np.uint8)
    if high > low:
        scaled = np.nan_to_num((shown - low) / (high - low), nan=0.5)
        gray = np.rint(255 * np.clip(scaled, 0, 1)).astype(np.uint8)
    none = np.zeros(len(kept))
    return PointMap(
        cloud.points_world[kept],
        np.repeat(gray[:, None], 3, axis=1),
        none.astype(np.uint8),
        none.astype(np.float32),
        voxel,
    )


def _intensities(scan: Scan) -> np.ndarray:
    """Of the points that `cloud_of` keeps, in the same order; NaN where the file has none."""
    finite = np.isfinite(scan.points).all(1)
    values = np.full(len(scan), np.nan, np.float32) if scan.intensity is None else scan.intensity
    return values[finite]


def make_pictures(
    dataset: Dataset, accepted: Accepted, scores: dict[str, Scores], config: EvaluateConfig
) -> Pictures | None:
    """Photographs beside renderings from the input and from the result; none where there are no images."""
    if not scores:
        return None
    views = views_of(dataset)
    final = dataclasses.replace(
        views, world_from_camera=accepted.world_from_camera, log_exposure=accepted.log_exposure
    )
    return pictures.make(
        State(cloud_of(dataset, dataset.scans.world_from_sensor), views),
        State(cloud_of(dataset, accepted.world_from_scan), final),
        {"rough": scores[ROUGH], "refined": scores[accepted.state]},
        config.render,
    )
