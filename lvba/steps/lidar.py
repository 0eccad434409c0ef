"""The step that refines the scans of one part, and what follows from scan poses: clouds, cameras carried along."""

from collections.abc import Callable

import numpy as np

from lvba import geometry, trajectory
from lvba.arrays import Poses
from lvba.blocks.decoded import Pieces, ScanPoints, ScanReader
from lvba.blocks.split import Part
from lvba.dataset import Dataset
from lvba.errors import DegenerateProblemError
from lvba.io import dataset as recordings
from lvba.lidar import bundle_adjustment as lidar_ba
from lvba.lidar.bundle_adjustment import LidarConfig
from lvba.products.cloud import Cloud, assemble
from lvba.progress import Progress, silent
from lvba.steps.outcomes import LidarStage


def solve_lidar(
    dataset: Dataset,
    part: Part,
    points: Pieces[ScanPoints],
    config: LidarConfig,
    enabled: bool = True,
    progress: Progress = silent,
) -> LidarStage:
    """Scan poses of a part, planes and what is known about them, from the scans and their rough poses.

    dataset: of the part's frames; points: of its scans
    """
    if not enabled:
        return LidarStage(None, "LiDAR bundle adjustment is switched off (refine_scans)")
    try:
        result = lidar_ba.refine(
            ScanReader(points).load(part.scan_numbers),
            dataset.scans.world_from_sensor,
            sensor_position=dataset.sensor_position_scan,
            config=config,
            progress=progress,
        )
    except DegenerateProblemError as error:
        return LidarStage(None, str(error))
    return LidarStage(result)


def carry_cameras(dataset: Dataset, world_from_scan: Poses) -> np.ndarray:
    """Rough camera poses moved along with the scans, (I, 4, 4). Source: Li et al., eq. (1)."""
    moved = trajectory.interpolate_corrections(dataset.scans, world_from_scan, dataset.images.times)
    return geometry.orthonormalize(moved @ dataset.images.world_from_sensor)


def cloud_of(
    dataset: Dataset,
    world_from_scan: Poses,
    progress: Progress = silent,
    read: Callable[[int], np.ndarray] | None = None,
) -> Cloud:
    """All scans in the world frame. read: gives the points of a scan; None: from its file."""
    return assemble(
        read or (lambda index: recordings.load_scan(dataset, index).points),
        world_from_scan,
        dataset.scans.times,
        progress,
        dataset.sensor_position_scan,
    )
