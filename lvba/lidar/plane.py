"""The planes of the LiDAR map and the points that lie on them."""

from dataclasses import dataclass, replace

import numpy as np

from lvba.arrays import Vectors


@dataclass(frozen=True)
class Planes:
    """K planes of the refined LiDAR map, world frame.

    center: (K, 3) float64, m, mean of the plane's points
    normal: (K, 3) float64, unit, turned towards the sensors that saw it
    eigenvalues: (K, 3) float64, m^2, ascending, of the (weighted) point covariance
    axes: (K, 3, 3) float64, columns are the unit eigenvectors in the order of `eigenvalues`
    count: (K,) int64, points
    scans: (K,) int32, number of scans that saw it
    size: (K,) float64, m, edge of the voxel it fills
    sigma_offset: (K,) float64, m, standard deviation of the offset along the normal at the centre
    unevenness: (K,) float64, m, root mean square of what the surface is off its plane, beyond the noise of its points
    """

    center: np.ndarray
    normal: np.ndarray
    eigenvalues: np.ndarray
    axes: np.ndarray
    count: np.ndarray
    scans: np.ndarray
    size: np.ndarray
    sigma_offset: np.ndarray
    unevenness: np.ndarray

    def __len__(self) -> int:
        return len(self.count)


@dataclass(frozen=True)
class PlanePoints:
    """The scan points of all scans, moved by the refined poses, with the plane each lies on.

    points_world: (M, 3) float32, m (raw points, not projected on their plane)
    plane: (M,) int32, index into Planes, -1 where the point lies on none
    scan_offsets: (S + 1,) int64: scan s owns points scan_offsets[s] to scan_offsets[s + 1]
    """

    points_world: np.ndarray
    plane: np.ndarray
    scan_offsets: np.ndarray

    def on_none(self, points: np.ndarray) -> "PlanePoints":
        """The same with some points on no plane. points: (M,) bool, which"""
        return replace(self, plane=np.where(points, np.int32(-1), self.plane))


@dataclass(frozen=True)
class Surfaces:
    """Planes and their points, and when these were measured.

    scan_times: (S,) float64, s, ascending, of the scans in `points`
    """

    planes: Planes
    points: PlanePoints
    scan_times: np.ndarray


def axes_of(eigenvectors: np.ndarray, normal: Vectors) -> np.ndarray:
    """The right-handed axes (K, 3, 3), columns, of planes with these normals (K, 3).

    eigenvectors: (K, 3, 3) float64, rows, the first along the normal, up to its sign
    """
    axes = np.swapaxes(eigenvectors, 1, 2).copy()
    axes[:, :, 0] = normal
    axes[np.linalg.det(axes) < 0, :, 2] *= -1
    return axes


def no_planes() -> Planes:
    """None at all."""
    none = np.zeros(0)
    return Planes(
        center=np.zeros((0, 3)), normal=np.zeros((0, 3)), eigenvalues=np.zeros((0, 3)), axes=np.zeros((0, 3, 3)),
        count=none.astype(np.int64), scans=none.astype(np.int32), size=none, sigma_offset=none,
        unevenness=none,
    )  # fmt: skip


def no_plane_points() -> PlanePoints:
    """Points of no scan."""
    return PlanePoints(np.zeros((0, 3), np.float32), np.zeros(0, np.int32), np.zeros(1, np.int64))
