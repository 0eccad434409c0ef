"""How far off the points of a map are expected to be, as the poses of the scans that measured them are uncertain."""

from dataclasses import replace

import numpy as np

from lvba.arrays import Indices, PoseBlocks, Poses
from lvba.products.map_file import PointMap

_CHUNK = 1 << 20


def with_error(point_map: PointMap, world_from_scan: Poses, covariance: PoseBlocks | None) -> PointMap:
    """The map with the expected error of each point (`of_points`); NaN where nothing is known.

    world_from_scan: (S, 4, 4); covariance: (S, 6, 6), NaN where not known
    """
    if covariance is None or point_map.scan is None:
        return replace(point_map, error=np.full(len(point_map), np.nan, np.float32))
    error = of_points(point_map.points_world, point_map.scan, world_from_scan, covariance)
    return replace(point_map, error=error)


def of_points(
    points_world: np.ndarray, scan: Indices, world_from_scan: Poses, covariance: PoseBlocks
) -> np.ndarray:
    """Expected distance (K,) float32, m, of points from where they should be, as the poses of their scans are uncertain.

    points_world: (K, 3) float32, m; scan: (K,) which scan measured each; world_from_scan: (S, 4, 4); covariance: (S, 6,
    6) The point's own range noise is not in it. A pose turned by r and moved by t moves a point q of the sensor's frame
    by `t + r x q`; what is returned is the root of the expected square of that.
    """
    turn = world_from_scan[:, :3, :3]
    back = np.swapaxes(turn, -1, -2)
    rotation, cross, position = (
        turn @ covariance[:, rows, columns] @ back
        for rows, columns in (
            (slice(3), slice(3)),
            (slice(3), slice(3, 6)),
            (slice(3, 6), slice(3, 6)),
        )
    )
    spread = np.trace(position, axis1=1, axis2=2)
    # E |r x q|^2 = q' (tr(R) I - R) q, E 2 t . (r x q) = 2 q . (the vector of the antisymmetric part of E r t')
    square = np.trace(rotation, axis1=1, axis2=2)[:, None, None] * np.eye(3) - rotation
    linear = 2 * np.stack(
        [
            cross[:, 2, 1] - cross[:, 1, 2],
            cross[:, 0, 2] - cross[:, 2, 0],
            cross[:, 1, 0] - cross[:, 0, 1],
        ],
        axis=1,
    )
    out = np.empty(len(points_world), np.float32)
    for low in range(0, len(points_world), _CHUNK):
        mine = slice(low, low + _CHUNK)
        own = scan[mine]
        arm = points_world[mine].astype(float) - world_from_scan[own, :3, 3]
        variance = spread[own] + np.einsum("ki,ki->k", arm, linear[own])
        variance += np.einsum("ki,kij,kj->k", arm, square[own], arm)
        out[mine] = np.sqrt(np.maximum(variance, 0.0))
    return out


_STRAY, _STRAY_M = 5.0, 300.0
"""A point is stray that is further from its scan than so many times what nine tenths of the points are, and than LiDARs
reach."""


def counted(point_map: PointMap, world_from_scan: Poses) -> np.ndarray:
    """The errors (K,) float32, m, of points that count for the error of the whole map: NaN where not known, and of stray
    points, which are no part of any surface: a turn moves them by so much that a few of them outweigh all others.

    world_from_scan: (S, 4, 4); the map has errors (`with_error`)
    """
    if point_map.error is None or point_map.scan is None or not len(point_map):
        return np.zeros(0, np.float32)
    distance = np.empty(len(point_map), np.float32)
    for low in range(0, len(point_map), _CHUNK):
        mine = slice(low, low + _CHUNK)
        arm = point_map.points_world[mine] - world_from_scan[point_map.scan[mine], :3, 3]
        distance[mine] = np.linalg.norm(arm, axis=1)
    stray = distance > max(_STRAY_M, _STRAY * float(np.quantile(distance, 0.9)))
    return np.where(stray, np.float32(np.nan), point_map.error)


_LEAST_M, _MOST_M, _BINS = 1e-6, 1e3, 4096


class Tally:
    """Root mean square and 95th percentile (within 0.5 %) of errors that are counted piece by piece."""

    def __init__(self) -> None:
        self._squares, self._count = 0.0, 0
        self._bins = np.zeros(_BINS, np.int64)

    def add(self, error: np.ndarray) -> None:
        """Counts errors (K,), m; NaN are left out.

        error: (K,) float32, m
        """
        known = error[np.isfinite(error)].astype(float)
        self._squares += float(np.square(known).sum())
        self._count += len(known)
        place = (
            np.log(np.clip(known, _LEAST_M, _MOST_M) / _LEAST_M) / np.log(_MOST_M / _LEAST_M) * (_BINS - 1)
        )
        self._bins += np.bincount(np.rint(place).astype(np.int64), minlength=_BINS)

    def facts(self) -> dict[str, float] | None:
        """position_m and position_p95_m; None where nothing was counted."""
        if not self._count:
            return None
        place = int(np.searchsorted(np.cumsum(self._bins), 0.95 * self._count))
        return {
            "position_m": float(np.sqrt(self._squares / self._count)),
            "position_p95_m": float(_LEAST_M * (_MOST_M / _LEAST_M) ** (place / (_BINS - 1))),
        }
