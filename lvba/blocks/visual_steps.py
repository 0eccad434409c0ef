"""The cameras of one part by itself, over the joint scans."""

from dataclasses import dataclass

import numpy as np

from lvba.blocks import visual_block
from lvba.blocks.lidar_steps import JointScans
from lvba.blocks.split import Frames
from lvba.blocks.survey import Survey, keyframes_of
from lvba.blocks.visual_block import Tuning
from lvba.dataset import Dataset
from lvba.errors import DegenerateProblemError
from lvba.io import dataset as recordings
from lvba.lidar import bundle_adjustment as lidar_ba
from lvba.lidar.covariance import Covariance
from lvba.lidar.plane import PlanePoints, Planes
from lvba.progress import Progress, silent
from lvba.steps.outcomes import ScanPoses, VisualLevel
from lvba.steps.visual import visual_levels
from lvba.visual import image, refine
from lvba.visual.image import ImageConfig
from lvba.visual.refine import Inputs, VisualConfig, VisualResult


@dataclass(frozen=True)
class Ground:
    """What the cameras of one part stand on: planes at the scan poses in use.

    world_from_scan: (n, 4, 4) of the part's scans; keyframes: (k,) among the part's images
    uncertainty: of the scan poses, where known; problem: why there is no plane; empty: there are
    """

    world_from_scan: np.ndarray
    keyframes: np.ndarray
    planes: Planes | None
    points: PlanePoints | None
    uncertainty: Covariance | None
    problem: str = ""


@dataclass(frozen=True)
class PartCameras:
    """What the visual bundle adjustment of one part leaves; nothing where it could not be solved."""

    result: VisualResult | None
    tuning: Tuning | None
    problem: str = ""


def ground(dataset: Dataset, frames: Frames, found: JointScans, scans: ScanPoses, survey: Survey) -> Ground:
    """The planes of some frames. dataset: of these only."""
    poses, keyframes = scans.world_from_scan[frames.scans], keyframes_of(survey, frames)
    try:
        planes, points = lidar_ba.find_planes(
            recordings.load_scans(dataset),
            poses,
            sensor_position=dataset.sensor_position_scan,
            config=survey.lidar,
        )
    except DegenerateProblemError as error:
        return Ground(poses, keyframes, None, None, None, str(error))
    uncertainty = None
    if found.lidar.result is not None and scans.verdict.accepted:
        uncertainty = Covariance(
            found.lidar.result.covariance[frames.scans],
            found.lidar.result.conditional_covariance[frames.scans],
        )
    return Ground(poses, keyframes, planes, points, uncertainty)


def undistorted(
    dataset: Dataset,
    frames: Frames,
    survey: Survey,
    config: ImageConfig,
    enabled: bool = True,
    progress: Progress = silent,
) -> np.ndarray:
    """The keyframes among some frames as all visual steps read them, decoded once: (k, H, W, C) uint8, finest level.

    dataset: of these frames only; enabled: whether there are visual steps
    """
    keyframes = keyframes_of(survey, frames)
    if not enabled or len(keyframes) < 2:
        return np.zeros((0, 1, 1, config.channels), np.uint8)
    return image.load_undistorted(
        lambda index: recordings.load_image(dataset, int(keyframes[index])),
        len(keyframes),
        dataset.camera,
        config,
        progress,
    )


def solve_level(
    dataset: Dataset,
    images: np.ndarray,
    below: Ground,
    coarser: VisualLevel,
    config: VisualConfig,
    enabled: bool = True,
    progress: Progress = silent,
) -> VisualLevel:
    """One pyramid level of one part. images: of its keyframes, `undistorted`."""
    problem = _why_not(dataset, below, enabled) or coarser.problem
    if problem:
        return VisualLevel(None, problem)
    try:
        given = inputs(dataset, images, below, config)
        return VisualLevel(refine.refine_level(given, coarser.found, config, progress))
    except DegenerateProblemError as error:
        return VisualLevel(None, str(error))


def solve_part(
    dataset: Dataset,
    images: np.ndarray,
    below: Ground,
    coarser: VisualLevel,
    config: VisualConfig,
    enabled: bool = True,
    progress: Progress = silent,
) -> PartCameras:
    """The finest level of one part. images: of its keyframes, `undistorted`."""
    problem = _why_not(dataset, below, enabled) or coarser.problem
    if problem:
        return PartCameras(None, None, problem)
    try:
        given = inputs(dataset, images, below, config)
        result, last = refine.finest(given, coarser.found, config, progress)
    except DegenerateProblemError as error:
        return PartCameras(None, None, str(error))
    return PartCameras(result, visual_block.tuning(last))


def _why_not(dataset: Dataset, below: Ground, enabled: bool) -> str:
    if not dataset.image_paths:
        return "the recording has no images"
    if len(below.keyframes) < 2:
        return "fewer than two keyframes"
    return below.problem if enabled else "visual bundle adjustment is switched off (refine_cameras)"


def inputs(dataset: Dataset, images: np.ndarray, below: Ground, config: VisualConfig) -> Inputs:
    """What the visual part works on. images: of the keyframes, `undistorted`."""
    assert below.planes is not None
    assert below.points is not None
    camera = image.measuring_camera(dataset.camera)
    return Inputs(
        image.build_pyramid(images, camera, visual_levels(dataset, config)),
        below.keyframes,
        dataset.images,
        dataset.scans,
        below.world_from_scan,
        dataset.camera_from_scan,
        dataset.sensor_position_scan,
        below.planes,
        below.points,
        below.uncertainty,
    )
