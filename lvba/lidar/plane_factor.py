"""The plane cost as a term of normal equations: half the weighted squared distances of points to their best planes."""

import numpy as np

from lvba.kernels import lidar as kernel
from lvba.lidar import panels
from lvba.lidar.panels import Panels
from lvba.lidar.plane_feature import PlaneFeatures, PlaneFits, fit
from lvba.lidar.point_cluster import split
from lvba.optim.normal_equations import NormalEquations

HESSIAN_BYTES_PER_POSE_SQUARED = 6 * 6 * 8
"""Memory of the dense Hessian: this times the square of the number of scans."""


def linearize(
    features: PlaneFeatures,
    world_from_scan: np.ndarray,
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
    rotation, translation = split(world_from_scan)
    clusters = features.clusters.weighted(features.weight)
    laid = panels.lay_out(features, len(world_from_scan))
    gradient, diagonal, columns = kernel.linearize(
        rotation,
        translation,
        *panels.by_scan(features, len(world_from_scan)),
        features.feature,
        clusters.count,
        clusters.mean,
        clusters.scatter,
        fits.total,
        fits.center,
        fits.eigenvalues,
        fits.eigenvectors,
        laid.panel,
        len(laid.feature),
        exact,
    )
    scale = 0.5 / sigma**2  # the kernel's cost is the sum of squares
    gradient = np.einsum("nji,nkj->nki", rotation, gradient.reshape(-1, 2, 3)).reshape(-1, 6) * scale
    rows, columns_of, blocks = hessian_blocks(laid, diagonal, columns, rotation)
    blocks *= scale
    return NormalEquations(rows, columns_of, blocks, gradient, fits.cost * scale)


def hessian_blocks(
    laid: Panels, diagonal: np.ndarray, columns: np.ndarray, rotation: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows (M,), columns (M,) and blocks (M, 6, 6) of D - W W' of all pairs of scans that see a plane together.

    diagonal: (S, 6, 6), D; columns: (P, 3, 6 TILE), W in panels; both in world axes; rotation: (S, 3, 3), world from
        scan.
    """
    scans = len(rotation)
    rows, columns_of = np.nonzero(kernel.coupled(laid.starts, laid.feature, laid.seen, scans))
    slot = np.full((scans, scans), -1, np.int32)
    slot[rows, columns_of] = np.arange(len(rows), dtype=np.int32)
    blocks = kernel.hessian(
        laid.starts, laid.feature, laid.seen, diagonal, columns, rotation, slot, len(rows)
    )
    return rows.astype(np.int32), columns_of.astype(np.int32), blocks
