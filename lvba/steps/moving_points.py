"""The step that looks for points that move: in neither the map nor what images are compared with."""

import numpy as np

from lvba.blocks.decoded_scans import MovingPoints, ScanPieces, ScanReader
from lvba.blocks.split import Part
from lvba.dataset import Dataset
from lvba.lidar import moving_points
from lvba.progress import Progress, silent
from lvba.steps.outcomes import LidarStage


def find(
    dataset: Dataset,
    part: Part,
    points: ScanPieces,
    lidar: LidarStage,
    progress: Progress = silent,
) -> MovingPoints:
    """The moving points of the scans in a part's core: those that are seen through at rough and at refined poses alike,
    so that neither is favored where the two are compared.

    dataset: of the part's frames; points: of its scans; lidar: of the whole recording
    """
    poses = [dataset.scans.world_from_sensor]
    if lidar.result is not None:
        poses.append(lidar.result.world_from_scan[slice(*part.scans)])
    every = range(len(dataset.scans))
    scans = ScanReader(points, part.scans[0], all_points=True).load(every)
    masks = moving_points.moving_points(
        *(scans.__getitem__, poses, dataset.scans.times, dataset.sensor_position_scan),
        *(every[part.core_of_scans], progress),
    )
    numbers = np.flatnonzero(np.concatenate(masks)).astype(np.int64)
    return MovingPoints(numbers, sum(len(each) for each in masks))
