"""The steps that solve cameras further over the planes at scan poses that these cameras had moved.

Cameras are found over the planes of the LiDAR bundle adjustment. Where scans that are then refined with them move by
millimeters and more (a narrow LiDAR, a depth camera), the map moves, and the cameras belong to the one before: the joint
problem of all parts continues over the new one, in rounds that begin at these cameras.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lvba.blocks.decoded_images import Keyframes
from lvba.blocks.decoded_scans import ScanPieces
from lvba.blocks.pieces import Pieces
from lvba.blocks.split import Frames, Part
from lvba.blocks.survey import Survey
from lvba.blocks.visual_joint import JointCameras
from lvba.dataset import Dataset
from lvba.lidar import plane
from lvba.progress import Progress, silent
from lvba.steps import joint_cameras, joint_prior, visual
from lvba.steps.acceptance import FUSED, FUSED_POSED
from lvba.steps.joint_cameras import MergedCameras
from lvba.steps.outcomes import Accepted, FusionStage, LidarStage, ScanPoses, VisualStage
from lvba.visual.config import VisualConfig
from lvba.visual.states import CameraStates, VisualState

LEAST_M = 1e-3
"""m, root mean square over the scans: cameras over a map that moved less are as good as they were."""


def start(
    dataset: Dataset,
    cores: Sequence[Part],
    stages: Sequence[VisualStage],
    cameras: VisualStage,
    lidar: LidarStage,
    learned: FusionStage,
    fused: ScanPoses,
    survey: Survey,
    config: VisualConfig,
) -> MergedCameras:
    """What the rounds begin with; no cameras: there is nothing to solve.

    stages: of the parts; cameras: of all images, without outliers
    """
    result = cameras.result
    if result is None or learned.result is None or not fused.verdict.accepted:
        return MergedCameras(None, (), "no scan refined with the cameras is in use")
    if np.sqrt(np.square(learned.result.moved_m).mean()) < LEAST_M:
        return MergedCameras(None, (), f"scans moved by less than {1e3 * LEAST_M:g} mm")
    prior = joint_prior.prior_of_keyframes(dataset, cores, stages, lidar, fused, survey, config)
    at = survey.keyframes
    state = VisualState(
        CameraStates(result.world_from_camera[at], result.log_exposure[at] - result.log_exposure[at[0]]),
        result.calibration,
        joint_prior.motion_of_keyframes(cores, stages, survey),
    )
    return MergedCameras(
        JointCameras(
            state=state,
            before=state,
            prior=prior,
            exposure_sigma=result.log_exposure_sigma[at],
            converged=bool(len(result.degenerate_common)),
            radiometry=result.radiometry,
        ),
        (),
    )


def solve_alone(
    dataset: Dataset,
    frames: Frames,
    points: ScanPieces,
    keyframes: Pieces[Keyframes],
    stage: VisualStage,
    cameras: VisualStage,
    lidar: LidarStage,
    learned: FusionStage,
    fused: ScanPoses,
    part: Part,
    survey: Survey,
    config: VisualConfig,
    rounds: int,
    progress: Progress = silent,
) -> VisualStage:
    """All steps at once, of a recording that is one part: `start`, its planes and scene points, rounds, `finish`.

    points, keyframes: of all frames; stage: of the part; other arguments as of `start`
    """
    merged = start(dataset, [part], [stage], cameras, lidar, learned, fused, survey, config)
    if not are_solved(merged) or rounds == 0:
        return cameras
    progress("fused cameras", 0, rounds + 1)
    bare = without_planes(lidar)
    planes = visual.find_planes(dataset, frames, points, bare, fused, survey)
    seen = joint_cameras.select_points(
        dataset, frames, keyframes, bare, planes, stage, merged, survey, config
    )
    merged = joint_cameras.solve_exposures(merged, [joint_cameras.exposure_pairs(seen)])
    for turn in range(rounds):
        progress("fused cameras", turn + 1, rounds + 1)
        block = joint_cameras.linearize_cameras(
            dataset, keyframes, stage, lambda: seen, merged, survey, config
        )
        merged = joint_cameras.step_cameras(merged, [block])
    progress("fused cameras", rounds + 1, rounds + 1)
    return finish(dataset, [stage], cameras, merged, lidar, fused, survey, config)


def are_solved(merged: MergedCameras) -> bool:
    """Whether there is anything to solve."""
    return merged.cameras is not None and not merged.cameras.converged


def without_planes(lidar: LidarStage) -> LidarStage:
    """What is known of the scans, but not the planes where they were: those are found anew."""
    if lidar.result is None:
        return lidar
    bare = replace(lidar.result, planes=plane.no_planes(), plane_points=plane.no_plane_points())
    return replace(lidar, result=bare)


def finish(
    dataset: Dataset,
    stages: Sequence[VisualStage],
    cameras: VisualStage,
    merged: MergedCameras,
    lidar: LidarStage,
    fused: ScanPoses,
    survey: Survey,
    config: VisualConfig,
) -> VisualStage:
    """The cameras of all images with those over the fused scans beside them. Arguments as of `start`.

    Exposures stay: poses change by millimeters. So does what poses are uncertain by.
    """
    now, result = merged.cameras, cameras.result
    if now is None or result is None or not now.history:
        return cameras
    prior = joint_prior.prior_of_all(dataset, lidar, fused, config)
    poses, calibration = joint_cameras.cameras_of_all(
        now, prior, stages, survey.keyframes, dataset.images.times
    )
    return replace(cameras, over_fused=replace(result, world_from_camera=poses, calibration=calibration))


def in_use(cameras: VisualStage, accepted: Accepted) -> VisualStage:
    """The cameras that belong to the scans of the result."""
    if accepted.state not in (FUSED, FUSED_POSED) or cameras.over_fused is None:
        return cameras
    return replace(cameras, result=cameras.over_fused)
