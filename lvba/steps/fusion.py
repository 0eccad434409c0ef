"""The step that fuses refined scans and cameras."""

from lvba.dataset import Dataset
from lvba.steps import pose_fusion
from lvba.steps.outcomes import FusionStage, LidarStage, ScanPoses, VisualStage, scan_covariance
from lvba.steps.pose_fusion import FusionConfig
from lvba.trajectory import Trajectory


def solve_fusion(
    dataset: Dataset,
    lidar: LidarStage,
    scans: ScanPoses,
    visual: VisualStage,
    config: FusionConfig,
) -> FusionStage:
    """The scans refined with the cameras."""
    if not config.enabled:
        return FusionStage(None, "scans are not refined with the cameras (fusion.enabled is false)")
    covariance = scan_covariance(lidar, scans)
    if lidar.result is None or covariance is None:
        return FusionStage(None, "the scans were not refined")
    if visual.result is None:
        return FusionStage(None, f"there are no refined cameras: {visual.problem}")
    result, known = visual.result, visual.result.keyframes
    # of parts, covariances are those within each: along a corridor they say nothing of one part beside the other
    whole = visual.tuning is not None
    cameras = pose_fusion.scan_poses_from_cameras(
        result.world_from_camera[known],
        result.moments(dataset.images.times)[known],
        result.own_covariance[known],
        result.scan_from_camera,
        result.extrinsic_sigma,
        result.group[known] if whole and len(result.group) else None,
    )
    fused = pose_fusion.fuse(
        Trajectory(dataset.scans.times, scans.world_from_scan),
        covariance,
        cameras,
        lidar.result.degenerate_directions,
    )
    return FusionStage(fused, "" if fused else "too few cameras")
