"""The steps that refine the cameras of one part: the planes they are refined over, then one pyramid level each."""

from dataclasses import replace
from functools import partial

import numpy as np

from lvba.blocks.decoded_images import Keyframes, color_of_keyframes, keyframe_images
from lvba.blocks.decoded_scans import ScanPieces, ScanReader, moving_solved
from lvba.blocks.pieces import Pieces
from lvba.blocks.split import Frames
from lvba.blocks.survey import Survey, keyframes_of
from lvba.dataset import Dataset
from lvba.errors import DegenerateProblemError
from lvba.lidar import bundle_adjustment as lidar_ba
from lvba.lidar.bundle_adjustment import LidarResult
from lvba.lidar.covariance import Covariance
from lvba.products import judging_size
from lvba.progress import Progress, silent
from lvba.steps.outcomes import LidarStage, MapPlanes, ScanPoses, VisualLevel, VisualStage
from lvba.visual import image, refine
from lvba.visual.config import VisualConfig
from lvba.visual.fixed_calibration import CORRECTIONS
from lvba.visual.scene import Inputs
from lvba.visual.tuning import tuning
from lvba.visual.variant import PRODUCT, Variant


def visual_levels(dataset: Dataset, config: VisualConfig) -> int:
    """How many pyramid levels the visual stage goes through."""
    return image.usable_levels(dataset.camera, config.levels) if dataset.image_paths else 1


def find_planes(
    dataset: Dataset,
    frames: Frames,
    points: ScanPieces,
    lidar: LidarStage,
    scans: ScanPoses,
    survey: Survey,
    enabled: bool = True,
) -> MapPlanes:
    """The planes of some frames at the scan poses in use, found anew unless the LiDAR stage has them.

    dataset: of these frames only; points: of their scans; lidar, scans: of the whole recording
    enabled: whether there are visual steps
    """
    poses, keyframes = scans.world_from_scan[frames.scans], keyframes_of(survey, frames)
    none = MapPlanes(world_from_scan=poses, keyframes=keyframes, planes=None, points=None, uncertainty=None)
    if not enabled:
        return replace(none, problem="visual bundle adjustment is switched off (refine_cameras)")
    if len(keyframes) < 2:
        return replace(none, problem="fewer than two keyframes")
    uncertainty = None
    if lidar.result is not None and scans.verdict.accepted:
        uncertainty = _uncertainty(lidar, frames.scans)
        if len(lidar.result.planes):
            return _without_moving(replace(none, uncertainty=uncertainty), points, frames.scans, lidar.result)
    try:
        planes, plane_points = lidar_ba.find_planes(
            ScanReader(points, static=False).load(frames.scans),
            poses,
            sensor_position=dataset.sensor_position_scan,
            config=survey.lidar,
        )
    except DegenerateProblemError as error:
        return replace(none, problem=str(error))
    # what moves hides what is behind it, and is no surface to compare images on
    plane_points = plane_points.on_none(moving_solved(points, frames.scans))
    return replace(none, planes=planes, points=plane_points, uncertainty=uncertainty)


def _without_moving(
    planes: MapPlanes, points: ScanPieces, scans: np.ndarray, lidar: LidarResult
) -> MapPlanes:
    """The planes of the LiDAR stage, with their points where some move: of all scans (S,) int64, of one part."""
    moving = moving_solved(points, scans)
    if not moving.any():
        return planes
    return replace(planes, planes=lidar.planes, points=lidar.plane_points.on_none(moving))


def _uncertainty(lidar: LidarStage, scans: np.ndarray) -> Covariance:
    """Of some scans (n,); steps between scans are known of an undivided recording only.

    Without what each scan is off by itself: how far single frames deviate is read off the cameras, and what neighbors
    do not share would count as an error that they do.
    """
    assert lidar.result is not None
    known = lidar.result.pose_covariance
    steps = known.step if len(scans) == len(known.marginal) else np.zeros((0, 6, 6))
    marginal, conditional, in_map = (
        each[scans] for each in (known.marginal, known.conditional, known.in_map)
    )
    return replace(known, marginal=marginal, conditional=conditional, in_map=in_map, step=steps)


def solve_level(
    dataset: Dataset,
    frames: Frames,
    keyframes: Pieces[Keyframes],
    lidar: LidarStage,
    planes: MapPlanes,
    coarser: VisualLevel,
    config: VisualConfig,
    variant: Variant = PRODUCT,
    progress: Progress = silent,
) -> VisualLevel:
    """One pyramid level of one part more than `coarser`, which is empty at first.

    dataset: of the part's frames; keyframes: of these; lidar: of the whole recording
    """
    problem = _why_not(dataset, planes) or coarser.problem
    if problem:
        return VisualLevel(None, problem)
    try:
        given = inputs(dataset, frames, keyframes, lidar, planes, config)
        return VisualLevel(refine.refine_level(given, coarser.solution, config, progress, variant))
    except DegenerateProblemError as error:
        return VisualLevel(None, str(error))


def solve_finest(
    dataset: Dataset,
    frames: Frames,
    keyframes: Pieces[Keyframes],
    lidar: LidarStage,
    planes: MapPlanes,
    coarser: VisualLevel,
    config: VisualConfig,
    variant: Variant = PRODUCT,
    photos: Pieces[np.ndarray] = (),
    judging: Pieces[np.ndarray] = (),
    progress: Progress = silent,
) -> VisualStage:
    """Camera poses and exposures of one part, from the finest level. Arguments as of `solve_level`.

    photos: raw images in color; none: white balance is taken to be the same in all of them; judging: those that judge
    """
    problem = _why_not(dataset, planes) or coarser.problem
    if problem:
        return VisualStage(None, problem)
    try:
        given = inputs(dataset, frames, keyframes, lidar, planes, config)
        if len(photos):
            numbers, camera = frames.images[planes.keyframes], dataset.camera
            pinhole = image.measuring_camera(camera)
            given = replace(given, colors=partial(color_of_keyframes, photos, numbers, camera, pinhole))
            if level := judging_size.level(camera):
                own, small = camera.at_level(level), pinhole.at_level(level)
                smaller = partial(color_of_keyframes, judging, numbers, own, small)
                given = replace(given, smaller_colors=(smaller, small))
        result, last = refine.finest(given, coarser.solution, config, progress, variant)
    except DegenerateProblemError as error:
        return VisualStage(None, str(error))
    return VisualStage(result, "", tuning(last))


def solve_as_calibrated(
    dataset: Dataset,
    frames: Frames,
    keyframes: Pieces[Keyframes],
    lidar: LidarStage,
    planes: MapPlanes,
    coarser: VisualLevel,
    solved: VisualStage,
    config: VisualConfig,
    variant: Variant = PRODUCT,
    photos: Pieces[np.ndarray] = (),
    judging: Pieces[np.ndarray] = (),
    progress: Progress = silent,
) -> VisualStage | None:
    """The same without any correction of the camera; None: it was not corrected. solved: what `solve_finest` gave"""
    tuned = solved.tuning
    if solved.result is None or tuned is None or not config.calibrate or set(CORRECTIONS) <= set(tuned.fixed):
        return None
    variant = replace(variant, camera="as calibrated")
    stage = solve_finest(
        dataset, frames, keyframes, lidar, planes, coarser, config, variant, photos, judging, progress
    )
    return None if stage.result is None else stage


def _why_not(dataset: Dataset, planes: MapPlanes) -> str:
    """Why there is no visual stage; empty: there is one."""
    return planes.problem if dataset.image_paths else "the recording has no images"


def inputs(
    dataset: Dataset,
    frames: Frames,
    keyframes: Pieces[Keyframes],
    lidar: LidarStage,
    planes: MapPlanes,
    config: VisualConfig,
) -> Inputs:
    """What the visual bundle adjustment of some frames works on. dataset: of these; lidar: of the whole recording."""
    images = keyframe_images(keyframes, frames.images[planes.keyframes])
    plane_set, points = planes.planes, planes.points
    if plane_set is None or points is None:
        assert lidar.result is not None
        plane_set, points = lidar.result.planes, lidar.result.plane_points
    return Inputs(
        pyramid=image.build_pyramid(
            images, image.measuring_camera(dataset.camera), visual_levels(dataset, config)
        ),
        keyframes=planes.keyframes,
        images=dataset.images,
        scans=dataset.scans,
        refined_scans=planes.world_from_scan,
        camera_from_scan=dataset.camera_from_scan,
        sensor_position_scan=dataset.sensor_position_scan,
        planes=plane_set,
        plane_points=points,
        scan_covariance=planes.uncertainty,
        planes_off=lidar.planes_off,
        camera=dataset.camera,
    )
