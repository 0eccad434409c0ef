"""Scene points and who sees them: the data between point selection, visibility and the photometric solve."""

from dataclasses import dataclass, fields, replace

import cv2
import numpy as np

from lvba.arrays import Indices, Poses, Times, Vectors
from lvba.camera import Camera
from lvba.kernels import patches, patches_support
from lvba.lidar.plane import PlanePoints, Planes, Surfaces
from lvba.parallel import in_order
from lvba.settings import Group, setting
from lvba.trajectory import Trajectory, nearest_in_time
from lvba.visual.image import DARK, SATURATED, LevelImages, intrinsics_of

DOG_NOISE = 0.146
"""Standard deviation of the difference of Gaussians (sigma 1.0 and 1.6) of white noise of standard deviation 1."""
_CHUNK, _CHUNK_PIXELS = 16, 24_000_000
"""Most images whose scores are in memory at a time, and most pixels of these."""


@dataclass(frozen=True)
class ScenePoints:
    """P small planar patches, each tied to a whole pixel of its reference image at one pyramid level.

    position_world: (P, 3) float64, m: where the ray of `pixel` met the plane when the point was made
    normal_world: (P, 3) float64, unit, turned towards the reference camera
    sigma_plane: (P,) float64, m: standard deviation of the plane's offset at the point
    unevenness: (P,) float64, m: how far, root mean square, the surface is off the plane
    reference: (P,) int32, image index (into the arrays of keyframes handed to the solve)
    pixel: (P, 2) int32, (column, row) at this level
    plane: (P,) int32, index of the LiDAR plane
    is_global: (P,) bool
    """

    position_world: np.ndarray
    normal_world: np.ndarray
    sigma_plane: np.ndarray
    unevenness: np.ndarray
    reference: np.ndarray
    pixel: np.ndarray
    plane: np.ndarray
    is_global: np.ndarray

    def __len__(self) -> int:
        return len(self.reference)


@dataclass(frozen=True)
class Observations:
    """O pairs of a scene point and a target image; sorted by (point, target), no pair twice.

    point: (O,) int32, index into ScenePoints
    target: (O,) int32, image index, never the point's reference
    is_global: (O,) bool: found through the global visibility map only
    compared: in how many neighboring images a patch should be seen and was compared; alike: in how many of these it
        looks alike, before at most some per point are kept
    """

    point: np.ndarray
    target: np.ndarray
    is_global: np.ndarray
    compared: int = 0
    alike: int = 0

    def __len__(self) -> int:
        return len(self.point)


def take(points: ScenePoints, index: np.ndarray) -> ScenePoints:
    """The scene points at `index` (integers or booleans).

    index: (N,) integers, or (P,) bool
    """
    return ScenePoints(**{field.name: getattr(points, field.name)[index] for field in fields(points)})


def take_observed(
    points: ScenePoints, observations: Observations, mine: np.ndarray
) -> tuple[ScenePoints, Observations]:
    """Some of the scene points, and the observations of these. mine: (P,) bool"""
    kept = mine[observations.point]
    number = np.cumsum(mine) - 1
    return take(points, mine), replace(
        observations,
        point=number[observations.point[kept]].astype(np.int32),
        target=observations.target[kept],
        is_global=observations.is_global[kept],
    )


@dataclass(frozen=True)
class PointsConfig(Group):
    """Which LiDAR points become scene points of an image."""

    cells: int = setting(
        600,
        meaning="Grid cells per image (about 40 px on an image of 1 Mpx), with at most one scene point each.",
        low=1,
        high=100_000,
        change_when="Runs take too long (fewer), or few planes are in view and cameras stay uncertain (more).",
    )
    time_window_s: float = setting(
        0.5,
        meaning="Scans within this time of the image are projected into it; doubled up to three times where points are "
        "few.",
        unit="s",
        low=0,
        high=1e4,
        change_when="Things move in the scene (shorter), or the LiDAR is sparse or slow (longer).",
        advanced=True,
    )


@dataclass(frozen=True)
class PatchRules:
    """What patches are like. Those of scene points and those that exposures are compared over differ in this.

    size: N of the N x N patch, px, odd, 3 to 31
    max_view_angle_deg: largest angle between view direction and plane normal, eq. (2)
    min_cell_px: smallest edge of a grid cell (coarse levels get fewer points, or patches overlap)
    min_score_sigma: least |difference of Gaussians|, in standard deviations of its noise
    dark, bright: grey values up to the one and from the other on are masked
    min_usable: least part of the patch that is not masked
    tries: candidates tried per cell, best score first
    """

    size: int = 9
    max_view_angle_deg: float = 82.0
    min_cell_px: int = 8
    min_score_sigma: float = 3.0
    dark: float = DARK
    bright: float = SATURATED
    min_usable: float = 0.9
    tries: int = 12


SCENE_POINTS = PatchRules()
"""Of scene points; runs take the size from their settings."""
MIN_POINTS_IN_IMAGE = 1000
"""Fewer LiDAR points than this in an image widen its time window: their planes would cover a small part of it."""
SUPPORT_IN_IMAGE = 2.0
"""And fewer than so many times what patches all over the image need as support, for points are not spread evenly. The
finer the level, the smaller a patch on its surface: of a scan a second, 2,500 points had patches at half the size of
the images and 50 at full size, which took cameras 30 mm away from where the level before had them, 2 mm off."""
MAX_POINTS = 1_000_000
"""At most about this many LiDAR points are tried per image (a regular subset of more): more fill no more cells."""
OFF_PLANE_PART = 0.1
"""Largest part of the LiDAR points within twice the patch that may lie off its plane: things before a wall."""
OFF_PLANE_SIGMA = 4.0
"""A point is off a plane when further than this many times the plane's thickness, within the bounds below."""
OFF_PLANE_MIN_M = 0.03
"""m: never stricter than this (nor than 0.4 % of the distance), which is the noise of common LiDARs."""
OFF_PLANE_MAX_M = 0.08
"""m: never larger than this: a thing that stands out by more shifts visibly between two images."""
MIN_SUPPORT = 4
"""Least number of LiDAR points on the plane within twice the patch: three make a plane by themselves."""
ENOUGH_IN_BIN = 48
"""Points of a bin of about half a patch that say where a plane is: at coarse levels, dense scans have hundreds there."""
EXTENT_SPACINGS = 3.0
"""The support must reach the patch's four sides, looked for within this many mean spacings of LiDAR points."""
MAX_EXTENT = 0.045
"""rad: and as far as this where they are sparse in one direction: rings of spinning LiDARs are up to 2 degrees apart."""
MIN_DEPTH_M = 0.3
"""m, least distance of a scene point along the camera's axis: nearer things are the platform itself."""
HIDDEN_M = 0.15
"""m: a point this much (and 2 % of the depth) behind another is hidden by it: noise and slant stay below that."""
OCCLUSION_SPACINGS = 1.5
"""Cells of the z-buffer in mean spacings of LiDAR points (up to the patch size): few of them are empty then."""


def cell_size(camera: Camera, config: PointsConfig, rules: PatchRules = SCENE_POINTS) -> int:
    """Edge of a grid cell at this camera's size, px."""
    side = float((camera.width * camera.height / config.cells) ** 0.5)
    return max(round(side), rules.min_cell_px)


def enough_points(camera: Camera, rules: PatchRules = SCENE_POINTS) -> float:
    """LiDAR points in an image of this camera that widen its time window if they are fewer."""
    patches_in_image = camera.width * camera.height / (2 * rules.size) ** 2
    return max(MIN_POINTS_IN_IMAGE, SUPPORT_IN_IMAGE * MIN_SUPPORT * patches_in_image)


def over(config: PointsConfig, pinhole: Camera, raw: Camera | None) -> PointsConfig:
    """The configuration with cells as large in images of a pinhole as they would be in the raw ones.

    raw: the camera that images of the pinhole are made of; None: they were taken by it
    """
    if raw is None:
        return config
    larger = (pinhole.width * pinhole.height) / (raw.width * raw.height)
    return replace(config, cells=round(config.cells * larger))


def difference_of_gaussians(image: np.ndarray) -> np.ndarray:
    """|G(1.0) - G(1.6)| of the mean channel of an (H, W, C) image, (H, W) float32.

    image: (H, W, C) uint8 or float32
    """
    plain = image[..., 0].astype(np.float32) if image.shape[2] == 1 else image.mean(axis=2, dtype=np.float32)
    fine = cv2.GaussianBlur(plain, (7, 7), 1.0)
    coarse = cv2.GaussianBlur(plain, (11, 11), 1.6)
    return np.asarray(cv2.absdiff(fine, coarse))


def near_ranges(
    image_times: Times, scan_times: Times, scan_offsets: np.ndarray, window: Times, most: int
) -> np.ndarray:
    """(I, 3) int64: first point, end and step of the points of the scans within `window` (I,) s; the nearest at least.

    scan_offsets: (S + 1,) int64, see `PlanePoints`
    """
    nearest = nearest_in_time(scan_times, image_times)
    first = np.minimum(np.searchsorted(scan_times, image_times - window), nearest)
    last = np.maximum(np.searchsorted(scan_times, image_times + window, side="right"), nearest + 1)
    start, stop = scan_offsets[first], scan_offsets[last]
    return np.stack([start, stop, np.maximum(-(-(stop - start) // most), 1)], axis=1).astype(np.int64)


def kernel_points(planes: Planes, points: PlanePoints) -> patches_support.PlanePoints:
    """The points and planes as the kernels take them, each plane with the distance from which a point is off it."""
    thickness = np.sqrt(np.maximum(planes.eigenvalues[:, 0], 0))
    tolerance = np.clip(OFF_PLANE_SIGMA * thickness, OFF_PLANE_MIN_M, OFF_PLANE_MAX_M)
    return patches_support.PlanePoints(
        position=points.points_world,
        plane=points.plane,
        center=np.ascontiguousarray(planes.center),
        normal=np.ascontiguousarray(planes.normal),
        tolerance=tolerance,
    )


def point_gates(camera: Camera, rules: PatchRules, noise: float) -> patches.PointGates:
    """What LiDAR points must pass in images of this camera. noise: standard deviation of theirs, grey values"""
    half = rules.size // 2
    return patches.PointGates(
        half=half,
        tries=rules.tries,
        min_normal_cosine=float(np.cos(np.radians(rules.max_view_angle_deg))),
        min_depth=MIN_DEPTH_M,
        dark=float(rules.dark),
        bright=float(rules.bright),
        min_usable=float(rules.min_usable),
        min_score=float(max(rules.min_score_sigma * DOG_NOISE * noise, 1e-6)),
        max_off_plane=OFF_PLANE_PART,
        min_support=float(MIN_SUPPORT),
        bin=half + 0.5,
        enough=ENOUGH_IN_BIN,
        extent_spacings=EXTENT_SPACINGS,
        max_extent=MAX_EXTENT * max(camera.fx, camera.fy),
        min_buffer=max(camera.width / 160, 1.0),
        buffer_spacings=OCCLUSION_SPACINGS,
        hiding=HIDDEN_M,
    )


def select(
    level: LevelImages,
    cameras: Trajectory,
    surfaces: Surfaces,
    config: PointsConfig = PointsConfig(),
    rules: PatchRules = SCENE_POINTS,
    score: np.ndarray | None = None,
) -> ScenePoints:
    """The local scene points of every image at one pyramid level, by image and grid cell (row by row).

    cameras: of the images of the level
    score: (H, W) float32, to choose by in every image instead of the difference of Gaussians

    Source: Li et al., II-C1 and eq. (2). Ours: the point is where the ray of the whole pixel meets the plane, points
    hidden by others are left out, and the LiDAR points round the patch must lie on its plane and reach its four sides.
    """
    camera, scan_times = level.camera, surfaces.scan_times
    lidar, gates = kernel_points(surfaces.planes, surfaces.points), point_gates(camera, rules, level.noise)
    window = np.full(len(cameras), config.time_window_s)
    cell, enough = cell_size(camera, config, rules), enough_points(camera, rules)

    def of_images(chosen: np.ndarray | slice) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        ranges = near_ranges(
            cameras.times[chosen], scan_times, surfaces.points.scan_offsets, window[chosen], MAX_POINTS
        )
        poses = cameras.world_from_sensor[chosen]
        return _select_images(level.images[chosen], camera, poses, lidar, ranges, gates, cell, score)

    pixel, own, seen = of_images(slice(None))
    for _ in range(3):
        few = np.flatnonzero(seen < enough)
        if len(few) == 0 or len(scan_times) == 1:
            break
        window[few] *= 2
        pixel[few], own[few], seen[few] = of_images(few)
    image, place = np.nonzero(own >= 0)
    poses, planes = cameras.world_from_sensor, surfaces.planes
    return make_points(image.astype(np.int32), pixel[image, place], own[image, place], camera, poses, planes)


def _select_images(
    images: np.ndarray,
    camera: Camera,
    world_from_camera: np.ndarray,
    lidar: patches_support.PlanePoints,
    ranges: np.ndarray,
    gates: patches.PointGates,
    cell: int,
    score: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`patches.select_points` over all images, a few at a time so that the scores of few are in memory."""
    parts, size = [], (camera.height, camera.width)
    chunk = max(1, min(_CHUNK, _CHUNK_PIXELS // (size[0] * size[1])))
    # the same memory for all
    held = np.empty((min(chunk, len(images)), *size), np.float32)
    if score is not None:
        held[:] = score
    for start in range(0, len(images), chunk):
        part = slice(start, start + chunk)
        scores = held[: len(images[part])]
        if score is None:
            for row, own in zip(scores, in_order(difference_of_gaussians, images[part]), strict=True):
                row[:] = own
        poses = np.ascontiguousarray(world_from_camera[part])
        parts.append(
            patches.select_points(
                lidar, ranges[part], images[part], scores, poses, intrinsics_of(camera), cell, gates
            )
        )
    return tuple(np.concatenate(arrays) for arrays in zip(*parts, strict=True))  # type: ignore[return-value]


def make_points(
    reference: Indices,
    pixel: np.ndarray,
    plane: Indices,
    camera: Camera,
    world_from_camera: Poses,
    planes: Planes,
) -> ScenePoints:
    """The scene points where the rays of whole pixels (P, 2) int32 of images (P,) meet planes (P,).

    pixel: (P, 2) int32, (column, row)
    """
    pose = world_from_camera[reference]
    ray_camera = np.column_stack([*camera.normalized(pixel), np.ones(len(pixel))])
    ray = np.einsum("pij,pj->pi", pose[:, :3, :3], ray_camera)
    normal = planes.normal[plane]
    depth = np.einsum("pi,pi->p", normal, planes.center[plane] - pose[:, :3, 3]) / np.einsum(
        "pi,pi->p", normal, ray
    )
    position = pose[:, :3, 3] + depth[:, None] * ray
    facing = np.where(np.einsum("pi,pi->p", normal, ray) > 0, -1.0, 1.0)
    return ScenePoints(
        position_world=position,
        normal_world=normal * facing[:, None],
        sigma_plane=offset_sigma(planes, plane, position),
        unevenness=planes.unevenness[plane],
        reference=reference.astype(np.int32),
        pixel=pixel.astype(np.int32),
        plane=plane.astype(np.int32),
        is_global=np.zeros(len(reference), bool),
    )


def offset_sigma(planes: Planes, plane: Indices, position_world: Vectors) -> np.ndarray:
    """Standard deviation (P,) m of the offsets of planes (P,) at positions (P, 3): larger away from the centre.

    The plane's tilt is as uncertain as a regression over its points makes it: sigma^2 (1 + sum of a_k^2 / lambda_k),
    a_k the distance along the k-th in-plane axis.
    """
    lever = np.einsum("pij,pi->pj", planes.axes[plane], position_world - planes.center[plane])[:, 1:]
    variance = np.maximum(planes.eigenvalues[plane, 1:], 1e-12)
    return np.asarray(planes.sigma_offset[plane] * np.sqrt(1 + (lever**2 / variance).sum(axis=1)))
