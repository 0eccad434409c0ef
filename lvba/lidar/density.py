"""How fine the cells may be: as fine as single scans still fill them."""

from dataclasses import replace

import numpy as np

from lvba import geometry
from lvba.lidar.config import Stage
from lvba.lidar.scan import Scans

_SAMPLED_SCANS = 10
_MOST_HALVINGS = 2


def adapted(stages: tuple[Stage, ...], scans: Scans, dense_points: int) -> tuple[Stage, ...]:
    """The stages with finer cells added to each where the scans are dense enough for them.

    dense_points: fewest points of a single scan that a finer cell must hold; 0: never finer

    A depth camera over a desk puts hundreds of points of one scan into a cell of 0.25 m, and surfaces there are smaller
    than the cell; a spinning LiDAR in the open puts five there, and a finer cell would hold no plane at all.
    """
    if dense_points == 0 or not len(scans.points):
        return stages
    finest = min(stage.sizes[0] for stage in stages)
    halvings = 0
    while halvings < _MOST_HALVINGS and points_per_cell(scans, finest / 2 ** (halvings + 1)) >= dense_points:
        halvings += 1
    finer = [0.5 ** (halvings - k) for k in range(halvings)]
    return tuple(
        replace(stage, sizes=(*(stage.sizes[0] * factor for factor in finer), *stage.sizes))
        for stage in stages
    )


def points_per_cell(scans: Scans, size: float) -> float:
    """How many points of a scan share a cell of edge `size` (m) with a typical point: median over points, then scans."""
    step = max(1, len(scans) // _SAMPLED_SCANS)
    medians = []
    for first, last in zip(scans.offsets[:-1:step], scans.offsets[1::step], strict=True):
        points = geometry.finite(scans.points[first:last])
        if len(points):
            cells = np.floor(points / np.float32(size)).astype(np.int64)
            key = (cells[:, 0] * 2_000_003 + cells[:, 1]) * 2_000_003 + cells[:, 2]
            _, inverse, count = np.unique(key, return_inverse=True, return_counts=True)
            medians.append(float(np.median(count[inverse.ravel()])))
    return float(np.median(medians)) if medians else 0.0
