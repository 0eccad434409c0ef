"""A part's map as surfels: small enough to be sent around, enough to recognize the place and to align it."""

from dataclasses import dataclass

import numpy as np

from lvba.lidar.plane import PlanePoints, Planes


@dataclass(frozen=True)
class SubmapConfig:
    """How a map is thinned."""

    cell: float = 0.4
    """m, edge of the cells that hold one surfel of each plane in them; 0.05 to 5."""
    min_points: int = 4
    """Fewest points of a surfel; 1 to 1000."""


@dataclass(frozen=True)
class Submap:
    """The surfaces that the scans of a part saw, world frame of that part.

    center: (K, 3) float32, m; normal: (K, 3) float32, unit, towards the sensors; thickness: (K,) float32, m, standard
        deviation of points about the plane; weight: (K,) float32, points
    seen_from: (K,) int32, a scan (index in the part) that saw the surfel, the nearest one
    world_from_scan: (n, 4, 4) float64, the part's poses; sensor: (n, 3) float64, m, where the LiDAR was
    scans: (n,) int64, indices of the scans in the whole
    cell: m
    """

    center: np.ndarray
    normal: np.ndarray
    thickness: np.ndarray
    weight: np.ndarray
    seen_from: np.ndarray
    world_from_scan: np.ndarray
    sensor: np.ndarray
    scans: np.ndarray
    cell: float

    def __len__(self) -> int:
        return len(self.weight)


def build(
    planes: Planes,
    points: PlanePoints,
    world_from_scan: np.ndarray,
    scans: np.ndarray,
    *,
    sensor_position: np.ndarray | None = None,
    config: SubmapConfig = SubmapConfig(),
) -> Submap:
    """The surfels of a part.

    world_from_scan: (n, 4, 4), refined; scans: (n,) int64, indices in the whole; sensor_position: (3,), m, scan frame
    """
    raise NotImplementedError
