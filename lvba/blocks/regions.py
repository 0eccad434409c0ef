"""Regions of space that parts own, and the points in them."""

from collections.abc import Sequence

import numpy as np

from lvba import geometry
from lvba.arrays import CloudPoints, Poses
from lvba.blocks import lidar_block
from lvba.blocks.decoded_scans import ScanPoints, ScanReader
from lvba.blocks.lidar_block import Regions
from lvba.blocks.pieces import Pieces
from lvba.blocks.split import Part
from lvba.dataset import Dataset
from lvba.products.cloud import Cloud, assemble
from lvba.progress import Progress, silent


def regions(dataset: Dataset, cores: Sequence[Part], world_from_scan: Poses) -> Regions:
    """Which part owns which piece of space, at scan poses (S, 4, 4)."""
    sensors = (world_from_scan @ np.append(dataset.sensor_position_scan, 1.0))[:, :3]
    owner = np.concatenate([np.full(core.core_scans[1] - core.core_scans[0], core.number) for core in cores])
    return Regions(sensors, owner)


def region_cloud(
    dataset: Dataset,
    cores: Sequence[Part],
    part: int,
    points: Pieces[ScanPoints],
    world_from_scan: Poses,
    reach: float,
    progress: Progress = silent,
    every: int = 1,
) -> Cloud:
    """The points (of any scan) that lie in a part's region, world frame, in scan order; all where there is one part.

    points: of scans about the region; reach: m, of the LiDAR; every: takes every so many-th point of each scan
    """
    read = ScanReader(points, whole=dataset)
    if len(cores) == 1:
        return assemble(
            lambda index: read(index)[::every],
            world_from_scan,
            dataset.scans.times,
            progress,
        )
    owned = regions(dataset, cores, world_from_scan)
    scans = lidar_block.candidates(owned, part, reach)
    kept, counts = [], []
    for done, scan in enumerate(scans):
        progress("collecting points", done, len(scans))
        here = read(int(scan))[::every]
        world = geometry.transform_points(world_from_scan[scan], here.astype(float)).astype(np.float32)
        mine = world[in_region(world, owned, part)]
        kept.append(mine)
        counts.append(len(mine))
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    points_world = np.concatenate([np.zeros((0, 3), np.float32), *kept])
    return Cloud(points_world, offsets, dataset.scans.times[scans])


_OWNED_CELL_M = 2.0


def in_region(points_world: CloudPoints, owned: Regions, part: int) -> np.ndarray:
    """Which points (N, 3) lie in cells that the part owns, (N,) bool."""
    cell = np.floor(points_world / np.float32(_OWNED_CELL_M)).astype(np.int64)
    key = (cell[:, 0] * (1 << 21) + cell[:, 1]) * (1 << 21) + cell[:, 2]
    _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
    mine = owned.of((cell[first] + 0.5) * _OWNED_CELL_M) == part
    return np.asarray(mine[inverse.ravel()])
