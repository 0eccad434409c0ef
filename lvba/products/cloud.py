"""The point cloud of all scans, sorted into blocks so that an image only meets the points in front of it."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from lvba import geometry
from lvba.arrays import CloudPoints, Indices, Poses, Times, Vector
from lvba.kernels import cloud as kernels
from lvba.kernels import facing as facing_kernels
from lvba.kernels.scene import BlockPoints
from lvba.parallel import in_order
from lvba.progress import Progress, silent

_MAX_BLOCKS = 1 << 20
_MIN_EDGE_M = 0.5
_LEAST_SCATTER = np.float32(0.5)
"""No surface is taken as flatter than this part of the typical one of its map."""
_LEAST_SCATTER_M = np.float32(0.001)
"""No sensor measures better than this, and float32 does not hold much more."""
_NOWHERE = np.float32(1e6)
_UNKNOWN_SCATTER_M = np.float32(0.05)
"""Scatter of points of which no five are neighbors anywhere in the map."""


@dataclass(frozen=True)
class Origins:
    """From where points were measured. scan: (M,) int32, by which scan; sensor_world: (S, 3), m, where it was"""

    scan: np.ndarray
    sensor_world: np.ndarray


@dataclass(frozen=True)
class Cloud:
    """The points of all scans in the world frame, in scan order.

    points_world: (M, 3) float32, m
    scan_offsets: (S + 1,) int64: scan s owns points scan_offsets[s] to scan_offsets[s + 1]
    scan_times: (S,) float64, s
    sensor_world: (S, 3) float64, m, where the LiDAR was; None: unknown
    """

    points_world: np.ndarray
    scan_offsets: np.ndarray
    scan_times: np.ndarray
    sensor_world: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.points_world)

    def scan_of(self, points: Indices) -> np.ndarray:
        """The scans (K,) int32 that measured points of these numbers (K,)."""
        return np.searchsorted(self.scan_offsets, points, side="right").astype(np.int32) - np.int32(1)

    def origins(self, points: Indices) -> Origins | None:
        """From where points of these numbers (K,) were measured; None: unknown."""
        return None if self.sensor_world is None else Origins(self.scan_of(points), self.sensor_world)

    def without(self, points: np.ndarray) -> "Cloud":
        """The cloud without some points. points: (M,) bool, which"""
        before = np.concatenate([[0], np.cumsum(points, dtype=np.int64)])
        return replace(
            self,
            points_world=self.points_world[~points],
            scan_offsets=self.scan_offsets - before[self.scan_offsets],
        )


@dataclass(frozen=True)
class Blocks:
    """An order of points in which neighbors in space are neighbors in memory.

    order: (M,) int32, indices into the cloud
    start: (B + 1,) int64: block b owns order[start[b] : start[b + 1]]; no block is empty
    spheres: (B, 4) float32, m, center and radius
    """

    order: np.ndarray
    start: np.ndarray
    spheres: np.ndarray

    def holding(self, points: np.ndarray) -> BlockPoints:
        """The points (3, M) float32, m, world, in this order, as kernels take them."""
        return BlockPoints(points, self.start, self.spheres)

    def spans(self, most: int) -> list[slice]:
        """All blocks, in order, in about equal pieces of at most so many points, or of one block that has more."""
        spans, first, count = list[slice](), 0, int(self.start[-1])
        most = -(-count // max(1, -(-count // most)))
        while first < len(self.spheres):
            last = int(np.searchsorted(self.start, self.start[first] + most, side="right")) - 1
            spans.append(slice(first, max(last, first + 1)))
            first = spans[-1].stop
        return spans


def assemble(
    load_scan: Callable[[int], np.ndarray],
    world_from_scan: Poses,
    scan_times: Times,
    progress: Progress = silent,
    sensor_position: Vector | None = None,
) -> Cloud:
    """The cloud of all scans moved by their poses; points that are not finite are left out.

    load_scan: gives the (N, 3) float32 points of a scan, scan frame; world_from_scan: (S, 4, 4); scan_times: (S,)
    sensor_position: (3,), m, where the LiDAR is in the scan frame; None: unknown
    """

    def move(s: int) -> np.ndarray:
        points = geometry.finite(np.ascontiguousarray(load_scan(s), np.float32))
        out = np.empty_like(points)
        kernels.transform(points, np.ascontiguousarray(world_from_scan[s], float), out)
        return out

    moved = []
    for points in in_order(move, range(len(world_from_scan))):
        moved.append(points)
        progress("assemble cloud", len(moved), len(world_from_scan))
    offsets = np.concatenate([[0], np.cumsum([len(points) for points in moved], dtype=np.int64)]).astype(
        np.int64
    )
    points_world = np.concatenate(moved) if moved else np.empty((0, 3), np.float32)
    sensor_world = None
    if sensor_position is not None:
        sensor_world = world_from_scan[:, :3, :3] @ sensor_position + world_from_scan[:, :3, 3]
    return Cloud(points_world, offsets, np.asarray(scan_times, float), sensor_world)


def sort_into_blocks(points_world: CloudPoints, min_edge: float = _MIN_EDGE_M) -> Blocks:
    """Blocks of (M, 3) float32 points: cubes of at least `min_edge` (m), larger where the map would need too many."""
    if not len(points_world):
        return Blocks(np.empty(0, np.int32), np.zeros(1, np.int64), np.empty((0, 4), np.float32))
    low, high = _robust_bounds(points_world)
    edge = max(min_edge, float(np.prod(np.maximum(high - low, min_edge)) / _MAX_BLOCKS) ** (1 / 3))
    shape = np.maximum(np.ceil((high - low) / edge), 1).astype(np.int64)
    cell = kernels.cell_index(points_world, low, edge, shape)
    order, start = kernels.counting_order(cell, int(np.prod(shape)))
    start = start[np.concatenate([[True], np.diff(start) > 0])]
    return Blocks(order, start, kernels.bounding_spheres(points_world[order], start))


def surfaces(points: np.ndarray, blocks: Blocks, origins: Origins | None, max_angle: float) -> np.ndarray:
    """The surface at each point, (M, 8) float32, see `lvba.kernels.facing.surfaces`.

    Without origins, normals are of either side, and TO_LIDAR is zero.

    points: (3, M) float32, m, world, in the order of their blocks; origins: of the points before they were sorted
    max_angle: rad, of views off the normal
    """
    if origins is None:
        scan, sensors = np.zeros(points.shape[1], np.int32), np.full((1, 3), _NOWHERE, np.float32)
    else:
        scan, sensors = origins.scan[blocks.order], origins.sensor_world.astype(np.float32)
    surfaces_ = facing_kernels.surfaces(points, blocks.start, scan, sensors, max_angle)
    scatter, known = surfaces_[:, facing_kernels.SCATTER], surfaces_[:, : facing_kernels.TO_LIDAR].any(1)
    trusted = known if known.any() else scatter >= 0
    typical = np.float32(np.median(scatter[trusted])) if trusted.any() else _UNKNOWN_SCATTER_M
    # few points may lie on a plane by chance, and fewer tell nothing
    least = np.where(known, _LEAST_SCATTER * typical, np.where(scatter < 0, typical, scatter))
    np.maximum(scatter, least, out=scatter)
    np.maximum(scatter, _LEAST_SCATTER_M, out=scatter)
    if origins is None:
        surfaces_[:, facing_kernels.TO_LIDAR : facing_kernels.SCATTER] = 0.0
    return surfaces_


def thin(points_world: np.ndarray, voxel: float) -> np.ndarray:
    """Indices (K,) int64, ascending, of one point per voxel of edge `voxel` (m): the one nearest to its center.

    points_world: (M, 3) float32, m. The points kept are measured ones, not averages: nothing is moved.
    """
    if voxel <= 0 or not len(points_world):
        return np.arange(len(points_world))
    low, high = _robust_bounds(points_world)
    volume = float(np.prod(np.maximum(high - low, _MIN_EDGE_M)))
    edge = voxel * np.ceil(max(_MIN_EDGE_M, (volume / _MAX_BLOCKS) ** (1 / 3)) / voxel)
    low = np.floor(low / edge) * edge
    shape = np.maximum(np.ceil((high - low) / edge), 1).astype(np.int64)
    order, start = kernels.counting_order(
        kernels.cell_index(points_world, low, edge, shape), int(np.prod(shape))
    )
    return np.flatnonzero(kernels.thin_blocks(points_world, order, start, voxel))


def thin_to(points_world: np.ndarray, most: int) -> np.ndarray:
    """Indices (K,) int64, ascending, of at most `most` points, evenly spread: `thin` with larger and larger voxels.

    points_world: (M, 3) float32, m
    """
    kept, voxel = np.arange(len(points_world)), 0.01
    while len(kept) > most:
        kept = kept[thin(points_world[kept], voxel)]
        voxel *= 1.25
    return kept


def _robust_bounds(points_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners of a box that holds nearly all points: a few stray far points shall not make the blocks huge."""
    sample = points_world[:: max(1, len(points_world) // 20000)].astype(float)
    low, high = np.quantile(sample, [0.005, 0.995], axis=0)
    margin = 0.1 * (high - low) + 1e-3
    return low - margin, high + margin
