"""A part's map as surfels: small enough to be sent around, enough to recognize the place and to align it."""

from dataclasses import dataclass

import numpy as np

from lvba import geometry
from lvba.arrays import Indices, Pose, PoseBlocks, Poses, Vector
from lvba.lidar.bundle_adjustment import LidarResult
from lvba.lidar.plane import PlanePoints, Planes
from lvba.settings import check_ranges


@dataclass(frozen=True)
class SubmapConfig:
    """How a map is thinned."""

    cell: float = 0.4
    """m, edge of the cells that hold one surfel of each plane in them; 0.05 to 5."""
    least_cell: float = 0.1
    """m: cells are halved down to this where they are few and full, as in small rooms; 0.02 to 5."""
    enough: int = 2500
    """Surfels that are not few; 0 to 1000000."""
    full: int = 64
    """Points of a surfel, in the median, that are enough for smaller ones; 4 to 100000."""
    min_points: int = 4
    """Fewest points of a surfel; 1 to 1000."""

    def __post_init__(self) -> None:
        check_ranges(
            self,
            "submap",
            cell=(0.05, 5),
            least_cell=(0.02, 5),
            enough=(0, 1_000_000),
            full=(4, 100_000),
            min_points=(1, 1000),
        )


@dataclass(frozen=True)
class Submap:
    """The surfaces that the scans of a part saw, world frame of that part.

    center: (K, 3) float32, m; normal: (K, 3) float32, unit, towards the sensors; thickness: (K,) float32, m, standard
        deviation of points about the plane; weight: (K,) float32, points
    observer: (K,) int32, a scan (index in the part) that saw the surfel, the nearest one
    world_from_scan: (n, 4, 4) float64, the part's poses; sensor: (n, 3) float64, m, where the LiDAR was
    covariance: (n, 6, 6) float64, of each pose against the map around it, local tangent [rotation | translation], rad, m
    scans: (n,) int64, indices of the scans in the whole
    cell: m
    """

    center: np.ndarray
    normal: np.ndarray
    thickness: np.ndarray
    weight: np.ndarray
    observer: np.ndarray
    world_from_scan: np.ndarray
    sensor: np.ndarray
    covariance: np.ndarray
    scans: np.ndarray
    cell: float

    def __len__(self) -> int:
        return len(self.weight)


def build(
    planes: Planes,
    points: PlanePoints,
    world_from_scan: Poses,
    scans: np.ndarray,
    *,
    covariance: PoseBlocks | None = None,
    sensor_position: Vector | None = None,
    config: SubmapConfig | None = None,
) -> Submap:
    """The surfels of a part.

    world_from_scan: (n, 4, 4), refined; scans: (n,) int64, indices in the whole
    covariance: (n, 6, 6), of each pose against the map around it; None: they are exact
    sensor_position: (3,), m, scan frame
    """
    config = config or SubmapConfig()
    offset = np.zeros(3) if sensor_position is None else np.asarray(sensor_position, float)
    sensor = world_from_scan[:, :3, :3] @ offset + world_from_scan[:, :3, 3]
    scan = np.repeat(np.arange(len(scans)), np.diff(points.scan_offsets))
    size = config.cell
    kept = _surfels(points, size, config.min_points)
    while len(kept.starts) < config.enough and kept.typical >= config.full and size >= 2 * config.least_cell:
        size *= 0.5
        kept = _surfels(points, size, config.min_points)
    center, count, plane = kept.means(points)
    distance = np.linalg.norm(points.points_world[kept.order] - sensor[scan[kept.order]], axis=1)
    return Submap(
        center=center.astype(np.float32),
        normal=planes.normal[plane].astype(np.float32),
        thickness=np.sqrt(np.maximum(planes.eigenvalues[plane, 0], 0.0)).astype(np.float32),
        weight=count.astype(np.float32),
        observer=kept.nearest(distance, scan),
        world_from_scan=np.asarray(world_from_scan, float),
        sensor=sensor,
        covariance=np.zeros((len(scans), 6, 6)) if covariance is None else np.asarray(covariance, float),
        scans=np.asarray(scans, np.int64),
        cell=size,
    )


def of_result(result: LidarResult, scans: np.ndarray, sensor_position: Vector | None) -> Submap:
    """The surfels of scans that were solved together.

    scans: (n,) int64, indices in the whole; sensor_position: (3,), m, scan frame
    """
    return build(
        result.planes,
        result.plane_points,
        result.world_from_scan,
        scans,
        covariance=result.conditional_covariance,
        sensor_position=sensor_position,
    )


@dataclass(frozen=True)
class _Surfels:
    """Points (N,) in the order of their surfels, and where in it each surfel begins."""

    order: np.ndarray
    starts: np.ndarray

    @property
    def typical(self) -> float:
        """Points of a surfel, the median."""
        return float(np.median(np.diff(self.starts, append=len(self.order)))) if len(self.starts) else 0.0

    def means(self, points: PlanePoints) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Centers (K, 3), numbers of points (K,) and planes (K,)."""
        count = np.diff(self.starts, append=len(self.order))
        if len(count) == 0:
            return np.zeros((0, 3)), count, np.zeros(0, np.int64)
        total = np.add.reduceat(points.points_world[self.order].astype(float), self.starts)
        return total / count[:, None], count, points.plane[self.order[self.starts]]

    def nearest(self, distance: np.ndarray, scan: np.ndarray) -> np.ndarray:
        """The scan of the nearest point of each, (K,) int32.

        distance: (N,) m, in the order of the surfels; scan: of all points
        """
        if len(self.starts) == 0:
            return np.zeros(0, np.int32)
        # to the millimeter, then the first scan
        packed = (np.round(distance * 1000).astype(np.int64) << 32) | scan[self.order]
        return np.asarray(np.minimum.reduceat(packed, self.starts) & 0xFFFFFFFF, np.int32)


def _surfels(points: PlanePoints, size: float, min_points: int) -> _Surfels:
    """Points on the same plane in the same cell, where there are enough of them."""
    on_plane = np.flatnonzero(points.plane >= 0)
    keys = _cell_keys(points.points_world[on_plane], points.plane[on_plane], size)
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    first = np.concatenate([np.ones(min(len(keys), 1), bool), ordered[1:] != ordered[:-1]])
    count = np.diff(np.flatnonzero(first), append=len(order))
    enough = count >= min_points
    kept = on_plane[order[np.repeat(enough, count)]]
    return _Surfels(kept, np.concatenate([[0], np.cumsum(count[enough])])[:-1].astype(np.int64))


def _cell_keys(xyz: np.ndarray, plane: np.ndarray, size: float) -> np.ndarray:
    """(M,) int64, equal for points in the same cell and on the same plane."""
    if len(xyz) == 0:
        return np.zeros(0, np.int64)
    cell = np.floor(xyz / size).astype(np.int64)
    cell -= cell.min(0)
    extent = cell.max(0) + 1
    flat = (cell[:, 0] * extent[1] + cell[:, 1]) * extent[2] + cell[:, 2]
    return np.asarray(flat * (int(plane.max()) + 1) + plane)


@dataclass(frozen=True)
class Patch:
    """The surfels of a submap around one of its scans, in the frame of that scan.

    center, normal: (K, 3) float64; observer: (K, 3) float64, m, where the sensor was; thickness: (K,) float64, m
    cell: m
    """

    center: np.ndarray
    normal: np.ndarray
    observer: np.ndarray
    thickness: np.ndarray
    cell: float

    def __len__(self) -> int:
        return len(self.center)

    def take(self, index: Indices) -> "Patch":
        """The surfels at `index` (any numpy index)."""
        return Patch(
            self.center[index], self.normal[index], self.observer[index], self.thickness[index], self.cell
        )

    def moved(self, a_from_b: Pose) -> "Patch":
        """The same surfels in frame a, given in b."""
        center, observer = (geometry.transform_points(a_from_b, p) for p in (self.center, self.observer))
        return Patch(center, self.normal @ a_from_b[:3, :3].T, observer, self.thickness, self.cell)


def around(submap: Submap, scan: int, radius: float) -> Patch:
    """What a submap holds within `radius` (m) of the sensor at one of its scans (index in the whole).

    Raises KeyError: the part does not hold that scan.
    """
    here = index_of(submap, scan)
    near = np.linalg.norm(submap.center - submap.sensor[here], axis=1) <= radius
    world = Patch(
        submap.center[near].astype(float),
        submap.normal[near].astype(float),
        submap.sensor[submap.observer[near]],
        submap.thickness[near].astype(float),
        submap.cell,
    )
    return world.moved(geometry.inverse(submap.world_from_scan[here]))


def index_of(submap: Submap, scan: int) -> int:
    """Which of a part's scans has that index in the whole.

    Raises KeyError: none.
    """
    indices = np.flatnonzero(submap.scans == scan)
    if len(indices) == 0:
        raise KeyError(f"the part does not hold scan {scan}")
    return int(indices[0])


def uncertainty(submap: Submap, scan: int, radius: float) -> np.ndarray:
    """Covariance (6, 6) of a scan against the surfaces within `radius` (m) of it, local tangent [rotation | translation].

    Surfaces are where the scans that saw them have put them: its own uncertainty and that of the scans on the way to
    them, each as often as a surface lies beyond.
    """
    here = index_of(submap, scan)
    near = np.linalg.norm(submap.center - submap.sensor[here], axis=1) <= radius
    count = np.bincount(submap.observer[near], minlength=len(submap.scans)) / max(int(near.sum()), 1)
    after, before = np.cumsum(count[::-1])[::-1], np.cumsum(count)
    beyond = np.where(np.arange(len(count)) > here, after, before)
    beyond[here] = 1.0
    carried = geometry.adjoint(geometry.inverse(submap.world_from_scan[here]) @ submap.world_from_scan)
    return np.asarray(np.einsum("n,nij,njk,nlk->il", beyond, carried, submap.covariance, carried))
