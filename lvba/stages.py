"""The stages of the chain as plain functions: each reads what it needs from the recording and the stages before it."""

from dataclasses import dataclass

import numpy as np

from lvba import fusion, geometry, recorded_images, trajectory
from lvba.dataset import Dataset
from lvba.errors import DegenerateProblemError
from lvba.fusion import Fused, FusionConfig
from lvba.gate import Verdict
from lvba.io import dataset as recordings
from lvba.lidar import bundle_adjustment as lidar_ba
from lvba.lidar.bundle_adjustment import LidarConfig, LidarResult
from lvba.lidar.covariance import Covariance
from lvba.lidar.plane import PlanePoints, Planes
from lvba.products.cloud import Cloud, assemble
from lvba.products.map_quality import EntropyBlocks
from lvba.progress import Progress, silent
from lvba.trajectory import Trajectory
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
    entropy_rough, entropy_refined: mean map entropy of what was compared, nats
    map_blocks: the map entropy of the poses in use, by block of space
    """

    world_from_scan: np.ndarray
    verdict: Verdict
    entropy_rough: float
    entropy_refined: float
    map_blocks: EntropyBlocks

    @property
    def entropy(self) -> float:
        """Mean map entropy of the poses in use, nats."""
        return self.map_blocks.mean


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
class FusionStage:
    """Where both sensors have the scans; nothing where only one of them knows."""

    result: Fused | None
    problem: str = ""


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
        dataset.sensor_position_scan,
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


def solve_fusion(
    dataset: Dataset,
    lidar: LidarStage,
    scans: ScanPoses,
    visual: VisualStage,
    lidar_config: LidarConfig,
    config: FusionConfig,
) -> FusionStage:
    """The scans with what the refined cameras know about them."""
    if not config.enabled:
        return FusionStage(None, "scans do not learn from the cameras (fusion.enabled is false)")
    covariance = _scan_covariance(lidar, scans)
    if lidar.result is None or covariance is None:
        return FusionStage(None, "the scans were not refined")
    if visual.result is None:
        return FusionStage(None, f"there are no refined cameras: {visual.problem}")
    found, known = visual.result, visual.result.keyframes
    cameras = fusion.seen_from(
        found.world_from_camera[known],
        dataset.images.times[known],
        found.covariance_on_map[known],
        found.scan_from_camera,
        found.time_offset,
        found.mount_sigma,
    )
    fused = fusion.fuse(
        Trajectory(dataset.scans.times, scans.world_from_scan),
        covariance,
        cameras,
        lidar.result.weak_directions,
        lidar_config.prior_sigmas,
        config,
    )
    return FusionStage(fused, "" if fused else "too few cameras")


def _scan_covariance(lidar: LidarStage, scans: ScanPoses) -> Covariance | None:
    if lidar.result is None or not scans.verdict.accepted:
        return None
    found = lidar.result
    return Covariance(found.covariance, found.conditional_covariance, found.step_covariance)


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
