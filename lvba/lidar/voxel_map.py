"""The adaptive voxel map: cells that are split until what lies in them is a plane.

Points are touched once, to make the clusters of the finest cells; every coarser cell is a sum of finer ones.
"""

from dataclasses import dataclass, replace

import numpy as np

from lvba import geometry
from lvba.arrays import Pose, Poses, Vector, Vectors
from lvba.errors import InputError
from lvba.kernels import voxel as kernel
from lvba.kernels.voxel import CellPlanes
from lvba.lidar.plane_feature import PlaneFeatures
from lvba.lidar.point_cluster import PointClusters, concatenate
from lvba.lidar.scan import Scans

_LARGEST = 32.0
"""m, no cell is larger."""
_MARGIN = 100.0
"""m: scans are at least so far inside of the grid, as their points reach; an eighth of half of a small grid."""
_MAX_SCANS = 1 << 15
"""Scans are sorted as int16."""
_SIDES = 2
_MINOR = 0.1
"""Part of a cell's points that may lie outside of its planes; beyond, the cell is split."""


@dataclass(frozen=True)
class Level:
    """The cells of one size, in Morton order, and what the scans have in them.

    size: m, edge of a cell
    key: (C,) int64, Morton code of each cell
    starts: (C + 1,) int64, cell c owns entries starts[c] to starts[c + 1], ascending in scan
    scan: (E,) int32
    clusters: E point clusters, each in its scan's frame
    entry_of: (K,) int64, the entry that each entry of the finer level is part of; at the finest level, that each
        (cell, scan) pair is, in the order in which the points were numbered
    """

    size: float
    key: np.ndarray
    starts: np.ndarray
    scan: np.ndarray
    clusters: PointClusters
    entry_of: np.ndarray

    @property
    def cell(self) -> np.ndarray:
        """The cell of each entry, (E,) int64."""
        return np.repeat(np.arange(len(self.key)), np.diff(self.starts))


@dataclass(frozen=True)
class VoxelMap:
    """All levels, finest first, and where each point is.

    world_from_scan: (S, 4, 4), the poses that it was built with
    pair: (M,) int32, the point's (cell, scan) pair among those of its scan, -1: outside of the grid or NaN
    pair_starts: (S + 1,) int64, scan s owns the pairs pair_starts[s] to pair_starts[s + 1]
    """

    levels: tuple[Level, ...]
    world_from_scan: np.ndarray
    pair: np.ndarray
    pair_starts: np.ndarray

    def up_to(self, size: float) -> "VoxelMap":
        """The same finest cells with other coarser ones, up to edges of size (m); the levels there are stay."""
        levels = [level for level in self.levels if level.size < 1.5 * size]
        while levels[-1].size < 0.75 * size:
            levels.append(_coarser(levels[-1], len(self.world_from_scan)))
        return replace(self, levels=tuple(levels))

    def shift(self, world_from_scan: Poses) -> float:
        """How far the points of the scan that moved most are, at other poses, from where they were, m."""
        level = self.levels[-1]
        clusters, scans = level.clusters, len(world_from_scan)
        squares = clusters.count * (clusters.mean**2).sum(1) + clusters.scatter[:, [0, 3, 5]].sum(1)
        points = np.bincount(level.scan, clusters.count, scans)
        reach = np.sqrt(np.bincount(level.scan, squares, scans) / np.maximum(points, 1.0))
        motion = geometry.log(geometry.inverse(self.world_from_scan) @ world_from_scan)
        away, turn = np.linalg.norm(motion[:, 3:], axis=1), np.linalg.norm(motion[:, :3], axis=1)
        return float(np.max(away + turn * reach))


@dataclass(frozen=True)
class Association:
    """The planes found, and which observation of them each (cell, scan) pair of the finest level belongs to.

    features: F planes, O observations
    observation: (K,) int32, -1 where the pair lies on no plane
    """

    features: PlaneFeatures
    observation: np.ndarray


def build(
    scans: Scans,
    world_from_scan: Poses,
    sizes: tuple[float, ...],
    grid_from_world: Pose | None = None,
) -> VoxelMap:
    """The voxel map of the scans at some poses.

    world_from_scan: (S, 4, 4); sizes: m, finest first, each twice the one before.
    Raises InputError: too many scans, or the grid does not reach over all of them (`grid_origin`).
    """
    if len(scans) > _MAX_SCANS:
        raise InputError(
            "scans", f"{len(scans)} in one window", f"split into windows of at most {_MAX_SCANS}"
        )
    turned = world_from_scan if grid_from_world is None else grid_from_world @ world_from_scan
    origin = grid_origin(turned[:, :3, 3], sizes[0])
    local, keys, cells = kernel.assign(scans.points, scans.offsets, at_origin(turned, origin), sizes[0])
    key, entries, scan, entry = kernel.order_pairs(keys, scans.offsets, cells)
    pairs = np.concatenate([[0], np.cumsum(cells)])
    sums = kernel.accumulate(scans.points, scans.offsets, local, pairs, entry)
    levels = [
        Level(
            size=sizes[0], key=key, starts=entries, scan=scan, clusters=PointClusters(*sums), entry_of=entry
        )
    ]
    return VoxelMap(tuple(levels), world_from_scan, local, pairs).up_to(sizes[-1])


def _coarser(finer: Level, scans: int) -> Level:
    """The level above: cells of twice the size."""
    parent = finer.key >> 3
    first = _starts_of_runs(parent)
    clusters = finer.clusters
    children = np.concatenate([first, [len(parent)]])
    merged = kernel.merge_cells(children, finer.starts, finer.scan, scans, clusters.arrays)
    return Level(
        size=2.0 * finer.size,
        key=parent[first],
        starts=merged.starts,
        scan=merged.scan,
        clusters=PointClusters(merged.total, merged.mean, merged.scatter),
        entry_of=merged.entry_of,
    )


def at_origin(grid_from_scan: Poses, origin: Vector) -> np.ndarray:
    """Poses (S, 4, 4) with the grid's frame moved to an origin (3,), m, C-contiguous."""
    poses = np.array(grid_from_scan, np.float64, order="C")
    poses[:, :3, 3] -= origin
    return poses


def grid_origin(positions: Vectors, finest: float) -> np.ndarray:
    """Lowest corner of the grid, (3,) m, on a multiple of the largest cells so that cells do not depend on window and
    levels.

    positions: (S, 3) m, of the scans in the grid's frame; finest: m, edge of the finest cells
    Raises InputError: the grid does not reach over all of them.
    """
    largest = finest * 2.0 ** np.floor(np.log2(_LARGEST / finest) + 1e-6)
    middle = np.round(0.5 * (positions.min(0) + positions.max(0)) / largest) * largest
    half = np.floor(0.5 * kernel.AXIS_CELLS * finest / largest) * largest
    within = half - min(_MARGIN, half / 8)
    if not (np.abs(positions - middle) <= within).all():
        extent = np.ptp(positions, axis=0).max()
        raise InputError(
            "scan poses",
            f"the path extends by {extent / 1000:.1f} km along an axis, and cells of {finest:g} m only reach over "
            f"{2 * within / 1000:.1f} km",
            f"split the recording (--set split.by=length --set split.size={_round_down(within):g}), or correct poses "
            "that are far from all others",
        )
    return np.asarray(middle - half)


def _round_down(length: float) -> float:
    """To one digit."""
    unit = 10.0 ** np.floor(np.log10(length))
    return float(np.floor(length / unit) * unit)


def _starts_of_runs(values: np.ndarray) -> np.ndarray:
    """Where in sorted values (N,) a new one begins."""
    return np.flatnonzero(np.concatenate([np.ones(min(len(values), 1), bool), values[1:] != values[:-1]]))


@dataclass(frozen=True)
class PlaneTest:
    """When the points in a cell are one plane, and when the cell is split instead."""

    ratio: float = 1.0 / 16.0
    """Largest ratio of the smallest to the middle eigenvalue; 0.01 to 0.2. BALM2: 1/16."""
    finest_ratio: float = 1.0 / 9.0
    """The same at the finest level, where noise is a larger part of the cell; 0.01 to 0.3. BALM2: 1/9."""
    min_points: int = 16
    """Fewest points of a plane; 4 to 1000."""
    min_scans: int = 2
    """Fewest scans that see it; 1 to 10."""
    max_residual_growth: float = 0.15
    """How much larger the sum of squared distances may be than that of the finer planes in the cell, as a fraction of the
    latter; 0.05 to 1, or infinity to trust coarse planes as BALM2 does."""
    spread: float = 0.15
    """Smallest standard deviation of the points along the plane's shorter side, as a fraction of the cell; 0 to 0.25."""
    max_tilt: float = 0.02
    """rad, largest standard deviation of the normal, from the noise and number of its points; 0.001 to infinity."""
    two_sided: bool = True
    """Keep points that see a surface from opposite sides apart (thin walls)."""
    alone_up_to: float = 0.0
    """m: in cells of this size and smaller, the scans that see a plane have `min_points` on it each, on the mean. A depth
    camera's far ranges come in steps, and each step looks like a plane to cells that are smaller than it."""

    def __post_init__(self) -> None:
        for name, low, high in (("ratio", 0.0, 1.0), ("finest_ratio", 0.0, 1.0), ("spread", 0.0, 0.29)):
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"plane_test.{name} = {getattr(self, name)}; allowed: {low} to {high}")
        if self.min_points < 4 or self.min_scans < 1 or self.max_residual_growth < 0:
            raise ValueError(
                f"plane_test: min_points {self.min_points} (at least 4), min_scans {self.min_scans} (at least 1), "
                f"max_residual_growth {self.max_residual_growth} (at least 0)"
            )


def find_planes(
    voxel_map: VoxelMap,
    world_from_scan: Poses,
    sensor_position: Vector,
    test: PlaneTest,
) -> Association:
    """The planes of the map: of every cell the coarsest ones that pass the test.

    world_from_scan: (S, 4, 4), the poses that the map was built with, or others at which the points have hardly moved;
    sensor_position: (3,), m, scan frame.
    """
    sensor = world_from_scan[:, :3, :3] @ sensor_position + world_from_scan[:, :3, 3]
    levels = voxel_map.levels
    fits: list[CellPlanes] = []
    passed: list[np.ndarray] = []
    rss, covered = np.zeros(0), np.zeros(0)
    for number, level in enumerate(levels):
        cells = _fit_cells(level, world_from_scan, sensor, test)
        own, points = _squares(cells).sum(1), cells.total.sum(1)
        ok, whole = _pass(cells, level.size, test, test.finest_ratio if number == 0 else test.ratio)
        if number > 0:
            first = _first_child(levels[number - 1], level)
            finer, judged = (np.add.reduceat(v, first) if len(first) else v for v in (rss, covered))
            if np.isfinite(test.max_residual_growth):
                whole &= own * judged - finer * points <= test.max_residual_growth * finer * points
            ok &= whole[:, None]
            rss, covered = np.where(whole, own, finer), np.where(whole, points, judged)
        else:
            rss, covered = own, points
        fits.append(cells)
        passed.append(ok)
    return _collect(levels, fits, passed)


def _fit_cells(level: Level, world_from_scan: np.ndarray, sensor: np.ndarray, test: PlaneTest) -> CellPlanes:
    return kernel.fit_cells(
        level.starts,
        level.scan,
        np.ascontiguousarray(world_from_scan),
        sensor,
        level.clusters.arrays,
        test.min_points,
        test.two_sided,
    )


def _squares(cells: CellPlanes) -> np.ndarray:
    """Sum of squared distances to the plane (C, 2), m^2, as it would be if fitting took no freedom away."""
    total = cells.total
    return np.asarray(
        total * cells.eigenvalues[:, :, 0] * np.where(total > 3, total / np.maximum(total - 3, 1.0), 1.0)
    )


def _first_child(finer: Level, level: Level) -> np.ndarray:
    """The first of each cell's children, (C,), in the order of the finer level."""
    return np.searchsorted(finer.key >> 3, level.key)


def _pass(cells: CellPlanes, size: float, test: PlaneTest, ratio: float) -> tuple[np.ndarray, np.ndarray]:
    """(C, 2) which sides are planes, and (C,) whether the cell holds nothing else of weight."""
    small, middle = cells.eigenvalues[:, :, 0], cells.eigenvalues[:, :, 1]
    ok = (cells.total >= test.min_points) & (cells.scans >= test.min_scans) & (small < ratio * middle)
    ok &= middle >= (test.spread * size) ** 2
    if size <= test.alone_up_to:
        ok &= cells.total >= test.min_points * cells.scans
    if np.isfinite(test.max_tilt):
        ok &= small <= test.max_tilt**2 * middle * cells.total
    other = np.where(ok, 0.0, cells.total).sum(1)
    whole = ok.any(1) & (other <= _MINOR * cells.total.sum(1))
    return ok, whole


def _collect(levels: tuple[Level, ...], fits: list[CellPlanes], passed: list[np.ndarray]) -> Association:
    """The observations of the passed (cell, side) pairs that no coarser passed cell contains."""
    scans, counts, sizes, clusters = [], [], [], []
    closed = np.zeros(len(levels[-1].key), bool)
    observation = np.full(len(levels[-1].scan), -1, np.int32)
    done = 0
    for number in range(len(levels) - 1, -1, -1):
        level, cells, ok = levels[number], fits[number], passed[number] & ~closed[:, None]
        keep, count = _observations(level, cells.side, ok)
        observation[keep] = done + np.arange(len(keep), dtype=np.int32)
        done += len(keep)
        scans.append(level.scan[keep])
        counts.append(count)
        clusters.append(level.clusters.take(keep))
        sizes.append(np.full(len(count), level.size))
        observation = observation[level.entry_of]
        if number > 0:
            parent = np.searchsorted(level.key, levels[number - 1].key >> 3)
            closed = (closed | ok.any(1))[parent]
    scan = np.concatenate(scans)
    offsets = np.concatenate([[0], np.cumsum(np.concatenate(counts))]).astype(np.int64)
    features = PlaneFeatures(offsets, scan, concatenate(clusters), np.ones(len(scan)), np.concatenate(sizes))
    return Association(features, observation)


def _observations(level: Level, side: np.ndarray, ok: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The entries of the (cell, side) pairs ok (C, 2), by pair and scan, and the number of entries of each pair."""
    cell = level.cell
    keep = np.flatnonzero((side >= 0) & ok[cell, np.maximum(side, 0)])
    pair = cell[keep] * _SIDES + side[keep]
    order = np.argsort(pair, kind="stable")
    first = _starts_of_runs(pair[order])
    return keep[order], np.diff(first, append=len(pair))
