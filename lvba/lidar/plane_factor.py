"""The plane cost as a term of normal equations: half the weighted squared distances of points to their best planes."""

import numpy as np

from lvba import geometry
from lvba.arrays import PoseBlocks, Poses
from lvba.kernels import lidar as kernel
from lvba.kernels.lidar import TILE
from lvba.lidar import panels
from lvba.lidar.panels import Panels
from lvba.lidar.plane_feature import PlaneFeatures, PlaneFits, fit
from lvba.optim.normal_equations import NormalEquations


def linearize(
    features: PlaneFeatures,
    world_from_scan: Poses,
    sigma: float,
    fits: PlaneFits | None = None,
    exact: bool = True,
) -> NormalEquations:
    """Cost, exact gradient and exact (or Gauss-Newton) Hessian of the planes at poses (S, 4, 4), the planes eliminated.

    sigma: m, standard deviation of a point's distance to its plane at weight 1
    fits: of the planes at these poses, if at hand
    Source of the derivatives: `kernels.lidar`, from world axes to the tangent of `lvba.geometry`.
    """
    fits = fit(features, world_from_scan) if fits is None else fits
    poses, rotation = np.ascontiguousarray(world_from_scan), np.ascontiguousarray(world_from_scan[:, :3, :3])
    clusters = features.clusters.weighted(features.weight)
    laid = panels.pack(features, len(world_from_scan))
    gradient, diagonal, columns = kernel.linearize(
        poses,
        panels.by_scan(features, len(world_from_scan)),
        features.feature,
        clusters.arrays,
        fits.arrays,
        laid.panel,
        len(laid.feature),
        exact,
    )
    scale = 0.5 / sigma**2  # the kernel's cost is the sum of squares
    gradient = np.einsum("nji,nkj->nki", rotation, gradient.reshape(-1, 2, 3)).reshape(-1, 6) * scale
    rows, columns_of, blocks = hessian_blocks(laid, diagonal, columns, poses)
    blocks *= scale
    if exact:
        _add_screw_curvature(blocks, rows == columns_of, gradient)
    return NormalEquations(
        rows=rows, columns=columns_of, blocks=blocks, gradient=gradient, cost=fits.cost * scale
    )


def _add_screw_curvature(blocks: np.ndarray, own: np.ndarray, gradient: np.ndarray) -> None:
    """From second derivatives along `t <- t + R v`, the kernel's, to those along `geometry.retract`, in place.

    That moves t by R (v + w x v / 2) to second order, so the cost has g . (w x v) / 2 more, g its gradient by v.
    """
    half = 0.5 * geometry.hat(gradient[:, 3:])
    blocks[own, 3:, :3] += half
    blocks[own, :3, 3:] += np.swapaxes(half, 1, 2)


def hessian_blocks(
    laid: Panels, diagonal: PoseBlocks, columns: np.ndarray, world_from_scan: Poses
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows (M,), columns (M,) and blocks (M, 6, 6) of D - W W' of all pairs of scans that see a plane together.

    diagonal: (S, 6, 6), D; columns: (P, 3, 6 TILE) float64, W in panels; both in world axes
    world_from_scan: (S, 4, 4), C-contiguous
    """
    return blocks_of_tiles(laid, panels.pairs_of_tiles(laid), diagonal, columns, world_from_scan)


def blocks_of_tiles(
    laid: Panels, pairs: np.ndarray, diagonal: PoseBlocks, columns: np.ndarray, world_from_scan: Poses
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same of some pairs of tiles only, by rows, then columns.

    pairs: (Q, 2) int64, the first tile not after the second; diagonal, columns, world_from_scan: as in `hessian_blocks`
    columns: (P, 3, 6 TILE) float64
    """
    coupled = kernel.coupled(laid.arrays, pairs, len(world_from_scan))
    pair, first, second = np.nonzero(coupled)
    rows, columns_of = TILE * pairs[pair, 0] + first, TILE * pairs[pair, 1] + second
    order = np.lexsort((columns_of, rows))
    slot = np.full(coupled.shape, -1, np.int32)
    slot[pair[order], first[order], second[order]] = np.arange(len(order), dtype=np.int32)
    blocks = kernel.hessian(laid.arrays, diagonal, columns, world_from_scan, pairs, slot, len(order))
    return rows[order].astype(np.int32), columns_of[order].astype(np.int32), blocks
