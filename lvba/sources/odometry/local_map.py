"""The map of the last scans, and a scan registered to it: small_gicp's Gaussian voxels."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from lvba.arrays import Pose
from lvba.errors import InputError

_KEPT_SCANS = 100
_NEIGHBORS = 12
_STEPS = 30
_NORMAL_SIGMA_M = np.sqrt(2e-3)
"""By which small_gicp divides distances along normals: planes have a variance of 1e-3 m^2 there, of each of the two."""


@dataclass(frozen=True)
class Registered:
    """A scan laid over the map.

    map_from_lidar: (4, 4)
    matched: part of the scan's points that found a voxel; points: how many were tried
    residual: m, rms distance of matched points from the surfaces of the map, along their normals
    """

    map_from_lidar: Pose
    matched: float
    points: int
    residual: float


class LocalMap:
    """The surfaces that the last scans have seen. voxel: m, edge of its cells."""

    def __init__(self, voxel: float) -> None:
        self._gicp = load()
        self.voxel = voxel
        self._map = self._gicp.GaussianVoxelMap(voxel)
        self._map.set_lru(_KEPT_SCANS, 10)

    def prepared(self, points: np.ndarray) -> Any:
        """Points, thinned, with the covariances of their surroundings.

        points: (N, 3) float64, m, LiDAR frame
        """
        cloud, _ = self._gicp.preprocess_points(points, self.voxel / 2, _NEIGHBORS, 1)
        return cloud

    def add(self, cloud: Any, map_from_lidar: Pose) -> None:
        """Takes a scan (of `prepared`) into the map."""
        self._map.insert(cloud, map_from_lidar)

    def register(self, cloud: Any, map_from_lidar: Pose, reach: float) -> Registered:
        """Lays a scan (of `prepared`) over the map, from a first guess of its pose. reach: m, to a point's partner."""
        registered = self._gicp.align(
            self._map,
            cloud,
            map_from_lidar,
            max_correspondence_distance=reach,
            max_iterations=_STEPS,
            rotation_epsilon=1e-5,
            translation_epsilon=1e-4,
        )
        count, inliers = int(cloud.size()), int(registered.num_inliers)
        scatter = 2 * float(registered.error) / max(inliers, 1)
        return Registered(
            map_from_lidar=np.array(registered.T_target_source),
            matched=inliers / max(count, 1),
            points=count,
            residual=float(np.sqrt(scatter) * _NORMAL_SIGMA_M),
        )


def load() -> Any:
    """small_gicp.

    Raises InputError: it is not installed.
    """
    try:
        import small_gicp
    except ImportError as error:
        raise InputError("odometry", "needs small_gicp", "pip install 'lvba[odometry]'") from error
    return small_gicp
