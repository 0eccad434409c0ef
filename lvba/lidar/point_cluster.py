"""Point clusters: what is kept of many points, enough for every plane cost and for moving them by a pose."""

from dataclasses import dataclass

import numpy as np

from lvba.kernels import point_cluster as kernel


@dataclass(frozen=True)
class PointClusters:
    """K sets of points.

    count: (K,) float64, number of points (or sum of their weights)
    mean: (K, 3) float64, m
    scatter: (K, 6) float64, m^2, xx xy xz yy yz zz of the sum of (p - mean)(p - mean)'
    """

    count: np.ndarray
    mean: np.ndarray
    scatter: np.ndarray

    @property
    def arrays(self) -> kernel.Clusters:
        """As kernels take them."""
        return kernel.Clusters(self.count, self.mean, self.scatter)

    def __len__(self) -> int:
        return len(self.count)

    def take(self, index: np.ndarray) -> "PointClusters":
        """The clusters at `index` (any numpy index).

        index: (N,) integers, or (K,) bool
        """
        return PointClusters(self.count[index], self.mean[index], self.scatter[index])

    def weighted(self, weight: np.ndarray) -> "PointClusters":
        """Every point of cluster k counted weight[k] times, (K,) float64.

        weight: (K,) float64
        """
        return PointClusters(self.count * weight, self.mean, self.scatter * weight[:, None])

    def moved(self, a_from_b: np.ndarray, pose: np.ndarray) -> "PointClusters":
        """Cluster k moved from frame b to a by a_from_b[pose[k]]; a_from_b (S, 4, 4), pose (K,) int32."""
        mean, scatter = kernel.transform(np.ascontiguousarray(a_from_b), pose, self.arrays)
        return PointClusters(self.count, mean, scatter)


def concatenate(parts: list[PointClusters]) -> PointClusters:
    """The clusters of all parts, in order."""
    return PointClusters(
        np.concatenate([part.count for part in parts]),
        np.concatenate([part.mean for part in parts]),
        np.concatenate([part.scatter for part in parts]),
    )
