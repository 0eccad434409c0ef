"""Relative exposure times of images, from the mean brightness of the same pieces of surface in pairs of images.

The photometric cost takes contrast for brightness where a nearer view is sharper; means do not. The pieces are placed
without looking at the images (choosing by contrast would prefer what is bright, or dark, in the reference), weighted
by a window that fades out, and each view is read at the pyramid level whose pixels match the other's.
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import SuperLU, splu

from lvba.camera import Camera
from lvba.kernels import patches_mean
from lvba.kernels.patches_pyramid import blank_masked, halve
from lvba.lidar.plane import PlanePoints, Planes
from lvba.visual import scene_points, visibility
from lvba.visual.image import SATURATED, Pyramid
from lvba.visual.scene_points import PointsConfig, ScenePoints
from lvba.visual.visibility import (
    DepthBuffers,
    VisibilityMap,
    choose_global,
    global_pairs,
    local_pairs,
    view_scores,
)

BLOCKS = 8
"""Parts of the surface that the jackknife leaves out in turn."""


@dataclass(frozen=True)
class ExposureConfig:
    """How relative exposures are found."""

    level: int = 1
    """Pyramid level whose patches are compared, 0 to 5; coarser forgives worse poses."""
    patch_size: int = 11
    """Edge of a patch, px, odd, 5 to 63; weighted by a Gaussian whose sigma is a fifth of it."""
    cells: int = 300
    """Patches per image, about, on a regular grid; 10 to 10000."""
    window: int = 5
    """Compared with this many images before and after, and through the global map with any; 1 to 1000."""
    max_view_angle_deg: float = 80.0
    """Largest angle between view direction and normal, degrees; 0 to 89."""
    min_scale: float = 0.5
    """Least size of the patch in the other image, in its worse direction; 0 to 1."""
    max_scale: float = 1.25
    """Its largest size; 1 or more. A patch laid out in the farther view covers more surface, and more of it that is no
    plane: measured, only those comparisons were biased, 0.1 % for a view 6 m nearer on a street."""
    sigma_floor: float = 0.01
    """Standard deviation of one patch's log ratio that no comparison beats (shine, planes not quite flat); above 0."""
    independent: float = 6.0
    """A patch's differences count as this many independent ones (misalignment is alike over a patch); 1 or more."""
    edge_floor: float = 0.0005
    """Standard deviation of a pair of images' log ratio that no number of patches beats; above 0."""
    few_patches: float = 0.01
    """A pair of images compared by n patches has at least this over n as standard deviation (one may be wrong)."""
    dark: float = 4.0
    """Pixels near one of up to this grey value, in either image, are left out of both means; 0 to 50."""
    bright: float = 248.0
    """And so are pixels near one of this grey value or more; 100 to 250."""
    mask_reach: int = 1
    """How near, px at the level compared: what blur carries from a clipped spot is in one view only; 0 to 20."""
    hidden_m: float = 0.15
    """An image with LiDAR points this much (and 2 % of the depth) in front of a patch does not see it, m."""
    min_usable: float = 0.3
    """Least part of a patch's weight that must be left; 0 to 1."""

    def __post_init__(self) -> None:
        if self.patch_size % 2 == 0:
            raise ValueError(f"patch_size = {self.patch_size}: must be odd")
        ranges = {
            "level": (0, 5), "patch_size": (5, 63), "cells": (10, 10_000), "window": (1, 1000),
            "max_view_angle_deg": (0, 89), "min_scale": (0, 1), "max_scale": (1, 1e3), "sigma_floor": (1e-9, 10),
            "independent": (1, 1e4), "edge_floor": (1e-9, 10),
            "few_patches": (0, 10), "dark": (0, 50), "bright": (100, 250),
            "min_usable": (0, 1), "mask_reach": (0, 20), "hidden_m": (0, 1e3),
        }  # fmt: skip
        for name, (low, high) in ranges.items():
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{name} = {getattr(self, name)}: must lie in {low} to {high}")


@dataclass(frozen=True)
class Exposures:
    """Relative exposures of I images.

    log_exposure: (I,) float64, natural log; the first image of the whole is 0. Where the images fall in several
        components, each further one starts where the image before its first one ended: a guess, nothing measures it
    sigma: (I,) float64: standard deviation about the component's mean; inf for an image that nothing compares
    component: (I,) int32, connected component of the graph of compared images, by first image
    pairs: number of patch comparisons used
    spread: robust standard deviation of the log ratios of patches about the solution
    """

    log_exposure: np.ndarray
    sigma: np.ndarray
    component: np.ndarray
    pairs: int
    spread: float


@dataclass(frozen=True)
class Ratios:
    """Log ratios of brightness, one per comparison of a patch: log(mean in `second` / mean in `first`).

    first, second: (N,) int32, images; value, sigma: (N,) float64
    block: (N,) int64, 0 to BLOCKS - 1: which part of the surface the patch lies on
    """

    first: np.ndarray
    second: np.ndarray
    value: np.ndarray
    sigma: np.ndarray
    block: np.ndarray


def solve(
    pyramid: Pyramid,
    world_from_camera: np.ndarray,
    image_times: np.ndarray,
    planes: Planes,
    plane_points: PlanePoints,
    scan_times: np.ndarray,
    seen: VisibilityMap | None,
    config: ExposureConfig = ExposureConfig(),
    depth: DepthBuffers | None = None,
) -> Exposures:
    """The relative exposures of all images at given poses; arguments as of `ratios_at`."""
    ratios = ratios_at(
        pyramid, world_from_camera, image_times, planes, plane_points, scan_times, seen, config, depth
    )
    return solve_ratios(ratios, len(world_from_camera), config)


def ratios_at(
    pyramid: Pyramid,
    world_from_camera: np.ndarray,
    image_times: np.ndarray,
    planes: Planes,
    plane_points: PlanePoints,
    scan_times: np.ndarray,
    seen: VisibilityMap | None,
    config: ExposureConfig = ExposureConfig(),
    depth: DepthBuffers | None = None,
) -> Ratios:
    """The log ratios of all patches at given poses; `first` is the image that a patch was laid out in.

    world_from_camera: (I, 4, 4); image_times: (I,) s; scan_times: (S,) s of the scans in `plane_points`
    seen: the global visibility map, which ties images that are far apart in time; None: neighbours only
    depth: of the same images; None: made here
    """
    if depth is None:
        depth = visibility.depth_buffers(
            pyramid.camera, world_from_camera, image_times, plane_points, scan_times
        )
    levels = list(pyramid.levels[: config.level + 2])
    while len(levels) < config.level + 2:
        levels.append(halve(levels[-1], SATURATED))
    camera = pyramid.camera.at_level(config.level)
    used = range(max(config.level - 1, 0), config.level + 2)
    for level in used:
        levels[level] = blank_masked(levels[level], config.mask_reach, config.dark, config.bright)
    points = place(
        levels[config.level], camera, world_from_camera, image_times, planes, plane_points, scan_times, config
    )
    return measure(levels, camera, world_from_camera, points, seen, depth, config)


def place(
    images: np.ndarray,
    camera: Camera,
    world_from_camera: np.ndarray,
    image_times: np.ndarray,
    planes: Planes,
    plane_points: PlanePoints,
    scan_times: np.ndarray,
    config: ExposureConfig,
) -> ScenePoints:
    """Patches on a regular grid over every image, each on one plane, whatever the image shows there."""
    points_config = PointsConfig(
        patch_size=min(config.patch_size, 31), cells=config.cells,
        min_cell_px=config.patch_size + 1, max_view_angle_deg=config.max_view_angle_deg,
        dark=0.0, bright=float(SATURATED), min_usable=0.5, min_score_sigma=0.0, tries=4,
    )  # fmt: skip
    return scene_points.select(
        images, camera, world_from_camera, image_times, planes, plane_points, scan_times, 0.0, points_config,
        score=centrality(camera, scene_points.cell_size(camera, points_config)),
    )  # fmt: skip


def centrality(camera: Camera, cell: int) -> np.ndarray:
    """(H, W) float32 score that is highest at the middle of every grid cell: what it picks depends on no image."""
    rows, columns = np.arange(camera.height) % cell, np.arange(camera.width) % cell
    off_row, off_column = rows - (cell - 1) / 2, columns - (cell - 1) / 2
    return (1 / (1 + off_row[:, None] ** 2 + off_column[None] ** 2)).astype(np.float32)


def window_weights(size: int) -> np.ndarray:
    """(N, N) Gaussian weights with sum 1 that have faded out at the patch's border."""
    x = np.arange(size) - size // 2
    profile = np.exp(-0.5 * (x / (size / 5)) ** 2)
    weights = np.outer(profile, profile)
    return np.asarray(weights / weights.sum())


def measure(
    levels: list[np.ndarray],
    camera: Camera,
    world_from_camera: np.ndarray,
    points: ScenePoints,
    seen: VisibilityMap | None,
    depth: DepthBuffers,
    config: ExposureConfig,
) -> Ratios:
    """The log ratios of all patches in all images that see them; levels[config.level] belongs to `camera`."""
    images = levels[config.level]
    point, target = local_pairs(points.reference, len(images), config.window)
    if seen is not None and len(points):
        rows = seen.rows(points.position_world)
        chosen = choose_global(points, rows, view_scores(points, camera, world_from_camera))
        far_point, far_target = global_pairs(chosen, rows, points.reference, seen)
        far = np.abs(points.reference[far_point] - far_target) > config.window
        point, target = np.append(point, far_point[far]), np.append(target, far_target[far])
    gates = np.array([
        0.1, np.cos(np.radians(config.max_view_angle_deg)), config.min_scale, config.max_scale, 0.0,
        256.0, config.min_usable, config.hidden_m,
    ])  # fmt: skip
    finer = levels[config.level - 1] if config.level else images
    found = patches_mean.measure_pairs(
        finer, images, levels[config.level + 1], np.ascontiguousarray(world_from_camera),
        np.array([camera.fx, camera.fy, camera.cx, camera.cy]), points.position_world, points.normal_world,
        points.reference, points.pixel, point, target, window_weights(config.patch_size), gates,
        depth.nearest, depth.points_world, depth.cell * camera.fx,
    )  # fmt: skip
    good = found[:, 0] > 0
    sigma = np.sqrt(config.sigma_floor**2 + found[good, 2] ** 2 / config.independent)
    value = np.log(found[good, 1] / found[good, 0])
    block = surface_blocks(points.position_world)[point[good]]
    return Ratios(points.reference[point[good]], target[good].astype(np.int32), value, sigma, block)


def surface_blocks(position_world: np.ndarray, size: float = 1.0) -> np.ndarray:
    """Which of BLOCKS sets of voxels of `size` m each point (P, 3) falls in, (P,) int64; neighbours differ."""
    voxel = np.floor(position_world / size).astype(np.int64)
    return np.asarray((voxel @ np.array([1, 3, 5])) % BLOCKS)


@dataclass(frozen=True)
class Edges:
    """What all patches together say about each pair of images; two parts of the patches may each have an edge of a pair.

    first, second: (E,) int64, images; mean, sigma: (E,) of log(brightness in `second` / in `first`)
    changes: (E, BLOCKS) of the mean when one block of the surface is left out
    pairs: number of patch comparisons; spread: their robust standard deviation about the edges' means
    """

    first: np.ndarray
    second: np.ndarray
    mean: np.ndarray
    sigma: np.ndarray
    changes: np.ndarray
    pairs: int
    spread: float


def solve_ratios(ratios: Ratios, images: int, config: ExposureConfig = ExposureConfig()) -> Exposures:
    """The exposures that explain the log ratios best: robust per pair of images, then robust over the graph."""
    return solve_edges(edges_of(ratios, images, config), images)


def edges_of(ratios: Ratios, images: int, config: ExposureConfig = ExposureConfig()) -> Edges:
    """The ratios summed up robustly per pair of images."""
    low, high = np.minimum(ratios.first, ratios.second), np.maximum(ratios.first, ratios.second)
    value = np.where(ratios.first == low, ratios.value, -ratios.value)
    codes, edge = np.unique(low.astype(np.int64) * images + high, return_inverse=True)
    mean, sigma, weight = edge_means(edge, value, ratios.sigma, len(codes))
    count = np.bincount(edge, minlength=len(codes))
    sigma = np.sqrt(sigma**2 + config.edge_floor**2 + (config.few_patches / np.maximum(count, 1)) ** 2)
    left_out = leave_out_blocks(edge, value, weight, ratios.block, mean)
    return Edges(
        codes // images,
        codes % images,
        mean,
        sigma,
        left_out - mean[:, None],
        len(value),
        _robust_std(value - mean[edge]),
    )


def solve_edges(edges: Edges, images: int) -> Exposures:
    """The exposures of all images that explain the edges best."""
    links = sparse.coo_matrix((np.ones(len(edges.mean)), (edges.first, edges.second)), shape=(images, images))
    component = _by_first_image(connected_components(links, directed=False)[1])
    graph = _Graph(edges.first, edges.second, component)
    log_exposure, edge_weight = graph.solve_robustly(edges.mean, edges.sigma)
    return Exposures(
        log_exposure=_joined(log_exposure, component),
        sigma=graph.sigma(edge_weight, edges.changes),
        component=component,
        pairs=edges.pairs,
        spread=edges.spread,
    )


def edge_means(
    edge: np.ndarray, value: np.ndarray, sigma: np.ndarray, edges: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Robust mean (E,) of the values of every edge, its standard deviation (E,), and the weights (N,) used.

    edge (N,): which edge a value (N,) with standard deviation (N,) belongs to. Cauchy weights, scaled by the median of
    all normalized residuals, from the median as start.
    """
    mean = _medians(edge, value, edges)
    many = np.bincount(edge, minlength=edges)[edge] >= 4  # of few values the residuals say nothing
    for _ in range(10):
        residual = (value - mean[edge]) / sigma
        scale = max(_robust_std(residual[many]), 1e-3) if many.any() else 1.0
        weight = 1 / (sigma**2 * (1 + (residual / (2 * scale)) ** 2))
        total = np.bincount(edge, weight, edges)
        mean = np.bincount(edge, weight * value, edges) / total
    return mean, scale / np.sqrt(total), weight


def leave_out_blocks(
    edge: np.ndarray, value: np.ndarray, weight: np.ndarray, block: np.ndarray, mean: np.ndarray
) -> np.ndarray:
    """The edges' weighted means (E, BLOCKS) without the values of one block of the surface each."""
    cell, shape = edge * BLOCKS + block, (len(mean), BLOCKS)
    weights = np.bincount(cell, weight, shape[0] * BLOCKS).reshape(shape)
    sums = np.bincount(cell, weight * value, shape[0] * BLOCKS).reshape(shape)
    rest = weights.sum(axis=1, keepdims=True) - weights
    enough = rest > 1e-9 * weights.sum(axis=1, keepdims=True)
    without = (sums.sum(axis=1, keepdims=True) - sums) / np.where(enough, rest, 1.0)
    return np.where(enough, without, mean[:, None])


def _medians(group: np.ndarray, value: np.ndarray, groups: int) -> np.ndarray:
    order = np.lexsort((value, group))
    count = np.bincount(group, minlength=groups)
    start = np.cumsum(count) - count
    ordered = np.append(value[order], 0.0)
    low, high = start + np.maximum(count - 1, 0) // 2, start + count // 2
    return np.asarray((ordered[low] + ordered[np.minimum(high, len(value))]) / 2)


def _robust_std(values: np.ndarray) -> float:
    return float(1.4826 * np.median(np.abs(values))) if len(values) else 0.0


def _by_first_image(label: np.ndarray) -> np.ndarray:
    """Component numbers in the order of their first images."""
    _, first, inverse = np.unique(label, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[inverse].astype(np.int32)


_COLUMNS = 64
"""Columns of an inverse that are in memory at a time."""


@dataclass(frozen=True)
class _Factor:
    """The normal equations of edges between images, of which those in `free` may have any value and the others have 0.

    component: (I,); free: (F,); weighted: (E, F), the edges' signs times their weights
    """

    component: np.ndarray
    free: np.ndarray
    weighted: sparse.csr_matrix
    solver: SuperLU | None

    def values(self, differences: np.ndarray) -> np.ndarray:
        """Values of the images (I, K) that fit differences along the edges (E, K) best."""
        values = np.zeros((len(self.component), *differences.shape[1:]))
        if self.solver is not None:
            values[self.free] = self.solver.solve(np.asarray(self.weighted.T @ differences))
        return values

    def variances(self) -> np.ndarray:
        """Variance (I,) of each image's value about the mean of its component, were the edges' errors independent."""
        own, with_all = np.zeros(len(self.component)), np.zeros(len(self.component))
        if self.solver is not None:
            free = len(self.free)
            with_all[self.free] = self.solver.solve(np.ones(free))
            for begin in range(0, free, _COLUMNS):
                here = np.arange(begin, min(begin + _COLUMNS, free))
                unit = np.zeros((free, len(here)))
                unit[here, here - begin] = 1.0
                own[self.free[here]] = self.solver.solve(unit)[here, here - begin]
        count = np.bincount(self.component)
        total = np.bincount(self.component, with_all) / count**2
        return own - 2.0 * with_all / count[self.component] + total[self.component]


@dataclass(frozen=True)
class _Graph:
    """Images joined by edges; the first image of every component stays at 0."""

    first: np.ndarray
    second: np.ndarray
    component: np.ndarray

    def factor(self, weight: np.ndarray) -> "_Factor":
        """The edges' normal equations, factorized."""
        images = len(self.component)
        free = np.setdiff1d(np.arange(images), np.unique(self.component, return_index=True)[1])
        rows = np.tile(np.arange(len(self.first)), 2)
        signs = np.repeat([-1.0, 1.0], len(self.first))
        incidence = sparse.csr_matrix(
            (signs, (rows, np.concatenate([self.first, self.second]))), shape=(len(self.first), images)
        )[:, free]
        weighted = incidence.multiply(weight[:, None]).tocsr()
        solver = splu((incidence.T @ weighted).tocsc()) if len(free) else None
        return _Factor(self.component, free, weighted, solver)

    def solve_robustly(self, value: np.ndarray, sigma: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The images' values (I,) that fit the edges' (E,) with standard deviations (E,), and the edges' weights."""
        weight = 1 / sigma**2
        for _ in range(10):
            solution = self.factor(weight).values(value)
            residual = (value - solution[self.second] + solution[self.first]) / sigma
            scale = max(_robust_std(residual), 1e-3)
            weight = 1 / (sigma**2 * (1 + (residual / (2 * scale)) ** 2))
        return solution, weight

    def sigma(self, weight: np.ndarray, changes: np.ndarray) -> np.ndarray:
        """Standard deviation (I,) of each image's value about the mean of its component; inf where it is alone.

        changes: (E, BLOCKS) of the edges' values when one block of the surface is left out. Edges that share patches
        err together, so the covariance of independent edges is too small; by how much is what the jackknife tells.
        """
        factor = self.factor(weight)
        independent = factor.variances()
        jackknife = (BLOCKS - 1) / BLOCKS * (self._centered(factor.values(changes)) ** 2).sum(axis=1)
        joined = np.bincount(self.component)[self.component] > 1
        if not joined.any():
            return np.full(len(self.component), np.inf)
        excess = jackknife[joined].mean() / independent[joined].mean()
        return np.where(joined, np.sqrt(independent * max(excess, 1.0)), np.inf)

    def _centered(self, values: np.ndarray) -> np.ndarray:
        """Values (I, K) less the mean of their component."""
        count = np.bincount(self.component)
        members = sparse.csr_matrix((np.ones(len(values)), (self.component, np.arange(len(values)))))
        return np.asarray(values - ((members @ values) / count[:, None])[self.component])


def _joined(log_exposure: np.ndarray, component: np.ndarray) -> np.ndarray:
    """Every further component shifted so that it goes on from the image before its first one."""
    joined = log_exposure.copy()
    for label in range(1, component.max(initial=-1) + 1):
        members = np.flatnonzero(component == label)
        joined[members] += joined[members[0] - 1]
    return joined
