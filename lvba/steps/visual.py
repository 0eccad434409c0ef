"""The steps that refine cameras, one pyramid level each."""

from lvba.dataset import Dataset
from lvba.errors import DegenerateProblemError
from lvba.lidar.bundle_adjustment import LidarConfig
from lvba.products import recorded_images
from lvba.progress import Progress, silent
from lvba.steps.lidar import planes_in_use, typical_range
from lvba.steps.outcomes import LidarStage, ScanPoses, VisualLevel, VisualStage, scan_covariance
from lvba.visual import image, keyframes
from lvba.visual import refine as visual_refine
from lvba.visual.refine import VisualConfig
from lvba.visual.variant import PRODUCT, Variant


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
    variant: Variant = PRODUCT,
    progress: Progress = silent,
) -> VisualLevel:
    """One pyramid level more than `coarser`, which is empty at first."""
    problem = _why_not(dataset, enabled) or coarser.problem
    if problem:
        return VisualLevel(None, problem)
    try:
        given = visual_inputs(dataset, lidar, scans, lidar_config, config, progress, keep=True)
        found = visual_refine.refine_level(given, coarser.found, config, progress, variant)
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
    variant: Variant = PRODUCT,
    progress: Progress = silent,
) -> VisualStage:
    """Camera poses and exposures from the images, over the planes of the scan poses in use: the finest level."""
    problem = _why_not(dataset, enabled) or coarser.problem
    if problem:
        return VisualStage(None, problem)
    try:
        given = visual_inputs(dataset, lidar, scans, lidar_config, config, progress)
        result = visual_refine.refine_finest(given, coarser.found, config, progress, variant)
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
        scan_covariance(lidar, scans),
    )
