"""A block of one large LiDAR bundle adjustment: the cells of one region of space, seen by whatever scans see it.

The cost is a sum over planes, a plane lies in one cell, and a cell belongs to one region: the normal equations of all
regions add up to those of the whole recording. Points are read once and kept as clusters of the finest cells; rounds of
association and linearization then need no points.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from lvba import geometry
from lvba.arrays import Indices, Pose, Poses, Vector, Vectors
from lvba.kernels import voxel as kernel
from lvba.lidar import degeneracy, group_factor, plane_factor, voxel_map
from lvba.lidar.config import Stage
from lvba.lidar.plane_feature import PlaneFeatures, fit
from lvba.lidar.point_cluster import PointClusters
from lvba.lidar.scan import Scans, gather
from lvba.lidar.voxel_map import Level, VoxelMap
from lvba.lidar.weights import observation_weights
from lvba.optim import normal_equations
from lvba.optim.normal_equations import NormalEquations
from lvba.optim.two_level import Groups
from lvba.progress import Progress, silent

_CHUNK = 16
"""Scans whose points are in memory at a time."""


@dataclass(frozen=True)
class Regions:
    """Which part of the recording owns which piece of space: that of the scan taken nearest to it.

    position: (S, 3) float64, m, world frame, where each scan was taken from; owner: (S,) int64, its part
    """

    position: np.ndarray
    owner: np.ndarray

    def of(self, points: Vectors) -> np.ndarray:
        """The owner (N,) of points (N, 3)."""
        return np.asarray(self.owner[cKDTree(self.position).query(points)[1]])


@dataclass(frozen=True)
class BlockClusters:
    """The finest cells of one region.

    scans: (L,) int64, ascending, the recording's scans that have points here
    size: m, edge of a cell; key (C,), starts (C + 1,), entry_scan (E,) int32 (into `scans`), clusters: as in `Level`
    grid_from_world: (4, 4), turn of the grid
    mixed: planes in cells of several surfaces, with numbers of scans as in `scans`; None: there are none
    """

    scans: np.ndarray
    size: float
    key: np.ndarray
    starts: np.ndarray
    entry_scan: np.ndarray
    clusters: PointClusters
    grid_from_world: np.ndarray
    mixed: PlaneFeatures | None = None

    def grid(self, world_from_scan: Poses, largest: float) -> VoxelMap:
        """All levels up to cells of edge `largest`, for the poses (L, 4, 4) of `scans`."""
        level = Level(
            size=self.size,
            key=self.key,
            starts=self.starts,
            scan=self.entry_scan,
            clusters=self.clusters,
            entry_of=np.zeros(0, np.int64),
        )
        none = np.zeros(len(self.scans) + 1, np.int64)
        return VoxelMap((level,), world_from_scan, np.zeros(0, np.int32), none).up_to(largest)


@dataclass(frozen=True)
class BlockEquations:
    """What one block says about the poses of its scans.

    scans: (L,) as in `BlockClusters`; equations: over these, 6 unknowns each, local tangent
    information, noise_information: (L, 6, 6), of the planes about each scan, over sigma^2, world axes (see `degeneracy`)
    planes, observations, points: how many; sigma: m, of a point about its plane
    bodies: of all groups of scans, where scans are solved at two levels (`optim.two_level`): then `equations` has pairs
        of scans of one group only; None: `equations` has all pairs
    """

    scans: np.ndarray
    equations: NormalEquations
    information: np.ndarray
    noise_information: np.ndarray
    planes: int
    observations: int
    points: float
    sigma: float
    bodies: NormalEquations | None = None


def candidates(regions: Regions, part: int, reach: float) -> np.ndarray:
    """Scans that may have points in a part's region, ascending: within twice the LiDAR's `reach` (m) of its path."""
    path = cKDTree(regions.position[regions.owner == part])
    near = path.query(regions.position, distance_upper_bound=2.0 * reach)[0]
    return np.flatnonzero(np.isfinite(near))


def collect(
    load: Callable[[list[int]], list[np.ndarray]],
    scans: Indices,
    world_from_scan: Poses,
    regions: Regions,
    part: int,
    *,
    size: float,
    largest: float,
    grid_from_world: Pose,
    mixed: PlaneFeatures | None = None,
    progress: Progress = silent,
) -> BlockClusters:
    """The block of a part.

    load: numbers of scans -> their points (N, 3) float32, scan frame
    scans: those to look at; world_from_scan: (S, 4, 4) of the whole recording
    mixed: planes in cells of several surfaces, with scan numbers of the recording
    size, largest: m, edges of the finest cells and of the coarsest (owned as a whole), powers of two apart
    Raises InputError: the grid does not reach over all these scans (`voxel_map.grid_origin`).
    """
    levels = round(np.log2(largest / size))
    poses = grid_from_world @ world_from_scan[scans]
    origin = voxel_map.grid_origin(poses[:, :3, 3], size)
    world_from_grid = geometry.inverse(grid_from_world[None])[0]
    pieces: list[tuple[np.ndarray, np.ndarray, PointClusters]] = []
    for begin, points in _chunks(load, scans):
        progress("collecting cells", begin, len(scans))
        here = slice(begin, begin + len(points))
        local, keys, cells = kernel.assign(
            points.points, points.offsets, voxel_map.at_origin(poses[here], origin), size
        )
        key = np.concatenate([keys[o : o + n] for o, n in zip(points.offsets[:-1], cells, strict=True)])
        scan = np.repeat(np.arange(begin, begin + len(points), dtype=np.int32), cells)
        mine = _owned(key, levels, largest, origin, world_from_grid, regions, part)
        clusters = PointClusters(
            *kernel.accumulate(
                points.points, points.offsets, local, _starts(cells), np.arange(len(key), dtype=np.int64)
            )
        )
        pieces.append((key[mine], scan[mine], clusters.take(mine)))
    block = _clusters(pieces, scans, size, grid_from_world)
    return block if mixed is None else replace(block, mixed=_among(mixed, block.scans))


def _among(features: PlaneFeatures, scans: np.ndarray) -> PlaneFeatures:
    """What some scans (L,) int64, ascending, see of features, with their numbers among these."""
    known = features.observations_where(np.isin(features.scan, scans))
    return replace(known, scan=np.searchsorted(scans, known.scan).astype(np.int32))


def _chunks(load: Callable[[list[int]], list[np.ndarray]], scans: np.ndarray) -> Iterator[tuple[int, Scans]]:
    for begin in range(0, len(scans), _CHUNK):
        yield begin, gather(load([int(scan) for scan in scans[begin : begin + _CHUNK]]))


def _starts(counts: np.ndarray) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)


def _owned(
    key: np.ndarray,
    levels: int,
    largest: float,
    origin: np.ndarray,
    world_from_grid: np.ndarray,
    regions: Regions,
    part: int,
) -> np.ndarray:
    """Which cells (N,) lie in a coarsest cell whose middle the part owns."""
    coarse, inverse = np.unique(key >> (3 * levels), return_inverse=True)
    middle = (kernel.cell_of(coarse) + 0.5) * largest + origin
    middle = middle @ world_from_grid[:3, :3].T + world_from_grid[:3, 3]
    return np.asarray((regions.of(middle) == part)[inverse])


def _clusters(
    pieces: list[tuple[np.ndarray, np.ndarray, PointClusters]],
    scans: np.ndarray,
    size: float,
    grid_from_world: np.ndarray,
) -> BlockClusters:
    """One block of what all chunks of scans brought, by cell and scan; scans without points in it are left out."""
    key = np.concatenate([np.zeros(0, np.int64), *(part[0] for part in pieces)])
    scan = np.concatenate([np.zeros(0, np.int32), *(part[1] for part in pieces)])
    order = np.lexsort((scan, key))
    key, scan = key[order], scan[order]
    seen, local = np.unique(scan, return_inverse=True)
    cells, first = np.unique(key, return_index=True)
    clusters = PointClusters(
        *(
            np.concatenate([getattr(part[2], name) for part in pieces])[order]
            for name in ("count", "mean", "scatter")
        )
    )
    return BlockClusters(
        scans=scans[seen],
        size=size,
        key=cells,
        starts=np.append(first, len(key)).astype(np.int64),
        entry_scan=local.astype(np.int32),
        clusters=clusters,
        grid_from_world=grid_from_world,
    )


def linearize(
    clusters: BlockClusters,
    world_from_scan: Poses,
    sensor: Vector,
    stage: Stage,
    groups: Groups | None = None,
) -> BlockEquations:
    """The planes of a block found at poses (S, 4, 4) of the whole recording, and their normal equations there.

    sensor: (3,), m, where the LiDAR is in the scan frame. Gauss-Newton, planes eliminated.
    groups: of all S scans, to have the equations at two levels; None: all pairs of scans
    """
    poses = np.ascontiguousarray(world_from_scan[clusters.scans])
    count = len(clusters.scans)
    features = _planes(clusters, poses, sensor, stage) if count else None
    if features is None or len(features) == 0:
        none = np.zeros((count, 6, 6))
        return BlockEquations(
            scans=clusters.scans,
            equations=_no_equations(count),
            information=none,
            noise_information=none,
            planes=0,
            observations=0,
            points=0.0,
            sigma=0.0,
            bodies=None if groups is None else normal_equations.empty(groups.count, 6),
        )
    weighted = observation_weights(features, poses, stage.weight_passes)
    features = features.with_weight(weighted.weight)
    fits = fit(features, poses)
    information, noise = degeneracy.information(features, fits, poses)
    bodies = None
    if groups is None:
        equations = plane_factor.linearize(features, poses, weighted.sigma, fits, exact=False)
    else:
        both = group_factor.linearize(features, poses, weighted.sigma, fits, clusters.scans, groups)
        equations, bodies = both.inner, both.bodies
    return BlockEquations(
        scans=clusters.scans,
        equations=equations,
        information=information / weighted.sigma**2,
        noise_information=noise / weighted.sigma**2,
        planes=len(features),
        observations=len(features.scan),
        points=float(features.clusters.count.sum()),
        sigma=weighted.sigma,
        bodies=bodies,
    )


def _planes(clusters: BlockClusters, poses: np.ndarray, sensor: Vector, stage: Stage) -> PlaneFeatures:
    grid = clusters.grid(poses, stage.sizes[-1])
    features = voxel_map.find_planes(grid, poses, sensor, stage.plane_test).features
    return features if clusters.mixed is None else features.joined(clusters.mixed)


def _no_equations(count: int) -> NormalEquations:
    none = np.zeros(0, np.int32)
    return NormalEquations(
        rows=none, columns=none, blocks=np.zeros((0, 6, 6)), gradient=np.zeros((count, 6)), cost=0.0
    )


def summed(blocks: Iterable[BlockEquations]) -> BlockEquations | None:
    """What all blocks say together, the planes' noise as of a typical point; None: there are none.

    Blocks are asked for one after another and added up in pairs, then pairs of pairs: in a fixed order, few of them are
    in memory at a time, and each block is copied as often as the logarithm of their number.
    """
    sums: list[tuple[int, BlockEquations]] = []
    for each in blocks:
        sums.append((0, each))
        while len(sums) > 1 and sums[-1][0] == sums[-2][0]:
            (_, later), (rank, earlier) = sums.pop(), sums.pop()
            sums.append((rank + 1, _both(earlier, later)))
    while len(sums) > 1:
        (_, later), (rank, earlier) = sums.pop(), sums.pop()
        sums.append((rank, _both(earlier, later)))
    return sums[0][1] if sums else None


def _both(a: BlockEquations, b: BlockEquations) -> BlockEquations:
    scans = np.union1d(a.scans, b.scans)
    places = [np.searchsorted(scans, each.scans) for each in (a, b)]
    information, noise = np.zeros((2, len(scans), 6, 6))
    for place, each in zip(places, (a, b), strict=True):
        information[place] += each.information
        noise[place] += each.noise_information
    points = a.points + b.points
    return BlockEquations(
        scans=scans,
        equations=normal_equations.scattered(
            [(places[0], a.equations), (places[1], b.equations)], len(scans)
        ),
        information=information,
        noise_information=noise,
        planes=a.planes + b.planes,
        observations=a.observations + b.observations,
        points=points,
        sigma=(a.sigma * a.points + b.sigma * b.points) / max(points, 1.0),
        bodies=a.bodies + b.bodies if a.bodies is not None and b.bodies is not None else None,
    )


def over_all(block: BlockEquations, count: int) -> BlockEquations:
    """The same over all of `count` scans; those that no plane sees do not occur in the equations."""
    if len(block.scans) == count:
        return block
    information, noise = np.zeros((2, count, 6, 6))
    information[block.scans], noise[block.scans] = block.information, block.noise_information
    equations = normal_equations.scattered([(block.scans, block.equations)], count)
    return replace(
        block,
        scans=np.arange(count, dtype=block.scans.dtype),
        equations=equations,
        information=information,
        noise_information=noise,
    )
