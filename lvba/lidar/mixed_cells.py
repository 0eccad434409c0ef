"""Planes in the finest cells that hold several surfaces, found by their points.

A cell is one plane, or is split; the finest ones are not. They are as small as the noise of ranges allows, and surfaces
that are smaller, such as the steps of a stairwell, would not count: there, nothing else holds scans upright. So where all
other planes leave scans open, a few are looked for in what these cells hold: each drawn through three places (Fischler
and Bolles 1981) and fitted, then the next one in the rest. Points near two planes go to neither: they would pull each
towards the other.
Source: ours.
"""

import numpy as np

from lvba.arrays import Poses, Vector
from lvba.kernels import mixed_cells as kernel
from lvba.kernels.plane_refit import CellPoints, order_points
from lvba.lidar.plane_feature import PlaneFeatures
from lvba.lidar.point_cluster import PointClusters
from lvba.lidar.scan import Scans
from lvba.lidar.voxel_map import Association, PlaneTest, VoxelMap


def find(
    grid: VoxelMap,
    association: Association,
    scans: Scans,
    world_from_scan: Poses,
    sensor_position: Vector,
    sigma: float,
    test: PlaneTest,
) -> PlaneFeatures:
    """Planes of the points in the finest cells that lie on no plane of the association.

    world_from_scan: (S, 4, 4) float64; sensor_position: (3,) float64, m, scan frame; sigma: m, of a point about its plane
    """
    level = grid.levels[0]
    near = _free_points(grid, association, scans, test)
    sensors = world_from_scan[:, :3, :3] @ sensor_position + world_from_scan[:, :3, 3]
    limits = kernel.MixedTest(
        sigma=float(sigma),
        size=float(level.size),
        min_points=test.min_points,
        ratio=test.finest_ratio,
        max_tilt=test.max_tilt,
    )
    labels = kernel.label(near, scans.points, np.ascontiguousarray(world_from_scan), sensors, limits)
    made = kernel.observations(near, scans.points, labels)
    _, first = np.unique(made.plane, return_index=True)
    offsets = np.append(first, len(made.plane)).astype(np.int64)
    features = PlaneFeatures(
        offsets=offsets,
        scan=made.scan,
        clusters=PointClusters(made.number, made.mean, made.scatter),
        weight=np.ones(len(made.scan)),
        size=np.full(len(first), level.size),
    )
    return features.select(np.diff(offsets) >= test.min_scans)


def _free_points(grid: VoxelMap, association: Association, scans: Scans, test: PlaneTest) -> CellPoints:
    """The points on no plane, of the finest cells that have enough of them for two."""
    level = grid.levels[0]
    free = np.ones(len(level.scan), bool)
    free[level.entry_of[association.observation >= 0]] = False
    points = np.add.reduceat(np.where(free, level.clusters.count, 0.0), level.starts[:-1])
    free &= np.repeat(points >= 2 * test.min_points, np.diff(level.starts))
    first, order = order_points(scans.offsets, grid.pair, grid.pair_starts, level.entry_of, free)
    return CellPoints(level.key, level.starts, level.scan, first, order)
