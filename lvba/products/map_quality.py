"""How sharp a point map is, without truth: mean map entropy and plane thickness."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lvba.arrays import CloudPoints
from lvba.kernels import map_entropy as kernels
from lvba.products.cloud import Cloud
from lvba.settings import Group, setting


@dataclass(frozen=True)
class EntropyConfig(Group):
    """Mean map entropy."""

    radius_m: float = setting(
        0.3,
        meaning="Neighborhood of each map point that its entropy is computed over.",
        unit="m",
        low=0.01,
        high=100,
        change_when="Points are sparser than this, as from the air (larger).",
        advanced=True,
    )


ENTROPY_VOXEL_M = 0.1
"""m: the map is thinned to the mean of the points in each voxel of this edge, so that dense places do not outvote."""
STRAY_PART = 0.1
"""A voxel with fewer points than this part of the usual number about it is no surface: with rain and beams split at
edges, no map is sharp. Where points are sparse, each voxel counts."""
MIN_NEIGHBORS = 10
"""Points with fewer neighbors (itself counted) are left out: of fewer the entropy is chance."""


def mean_map_entropy(cloud: Cloud, config: EntropyConfig | None = None) -> float:
    """Mean over the map of ln sqrt(det(2 pi e S)), S the covariance of a point's neighborhood; nats, lower is sharper.

    NaN where no point has neighbors enough. Source: Droeschel and Behnke 2014; radius and map as in HBA's tool, stray
    points included, for comparison with others'. Runs judge by `entropy_blocks`, without these.
    """
    config = config or EntropyConfig()
    return _blocks(voxel_means(cloud.points_world, ENTROPY_VOXEL_M), config.radius_m).mean


BLOCK_M = 2.0
"""Edge of the blocks of space over which two maps are compared: neighborhoods (0.3 m) of different blocks hardly overlap,
and rooms still have some dozens."""
_MIN_BLOCKS = 5


@dataclass(frozen=True)
class EntropyBlocks:
    """The entropies of a map, by block of space.

    keys: (B,) int64, ascending; sums: (B, 2) float64, sum of the entropies of the points in the block, nats, and how many
    """

    keys: np.ndarray
    sums: np.ndarray

    @property
    def mean(self) -> float:
        """Mean map entropy, nats; NaN where there is no point."""
        total, count = self.sums.sum(0)
        return float(total / count) if count else float("nan")


@dataclass(frozen=True)
class EntropyChange:
    """Mean map entropy of two maps of one place, nats. gain: before - after; error: its standard error, or NaN."""

    before: float
    after: float
    gain: float
    error: float


def entropy_blocks(cloud: Cloud, config: EntropyConfig | None = None) -> EntropyBlocks:
    """The entropies of a map's surfaces by block, from which means and differences are taken: without stray points."""
    config = config or EntropyConfig()
    centers, counts = _voxels(cloud.points_world, ENTROPY_VOXEL_M)
    usual = _usual(centers, counts, config.radius_m)
    return _blocks(centers[counts >= STRAY_PART * usual], config.radius_m)


def _usual(centers: np.ndarray, counts: np.ndarray, edge: float) -> np.ndarray:
    """(V,) float64: mean points of the voxels in the cube of edge `edge` (m) about each and in those that touch it.

    centers: (V, 3) float64, m; counts: (V,) float64, points of each voxel
    """
    if not len(centers):
        return np.empty(0)
    cells = np.floor(centers / edge).astype(np.int64)
    cells -= cells.min(0) - 1
    span = cells.max(0) + 2
    cubes, cube = np.unique(
        (cells[:, 0] * span[1] + cells[:, 1]) * span[2] + cells[:, 2], return_inverse=True
    )
    own = np.stack([np.bincount(cube, counts), np.bincount(cube)])
    about = np.zeros_like(own)
    for x, y, z in np.ndindex(3, 3, 3):
        beside = cubes + ((x - 1) * span[1] + y - 1) * span[2] + z - 1
        place = np.minimum(np.searchsorted(cubes, beside), len(cubes) - 1)
        about += own[:, place] * (cubes[place] == beside)
    points, voxels = about
    return np.asarray((points / voxels)[cube])


def _blocks(centers: np.ndarray, radius: float) -> EntropyBlocks:
    """By block, of the neighborhoods of the map's points (V, 3), m."""
    values = point_entropies(centers, radius, MIN_NEIGHBORS)
    known = np.isfinite(values)
    cells = np.floor(centers[known] / BLOCK_M).astype(np.int64)
    keys = ((cells[:, 0] << 21) + cells[:, 1] << 21) + cells[:, 2]
    return _merged(keys, np.stack([values[known], np.ones(np.count_nonzero(known))], axis=1))


def blocks_together(parts: Sequence[EntropyBlocks]) -> EntropyBlocks:
    """The blocks of a map that was looked at piece by piece."""
    return _merged(
        np.concatenate([part.keys for part in parts]), np.concatenate([part.sums for part in parts])
    )


def _merged(keys: np.ndarray, sums: np.ndarray) -> EntropyBlocks:
    unique, block = np.unique(keys, return_inverse=True)
    columns = [np.bincount(block.ravel(), column, len(unique)) for column in sums.T]
    return EntropyBlocks(unique, np.stack(columns, axis=1))


def entropy_change(before: EntropyBlocks, after: EntropyBlocks) -> EntropyChange:
    """How much sharper a map became, with the standard error of the gain over blocks of space.

    Both maps see the same places, so what makes one place less sharp than another cancels block by block. Linearized
    ratio estimator, blocks as clusters; NaN below five blocks.
    """
    gain = before.mean - after.mean
    keys = np.union1d(before.keys, after.keys)
    pull = np.zeros(len(keys))
    for sign, blocks in ((1.0, before), (-1.0, after)):
        if len(blocks.keys):
            off = (blocks.sums[:, 0] - blocks.mean * blocks.sums[:, 1]) / blocks.sums[:, 1].sum()
            pull[np.searchsorted(keys, blocks.keys)] += sign * off
    count = len(keys)
    error = float(np.sqrt(count / (count - 1) * (pull**2).sum())) if count >= _MIN_BLOCKS else float("nan")
    return EntropyChange(before.mean, after.mean, gain, error)


def point_entropies(points: np.ndarray, radius: float, min_neighbors: int) -> np.ndarray:
    """The (N,) float64 entropies of the neighborhoods of (N, 3) points; NaN where there are too few.

    points: (N, 3) float64, m; radius: m
    """
    if not len(points):
        return np.empty(0)
    points = np.asarray(points, float)
    cells = np.floor((points - points.min(0)) / radius).astype(np.int64) + 1
    span = int(cells.max()) + 2
    keys, order, start = _group((cells[:, 0] * span + cells[:, 1]) * span + cells[:, 2])
    values = np.empty(len(points))
    values[order] = kernels.entropies(
        np.ascontiguousarray(points[order].T), start, keys, radius, min_neighbors, span
    )
    return values


def voxel_means(points_world: CloudPoints, voxel: float) -> np.ndarray:
    """The mean (V, 3) float64 of the (N, 3) float32 points in each voxel of edge `voxel` (m), by voxel."""
    return _voxels(points_world, voxel)[0]


def _voxels(points_world: np.ndarray, voxel: float) -> tuple[np.ndarray, np.ndarray]:
    """Of each voxel of edge `voxel` (m): the mean (V, 3) float64 of its points (N, 3) float32, and how many, (V,)."""
    if not len(points_world):
        return np.empty((0, 3)), np.empty(0)
    points = np.ascontiguousarray(points_world)
    first, last = (
        np.floor(corner.astype(float) / voxel).astype(np.int64) for corner in kernels.bounds(points)
    )
    keys, sums = kernels.voxel_sums(points, voxel, first, last - first + 1)
    sums = sums[np.argsort(keys)]
    return np.asarray(sums[:, :3] / sums[:, 3:]), sums[:, 3]


CUBE_M = 0.5
"""m: edge of the cubes whose thickness is measured."""
MIN_CUBE_POINTS = 50
"""Points that such a cube needs: the covariance of fewer is chance."""
MAX_EIGENVALUE_RATIO = 1 / 16
"""A cube is planar below this ratio of least to middle eigenvalue: thinner than a quarter of its width."""


def plane_thickness(clouds: Mapping[str, Cloud]) -> dict[str, dict[str, float]]:
    """How thick the planar cubes of each map are, standard deviations across the plane in m; one row per map.

    clouds: by name, in one frame. planar: number of cubes that two scans or more see as a plane; own: mean thickness
    of these; in_<name>: mean thickness of the cubes that are planar in map <name>; NaN where there are none. A bad
    map has fewer planar cubes, not thicker ones, and a fixed set favors the map that it is drawn from: read the count
    and both sets together.
    """
    by_name = {name: planar_cubes(cloud) for name, cloud in clouds.items()}
    rows: dict[str, dict[str, float]] = {}
    for name, own in by_name.items():
        row = {"planar": float(own.planar.sum()), "own": _mean(own.thickness[own.planar])}
        for other, cubes in by_name.items():
            row[f"in_{other}"] = _mean(own.thickness[np.isin(own.key, cubes.key[cubes.planar])])
        rows[name] = row
    return rows


@dataclass(frozen=True)
class Cubes:
    """The cubes of a map with points enough.

    key: (K,) int64, which cube, ascending; thickness: (K,) float64, m; planar: (K,) bool, whether they hold a plane
    """

    key: np.ndarray
    thickness: np.ndarray
    planar: np.ndarray


def planar_cubes(cloud: Cloud) -> Cubes:
    """How thick the map is in each cube, and which of them two scans or more see as a plane."""
    if not len(cloud):
        return Cubes(np.empty(0, np.int64), np.empty(0), np.empty(0, bool))
    key = np.zeros(len(cloud), np.int64)
    for axis in range(3):  # one after another: maps are large
        key <<= 21
        key += np.floor(cloud.points_world[:, axis].astype(float) / CUBE_M).astype(np.int64)
    keys, order, start = _group(key)
    scan = np.searchsorted(cloud.scan_offsets, order, side="right")
    several = np.maximum.reduceat(scan, start[:-1]) > np.minimum.reduceat(scan, start[:-1])
    values = np.linalg.eigvalsh(kernels.cell_covariances(cloud.points_world, order, start))
    enough = np.diff(start) >= MIN_CUBE_POINTS
    planar = several & (values[:, 0] < MAX_EIGENVALUE_RATIO * values[:, 1])
    return Cubes(keys[enough], np.sqrt(np.maximum(values[enough, 0], 0)), planar[enough])


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else float("nan")


def _group(keys: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distinct keys ascending, the stable order that sorts by key, and the (K + 1,) start of each key in it."""
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    start = np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1], [True]]))
    return ordered[start[:-1]], order, start
