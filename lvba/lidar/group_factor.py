"""The plane cost at two levels (`optim.two_level`): Hessian blocks of scans within groups, and of groups as rigid bodies.

H = D - W W' (`kernels.lidar`), and a group's columns of W are those of its scans, carried to its motion and added up. So
what groups say of each other takes as many sums as planes are seen by pairs of groups, not by pairs of scans.
"""

import numpy as np

from lvba.arrays import Indices, Poses
from lvba.kernels import lidar as kernel
from lvba.kernels.lidar import TILE
from lvba.lidar import panels, plane_factor
from lvba.lidar.panels import Panels
from lvba.lidar.plane_feature import PlaneFeatures, PlaneFits
from lvba.optim.normal_equations import NormalEquations
from lvba.optim.two_level import Groups, TwoLevelEquations


def linearize(
    features: PlaneFeatures,
    world_from_scan: Poses,
    sigma: float,
    fits: PlaneFits,
    scans: Indices,
    groups: Groups,
) -> TwoLevelEquations:
    """Gauss-Newton normal equations of the planes at poses (L, 4, 4), the planes eliminated.

    sigma, fits: as in `plane_factor.linearize`; scans: (L,) int64, ascending, which scans of the recording these are
    groups: of all scans of the recording, a whole number of tiles each. What comes back is over these L scans, and over
    all groups.
    """
    seen = np.unique(scans // groups.size)
    tiles = groups.size // TILE
    # scans are numbered so that each group begins at a tile of its own
    place = groups.size * np.searchsorted(seen, scans // groups.size) + scans % groups.size
    poses = np.tile(np.eye(4), (groups.size * len(seen), 1, 1))
    poses[place] = world_from_scan
    placed = PlaneFeatures(
        features.offsets,
        place[features.scan].astype(np.int32),
        features.clusters,
        features.weight,
        features.size,
    )
    clusters = features.clusters.weighted(features.weight)
    laid = panels.pack(placed, len(poses))
    gradient, diagonal, columns = kernel.linearize(
        poses, panels.by_scan(placed, len(poses)), placed.feature, clusters.arrays, fits.arrays, laid.panel,
        len(laid.feature), False,
    )  # fmt: skip
    scale = 0.5 / sigma**2
    rows, others, blocks = plane_factor.blocks_of_tiles(
        laid, _pairs_within(len(seen), tiles), diagonal, columns, poses
    )
    local = np.full(len(poses), -1, np.int32)
    local[place] = np.arange(len(place), dtype=np.int32)
    kept = (local[rows] >= 0) & (local[others] >= 0)
    turn = world_from_scan[:, :3, :3]
    gradient = np.einsum("nji,nkj->nki", turn, gradient[place].reshape(-1, 2, 3)).reshape(-1, 6)
    inner = NormalEquations(
        rows=local[rows[kept]],
        columns=local[others[kept]],
        blocks=blocks[kept] * scale,
        gradient=gradient * scale,
        cost=fits.cost * scale,
    )
    motion = np.zeros((len(poses), 6, 6))
    motion[place] = np.einsum("nij,nkjl->nkil", turn, groups.motion[scans].reshape(-1, 2, 3, 6)).reshape(
        -1, 6, 6
    )
    rows, others, blocks = _of_bodies(laid, columns, motion, tiles)
    bodies = NormalEquations(
        rows=seen[rows].astype(np.int32),
        columns=seen[others].astype(np.int32),
        blocks=blocks * scale,
        gradient=np.zeros((groups.count, 6)),
        cost=0.0,
    )
    return TwoLevelEquations(groups, inner, bodies)


def _pairs_within(groups: int, tiles: int) -> np.ndarray:
    """(Q, 2) int64: all pairs of tiles of one group."""
    first, second = np.triu_indices(tiles)
    start = np.arange(groups)[:, None] * tiles
    return np.stack([(start + first).ravel(), (start + second).ravel()], axis=1)


def _of_bodies(
    laid: Panels, columns: np.ndarray, motion: np.ndarray, tiles: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows (M,), columns (M,) and blocks (M, 6, 6) of -W W' of all pairs of groups that see a plane together.

    columns: (P, 3, 6 TILE) float64, W in panels of scans; motion: (L, 6, 6) float64, from a group to each of its
    scans, world axes; tiles: of a group
    """
    of_tile = motion.reshape(-1, 6 * TILE, 6)
    carried = np.zeros((len(columns), 3, 6))
    for tile, (begin, end) in enumerate(zip(laid.starts[:-1], laid.starts[1:], strict=True)):
        carried[begin:end] = columns[begin:end] @ of_tile[tile]
    count = len(of_tile) // tiles
    group = np.repeat(np.arange(len(of_tile)), np.diff(laid.starts)) // tiles
    both, inverse = np.unique(laid.feature.astype(np.int64) * count + group, return_inverse=True)
    feature, group = (both // count).astype(np.int32), (both % count).astype(np.int32)
    bodies = panels.pack_observations(feature, group, count)
    by_place = np.zeros((len(bodies.feature), TILE, 3, 6))
    np.add.at(by_place, (bodies.panel[inverse], group[inverse] % TILE), carried)
    w = np.swapaxes(by_place, 1, 2).reshape(-1, 3, 6 * TILE)
    still = np.tile(np.eye(4), (count, 1, 1))
    rows, others, blocks = plane_factor.hessian_blocks(bodies, np.zeros((count, 6, 6)), w, still)
    different = rows != others
    return rows[different], others[different], blocks[different]
