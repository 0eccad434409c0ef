"""How well pairs of scans lie on each other by a reading of the odometry: distances from the other's planes."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from lvba.arrays import Vectors
from lvba.sources import placing
from lvba.sources.importing.track import Track

_QUERIES = 700
_NEIGHBORS = 8
_REACH_M, _REACH = 1.0, 3.0
"""Points that have none of the other scan so near, in m and in distances of its points, are as far as can be."""
_COLLINEAR = 0.01
"""Neighbors whose extents, squared, differ by more than this factor lie on a line."""
MOST_M = 0.5
"""Further is as bad: another place."""
_KEPT = 0.7
"""Part of the points that counts, the nearest: not all of a scan is seen by the other, and things move."""
_NODE_S = 5e-3


@dataclass(frozen=True)
class TimedScan:
    """Points of a scan. stamp: s; after: (N,) s from the stamp; points: (N, 3) float32, m, LiDAR frame."""

    stamp: float
    after: np.ndarray
    points: np.ndarray

    def in_world(self, lidar: Track, deskewed: bool) -> np.ndarray:
        """(N, 3) float64, m: where the points are.

        lidar: world from LiDAR, on the clock of the points; deskewed: they are as seen at the stamp
        """
        times = np.full(len(self.points), self.stamp) if deskewed else self.stamp + self.after
        at_nodes = placing.nodes(times.min(), times.max(), _NODE_S)
        return placing.place(self.points, at_nodes, lidar.at(at_nodes), times)

    @cached_property
    def span(self) -> tuple[float, float]:
        """s: from the first to the last point, or the stamp where that is outside."""
        return (
            self.stamp + min(float(self.after.min()), 0.0),
            self.stamp + max(float(self.after.max()), 0.0),
        )


def distance(one: Vectors, other: Vectors) -> float:
    """m: mean distance of points of two clouds from the planes of the other, of the nearer part of them.

    one, other: (N, 3), (M, 3) float64, m, in one frame
    """
    return 0.5 * (_one_way(one, other) + _one_way(other, one))


def floor(points: Vectors) -> float:
    """m: the distance of every second of the points (N, 3) float64, m, of one scan from the planes of the others."""
    mixed = np.random.default_rng(0).permutation(len(points))
    half = len(points) // 2
    return distance(points[mixed[:half]], points[mixed[half:]])


def _one_way(queries: np.ndarray, others: np.ndarray) -> float:
    step = max(1, len(queries) // _QUERIES)
    queries = queries[::step]
    if len(others) < _NEIGHBORS or not len(queries):
        return MOST_M
    tree = cKDTree(others)
    apart, near = tree.query(queries, _NEIGHBORS)
    spacing = float(np.median(tree.query(others[:: max(1, len(others) // _QUERIES)], 2)[0][:, 1]))
    around = others[near]
    center = around.mean(axis=1)
    off = around - center[:, None]
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", off, off))
    heights = np.abs(np.einsum("ni,ni->n", vectors[:, :, 0], queries - center))
    reached = apart[:, 0] <= max(_REACH_M, _REACH * spacing)
    heights = np.where(reached, np.minimum(heights, MOST_M), MOST_M)
    # of a single row of the sensor there is no plane
    heights = heights[~reached | (values[:, 1] > _COLLINEAR * values[:, 2])]
    if not len(heights):
        return MOST_M
    kept = max(int(_KEPT * len(heights)), 1)
    return float(np.partition(heights, kept - 1)[:kept].mean())
