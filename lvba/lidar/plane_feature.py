"""Plane features: which scans see which plane, as point clusters in the scans' own frames."""

from dataclasses import dataclass, replace

import numpy as np

from lvba.arrays import Poses
from lvba.kernels import lidar as kernel
from lvba.lidar.point_cluster import PointClusters, concatenate


@dataclass(frozen=True)
class PlaneFeatures:
    """F planes and the O observations of them.

    offsets: (F + 1,) int64, feature f owns observations offsets[f] to offsets[f + 1], ascending in scan
    scan: (O,) int32
    clusters: O point clusters, scan frame
    weight: (O,) float64, how much a point of the observation counts
    size: (F,) float64, m, edge of the voxel
    """

    offsets: np.ndarray
    scan: np.ndarray
    clusters: PointClusters
    weight: np.ndarray
    size: np.ndarray

    def __len__(self) -> int:
        return len(self.offsets) - 1

    @property
    def feature(self) -> np.ndarray:
        """The feature of each observation, (O,) int32."""
        return np.repeat(np.arange(len(self), dtype=np.int32), np.diff(self.offsets))

    def with_weight(self, weight: np.ndarray) -> "PlaneFeatures":
        """The same observations, trusted otherwise."""
        return replace(self, weight=weight)

    def select(self, keep: np.ndarray) -> "PlaneFeatures":
        """The features where keep (F,) bool holds."""
        kept = keep[self.feature]
        offsets = np.concatenate([[0], np.cumsum(np.diff(self.offsets)[keep])]).astype(np.int64)
        return PlaneFeatures(
            offsets, self.scan[kept], self.clusters.take(kept), self.weight[kept], self.size[keep]
        )

    def observations_where(self, keep: np.ndarray) -> "PlaneFeatures":
        """The observations where keep (O,) bool holds, of features that two scans or more see then."""
        counts = np.bincount(self.feature[keep], minlength=len(self))
        offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        kept = PlaneFeatures(offsets, self.scan[keep], self.clusters.take(keep), self.weight[keep], self.size)
        return kept.select(counts > 1)

    def joined(self, other: "PlaneFeatures") -> "PlaneFeatures":
        """These features, then those of another, of the same scans."""
        return PlaneFeatures(
            np.concatenate([self.offsets, self.offsets[-1] + other.offsets[1:]]),
            np.concatenate([self.scan, other.scan]),
            concatenate([self.clusters, other.clusters]),
            np.concatenate([self.weight, other.weight]),
            np.concatenate([self.size, other.size]),
        )


@dataclass(frozen=True)
class PlaneFits:
    """The best plane of each of F features, world frame.

    total: (F,) float64, weighted number of points
    center: (F, 3) float64, m
    eigenvalues: (F, 3) float64, m^2, ascending, of the weighted point covariance
    eigenvectors: (F, 3, 3) float64, rows, in the order of the eigenvalues: row 0 is the normal
    """

    total: np.ndarray
    center: np.ndarray
    eigenvalues: np.ndarray
    eigenvectors: np.ndarray

    @property
    def arrays(self) -> kernel.Fits:
        """As kernels take them."""
        return kernel.Fits(self.total, self.center, self.eigenvalues, self.eigenvectors)

    @property
    def cost(self) -> float:
        """Sum of weighted squared distances of points to their plane, m^2."""
        return float(np.sum(self.total * self.eigenvalues[:, 0]))

    @property
    def normal(self) -> np.ndarray:
        """(F, 3), unit, of either sign."""
        return self.eigenvectors[:, 0]


def fit(features: PlaneFeatures, world_from_scan: Poses) -> PlaneFits:
    """The best planes at poses world_from_scan (S, 4, 4)."""
    clusters = features.clusters.weighted(features.weight)
    poses = np.ascontiguousarray(world_from_scan)
    fits = kernel.fit(poses, features.offsets, features.scan, clusters.arrays)
    return PlaneFits(fits.total, fits.center, fits.eigenvalues, fits.eigenvectors)
