"""Scene points and who sees them: the data between point selection, visibility and the photometric solve."""

from dataclasses import dataclass

import cv2
import numpy as np

from lvba.camera import Camera
from lvba.kernels import patches
from lvba.lidar.plane import PlanePoints, Planes
from lvba.parallel import in_order

DOG_NOISE = 0.146
"""Standard deviation of the difference of Gaussians (sigma 1.0 and 1.6) of white noise of standard deviation 1."""
_CHUNK = 16


@dataclass(frozen=True)
class ScenePoints:
    """P small planar patches, each tied to a whole pixel of its reference image at one pyramid level.

    position_world: (P, 3) float64, m: where the ray of `pixel` met the plane when the point was made
    normal_world: (P, 3) float64, unit, turned towards the reference camera
    sigma_plane: (P,) float64, m: standard deviation of the plane's offset at the point
    reference: (P,) int32, image index (into the arrays of keyframes handed to the solve)
    pixel: (P, 2) int32, (column, row) at this level
    plane: (P,) int32, index of the LiDAR plane
    is_global: (P,) bool
    """

    position_world: np.ndarray
    normal_world: np.ndarray
    sigma_plane: np.ndarray
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
    """

    point: np.ndarray
    target: np.ndarray
    is_global: np.ndarray

    def __len__(self) -> int:
        return len(self.point)


def take(points: ScenePoints, index: np.ndarray) -> ScenePoints:
    """The scene points at `index` (integers or booleans)."""
    return ScenePoints(*(getattr(points, name)[index] for name in ScenePoints.__dataclass_fields__))


@dataclass(frozen=True)
class PointsConfig:
    """Which LiDAR points become scene points of an image."""

    patch_size: int = 9
    """N of the N x N patch, px, odd, 3 to 31."""
    cells: int = 600
    """Grid cells per image, about (40 px on a 1 Mpx image); at most one point each; 1 to 100000."""
    min_cell_px: int = 8
    """Smallest edge of a grid cell, px (coarse levels get fewer points, or patches overlap); 4 to 200."""
    time_window_s: float = 0.5
    """Scans within this time of the image are projected, seconds; doubled up to three times where points are few."""
    min_points_in_image: int = 1000
    """Fewer LiDAR points than this in an image widen its time window; 0 or more."""
    max_points: int = 1_000_000
    """At most about this many LiDAR points are tried per image (a regular subset where there are more)."""
    max_view_angle_deg: float = 82.0
    """Largest angle between view direction and plane normal, degrees, eq. (2); 0 to 89."""
    min_score_sigma: float = 3.0
    """Least |difference of Gaussians|, in standard deviations of its noise; 0 or more."""
    off_plane_part: float = 0.1
    """Largest part of the LiDAR points within twice the patch that may lie off its plane; 0 to 1."""
    off_plane_sigma: float = 4.0
    """A point is off a plane when further than this many times the plane's thickness (within the bounds below)."""
    off_plane_min_m: float = 0.03
    """Never stricter than this, m (nor than 0.4 % of the distance)."""
    off_plane_max_m: float = 0.08
    """Never looser than this, m."""
    min_support: int = 4
    """Least number of LiDAR points on the plane within twice the patch; 1 or more."""
    extent_spacings: float = 3.0
    """The support must reach the patch's four sides, looked for within this many mean spacings of LiDAR points."""
    min_depth_m: float = 0.3
    """Least distance of a scene point along the camera's axis, m."""
    occlusion_m: float = 0.15
    """A point this much (and 2 %) behind another is hidden by it, m."""
    occlusion_spacings: float = 1.5
    """Cells of the z-buffer in mean spacings of LiDAR points (up to the patch size); 0 to 10."""
    dark: float = 3.0
    """Grey values up to this are masked (0: no image); 0 to 50."""
    bright: float = 250.0
    """Grey values from this on are masked (clipped); 100 to 256."""
    min_usable: float = 0.9
    """Least part of the patch that is not masked; 0 to 1."""
    tries: int = 12
    """Candidates tried per cell, best score first; 1 or more."""

    def __post_init__(self) -> None:
        if self.patch_size % 2 == 0 or not 3 <= self.patch_size <= 31:
            raise ValueError(f"patch_size = {self.patch_size}: must be odd, 3 to 31")
        ranges = {
            "cells": (1, 100_000), "min_cell_px": (4, 200), "time_window_s": (0, 1e4), "min_points_in_image": (0, 1e9),
            "max_points": (100, 1e10), "max_view_angle_deg": (0, 89), "min_score_sigma": (0, 1e3),
            "off_plane_part": (0, 1), "off_plane_sigma": (0, 1e3), "off_plane_min_m": (0, self.off_plane_max_m),
            "min_support": (1, 1e6), "extent_spacings": (0, 100), "min_depth_m": (0, 1e3), "occlusion_m": (0, 100),
            "occlusion_spacings": (0, 10),
            "dark": (0, 50), "bright": (100, 256), "min_usable": (0, 1), "tries": (1, 1e6),
        }  # fmt: skip
        for name, (low, high) in ranges.items():
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{name} = {getattr(self, name)}: must lie in {low} to {high}")


def cell_size(camera: Camera, config: PointsConfig) -> int:
    """Edge of a grid cell at this camera's size, px."""
    return max(round((camera.width * camera.height / config.cells) ** 0.5), config.min_cell_px)


def difference_of_gaussians(image: np.ndarray) -> np.ndarray:
    """|G(1.0) - G(1.6)| of the mean channel of an (H, W, C) image, (H, W) float32."""
    plain = image[..., 0].astype(np.float32) if image.shape[2] == 1 else image.mean(axis=2, dtype=np.float32)
    fine = cv2.GaussianBlur(plain, (7, 7), 1.0)
    coarse = cv2.GaussianBlur(plain, (11, 11), 1.6)
    return np.asarray(cv2.absdiff(fine, coarse))


def near_ranges(
    image_times: np.ndarray, scan_times: np.ndarray, scan_offsets: np.ndarray, window: np.ndarray, most: int
) -> np.ndarray:
    """(I, 3) int64: first point, end and step of the points of the scans within `window` (I,) s; the nearest at least."""
    nearest = np.abs(scan_times[None] - image_times[:, None]).argmin(axis=1)
    first = np.minimum(np.searchsorted(scan_times, image_times - window), nearest)
    last = np.maximum(np.searchsorted(scan_times, image_times + window, side="right"), nearest + 1)
    start, stop = scan_offsets[first], scan_offsets[last]
    return np.stack([start, stop, np.maximum(-(-(stop - start) // most), 1)], axis=1).astype(np.int64)


def plane_table(planes: Planes, config: PointsConfig) -> np.ndarray:
    """(K, 7) float64 for the kernels: centre, unit normal, distance in m from which a point lies off the plane."""
    thickness = np.sqrt(np.maximum(planes.eigenvalues[:, 0], 0))
    tolerance = np.clip(config.off_plane_sigma * thickness, config.off_plane_min_m, config.off_plane_max_m)
    return np.column_stack([planes.center, planes.normal, tolerance])


def _gates(camera: Camera, config: PointsConfig, noise: float) -> np.ndarray:
    half = config.patch_size // 2
    cosine = np.cos(np.radians(config.max_view_angle_deg))
    least_score = max(config.min_score_sigma * DOG_NOISE * noise, 1e-6)
    return np.array([
        half, cosine, config.dark, config.bright, config.min_usable, config.off_plane_part, config.min_support,
        config.min_depth_m, half + 0.5, config.extent_spacings, max(camera.width / 160, 1.0),
        config.occlusion_spacings, config.occlusion_m, least_score, config.tries,
    ])  # fmt: skip


def select(
    images: np.ndarray,
    camera: Camera,
    world_from_camera: np.ndarray,
    image_times: np.ndarray,
    planes: Planes,
    plane_points: PlanePoints,
    scan_times: np.ndarray,
    noise: float,
    config: PointsConfig = PointsConfig(),
    score: np.ndarray | None = None,
) -> ScenePoints:
    """The local scene points of every image at one pyramid level, by image and grid cell (row by row).

    images: (I, H, W, C) uint8 or float32, undistorted; camera: of this level
    world_from_camera: (I, 4, 4); image_times: (I,) s
    scan_times: (S,) s, ascending, of the scans in `plane_points`
    noise: standard deviation of the images' noise at this level, grey values
    score: (H, W) float32, to choose by in every image instead of the difference of Gaussians

    Source: Li et al., II-C1 and eq. (2). Ours: the point is where the ray of the whole pixel meets the plane, points
    hidden by others are left out, and the LiDAR points round the patch must lie on its plane and reach its four sides.
    """
    table, gates = plane_table(planes, config), _gates(camera, config, noise)
    window = np.full(len(images), config.time_window_s)
    pixel, own, seen = _select_images(
        images,
        camera,
        world_from_camera,
        image_times,
        table,
        plane_points,
        scan_times,
        window,
        gates,
        config,
        score,
    )
    for _ in range(3):
        few = np.flatnonzero(seen < config.min_points_in_image)
        if len(few) == 0 or len(scan_times) == 1:
            break
        window[few] *= 2
        pixel[few], own[few], seen[few] = _select_images(
            images[few], camera, world_from_camera[few], image_times[few], table, plane_points, scan_times,
            window[few], gates, config, score,
        )  # fmt: skip
    image, cell = np.nonzero(own >= 0)
    return make_points(
        image.astype(np.int32), pixel[image, cell], own[image, cell], camera, world_from_camera, planes
    )


def _select_images(
    images: np.ndarray,
    camera: Camera,
    world_from_camera: np.ndarray,
    image_times: np.ndarray,
    table: np.ndarray,
    plane_points: PlanePoints,
    scan_times: np.ndarray,
    window: np.ndarray,
    gates: np.ndarray,
    config: PointsConfig,
    score: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`patches.select_points` over all images, a few at a time so that the scores of few are in memory."""
    ranges = near_ranges(image_times, scan_times, plane_points.scan_offsets, window, config.max_points)
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    parts = []
    for start in range(0, len(images), _CHUNK):
        part = slice(start, start + _CHUNK)
        if score is None:
            scores = np.stack(list(in_order(difference_of_gaussians, images[part])))
        else:
            scores = np.broadcast_to(score, (len(images[part]), *score.shape))
        poses = np.ascontiguousarray(world_from_camera[part])
        parts.append(
            patches.select_points(
                plane_points.points_world,
                plane_points.plane,
                table,
                ranges[part],
                images[part],
                scores,
                poses,
                intrinsics,
                cell_size(camera, config),
                gates,
            )
        )
    return tuple(np.concatenate(arrays) for arrays in zip(*parts, strict=True))  # type: ignore[return-value]


def make_points(
    reference: np.ndarray,
    pixel: np.ndarray,
    plane: np.ndarray,
    camera: Camera,
    world_from_camera: np.ndarray,
    planes: Planes,
) -> ScenePoints:
    """The scene points where the rays of whole pixels (P, 2) int32 of images (P,) meet planes (P,)."""
    pose = world_from_camera[reference]
    ray_camera = np.column_stack([
        (pixel[:, 0] - camera.cx) / camera.fx, (pixel[:, 1] - camera.cy) / camera.fy, np.ones(len(pixel))
    ])  # fmt: skip
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
        reference=reference.astype(np.int32),
        pixel=pixel.astype(np.int32),
        plane=plane.astype(np.int32),
        is_global=np.zeros(len(reference), bool),
    )


def offset_sigma(planes: Planes, plane: np.ndarray, position_world: np.ndarray) -> np.ndarray:
    """Standard deviation (P,) m of the offsets of planes (P,) at positions (P, 3): larger away from the centre.

    The plane's tilt is as uncertain as a regression over its points makes it: sigma^2 (1 + sum of a_k^2 / lambda_k),
    a_k the distance along the k-th in-plane axis.
    """
    lever = np.einsum("pij,pi->pj", planes.axes[plane], position_world - planes.center[plane])[:, 1:]
    variance = np.maximum(planes.eigenvalues[plane, 1:], 1e-12)
    return np.asarray(planes.sigma_offset[plane] * np.sqrt(1 + (lever**2 / variance).sum(axis=1)))
