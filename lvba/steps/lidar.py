"""The step that refines scan poses, and what follows from scan poses: clouds, planes, cameras carried along."""

import numpy as np

from lvba import geometry, trajectory
from lvba.dataset import Dataset
from lvba.errors import DegenerateProblemError
from lvba.io import dataset as recordings
from lvba.lidar import bundle_adjustment as lidar_ba
from lvba.lidar.bundle_adjustment import LidarConfig
from lvba.lidar.plane import PlanePoints, Planes
from lvba.products.cloud import Cloud, assemble
from lvba.progress import Progress, silent
from lvba.steps.outcomes import LidarStage, ScanPoses


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
