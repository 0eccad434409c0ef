"""The map that users keep: points, colors and how sure they are, as columns of a PLY or LAZ file."""

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from lvba.camera import Camera
from lvba.products import colorize
from lvba.products.cloud import Cloud, Origins, thin
from lvba.products.colorize import ColorizeConfig
from lvba.products.views import Views
from lvba.progress import Progress, silent
from lvba.settings import Group, setting

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class MapConfig(Group):
    """The map that users keep."""

    colors: Literal["blended", "paper"] = setting(
        "blended",
        meaning="blended: several views per point, none where a point is hidden; paper: one view per point, eq. (10), "
        "without a test of occlusion.",
        choices=("blended", "paper"),
        change_when="The colors are to be compared with those of the paper.",
    )
    blend: ColorizeConfig = field(default_factory=ColorizeConfig)
    voxel_m: float = setting(
        -1.0,
        meaning="One point is kept per voxel of this edge. 0 keeps every point; -1: two image pixels at the "
        "median range.",
        unit="m",
        low=0,
        high=100,
        also=(-1,),
        change_when="The map is too large (larger), or should be denser (smaller, or 0).",
    )
    keep_uncolored: bool = setting(
        True,
        meaning="Keep points that no image sees; they are gray and have views = 0.",
        change_when="The map should hold colored points only.",
    )


UNCOLORED = 128
"""Gray value of points that no image sees."""


@dataclass(frozen=True)
class PointMap:
    """The thinned, colored map.

    points_world: (K, 3) float32, m; rgb: (K, 3) uint8; views: (K,) uint8, images that colored the point;
    spread: (K,) float32, gray values 0..255, weighted RMS difference between those images
    voxel_m: the voxel edge it was thinned to
    scan: (K,) int32, the scan that measured it, or None where nobody kept that
    error: (K,) float32, m, expected error as the pose of that scan is uncertain (`products.map_error`), NaN where not
        known; None: of no point
    """

    points_world: np.ndarray
    rgb: np.ndarray
    views: np.ndarray
    spread: np.ndarray
    voxel_m: float
    scan: np.ndarray | None = None
    error: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.points_world)


def build(
    cloud: Cloud,
    views: Views,
    config: MapConfig | None = None,
    progress: Progress = silent,
    gain: float | None = None,
    camera: Camera | None = None,
) -> PointMap:
    """The map of a cloud, thinned, colored by the views, shown at their typical (median) exposure.

    gain: the exposure to show it at; None: that typical one
    camera: whose pixels the voxels follow; None: that of the views
    """
    config = config or MapConfig()
    voxel = (
        2 * pixel_footprint(cloud, views, camera or views.camera) if config.voxel_m < 0 else config.voxel_m
    )
    kept = thin(cloud.points_world, voxel)
    points, scan = cloud.points_world[kept], cloud.scan_of(kept)
    logger.info("map: %d of %d points kept at %.4f m", len(kept), len(cloud), voxel)
    gain = colorize.display_gain(views.log_exposure) if gain is None else gain
    if config.colors == "paper":
        one = colorize.paper(cloud, views, progress=progress)
        radiance = one.radiance(views.log_exposure)[kept]
        number = (one.source[kept] >= 0).astype(np.uint8)
        spread = np.zeros(len(kept), np.float32)
    else:
        origins = None if cloud.sensor_world is None else Origins(scan, cloud.sensor_world)
        del cloud, kept  # as large as all scans, while blending takes most memory
        several = colorize.blended(points, views, config.blend, origins=origins, progress=progress)
        radiance, number, spread = several.radiance, several.views, several.spread
    rgb = colorize.to_rgb8(radiance, gain, views.curve)
    rgb[number == 0] = UNCOLORED
    wanted = slice(None) if config.keep_uncolored or not len(views) else number > 0
    gray_spread = spread * np.float32(gain) * colorize.contrast(radiance, gain, views.curve)
    return PointMap(
        points_world=points[wanted],
        rgb=rgb[wanted],
        views=number[wanted],
        spread=gray_spread[wanted],
        voxel_m=voxel,
        scan=scan[wanted],
    )


def together(parts: Sequence[PointMap]) -> PointMap:
    """The maps of all parts, which lie side by side, as one."""
    columns = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in ("points_world", "rgb", "views", "spread")
    }
    scans = [part.scan for part in parts if part.scan is not None]
    return PointMap(
        **columns,
        voxel_m=parts[0].voxel_m,
        scan=np.concatenate(scans) if len(scans) == len(parts) else None,
        error=np.concatenate([_error(part) for part in parts]),
    )


def _error(point_map: PointMap) -> np.ndarray:
    """(K,) float32, m, NaN where not known."""
    if point_map.error is None:
        return np.full(len(point_map), np.nan, np.float32)
    return point_map.error.astype(np.float32, copy=False)


def pixel_footprint(cloud: Cloud, views: Views, camera: Camera) -> float:
    """The edge, m, of what a camera's pixel sees at the median distance of the cloud from the cameras; 0 without any.

    Finer detail than this is in no image. The distance of a point is that from the camera nearest in time to its scan.
    """
    if not len(cloud) or not len(views):
        return 0.0
    step = max(1, len(cloud) // 50_000)
    sample = np.arange(0, len(cloud), step)
    scan = np.searchsorted(cloud.scan_offsets, sample, side="right") - 1
    nearest = np.abs(views.times[None] - cloud.scan_times[:, None]).argmin(1)[scan]
    distance = np.linalg.norm(cloud.points_world[sample] - views.world_from_camera[nearest, :3, 3], axis=1)
    return float(np.median(distance)) / max(camera.fx, camera.fy)


@dataclass(frozen=True)
class Layout:
    """How the columns of all pieces of a map are stored, and how many points they have together.

    coordinate: float32 as long as that holds a tenth of a millimeter or so (within 2 km of zero), and float64 beyond;
    scan: None where the scan of some piece is not known
    """

    count: int
    coordinate: np.dtype
    scan: np.dtype | None


def layout(pieces: Iterable[PointMap], origin: np.ndarray) -> Layout:
    """The layout of a map in pieces; origin: (3,) float64, m, added to the points."""
    count, reach, last, known = 0, 0.0, 0, True
    for piece in pieces:
        count += len(piece)
        if len(piece):
            ends = np.stack([piece.points_world.min(0), piece.points_world.max(0)]).astype(float) + origin
            reach = max(reach, float(np.abs(ends).max()))
        if piece.scan is None:
            known = False
        else:
            last = max(last, int(piece.scan.max(initial=0)))
    scan = np.dtype(np.uint16 if last < 1 << 16 else np.uint32) if known else None
    return Layout(count, np.dtype(np.float64 if reach > 2000.0 else np.float32), scan)


def columns(point_map: PointMap, origin: np.ndarray, stored: Layout | None = None) -> dict[str, np.ndarray]:
    """The map, or a piece of it, as columns of a file, in the input's world frame.

    origin: (3,) float64, m, added to the points; stored: of all pieces, None: of this map alone
    """
    stored = stored or layout([point_map], origin)
    xyz = (point_map.points_world.astype(float) + origin).astype(stored.coordinate)
    names = dict(zip("xyz", xyz.T, strict=True))
    names |= dict(zip(("red", "green", "blue"), point_map.rgb.T, strict=True))
    names |= {"views": point_map.views, "spread": point_map.spread, "error": _error(point_map)}
    if stored.scan is not None and point_map.scan is not None:
        names["scan"] = point_map.scan.astype(stored.scan)
    return names
