"""Relative exposure times of images, from the mean brightness of the same pieces of surface in pairs of images.

The photometric cost takes contrast for brightness where a nearer view is sharper; means do not. The pieces are placed
without looking at the images (choosing by contrast would prefer what is bright, or dark, in the reference), weighted
by windows that fade out, and each view is read at the pyramid level whose pixels match the other's. What is left of the
difference in size between their pixels is made up by the windows: a mean over a larger piece of surface varies less, and
its logarithm is greater on average; the farther view would seem brighter, along a path always to the same side. Where
grey values turn out to be no power of the light, means are taken again, of the light: those of a curve of it depend on
the contrast, by more the more the curve bends where the image is.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lvba.arrays import Images, Indices, Poses, Vectors
from lvba.camera import Camera
from lvba.kernels import light_ratios, patches_mean, photometric_shared
from lvba.kernels.patches_mean import REFERENCE_MEAN, SPREAD, TARGET_MEAN
from lvba.kernels.patches_pyramid import blank_masked, halve
from lvba.lidar.plane import Surfaces
from lvba.trajectory import Trajectory
from lvba.visual import nearness, radiometry, response, same_surface, scene_points, vignetting, visibility
from lvba.visual.edge_means import edge_means, medians, pieces_of_means, shared_errors, weighted_means
from lvba.visual.exposure_graph import BLOCKS, Edges, Exposures, robust_std, solve_edges
from lvba.visual.image import DARK, SATURATED, LevelImages, Pyramid, intrinsics_of
from lvba.visual.radiometry import Radiometry, RadiometrySums
from lvba.visual.ratios import Ratios
from lvba.visual.response import LINEAR, Response
from lvba.visual.scene_points import HIDDEN_M, PatchRules, PointsConfig, ScenePoints
from lvba.visual.vignetting import PairPlaces, Vignetting
from lvba.visual.visibility import (
    DepthBuffers,
    VisibilityMap,
    choose_global,
    global_pairs,
    kernel_patches,
    local_pairs,
    view_scores,
)

LEVEL = 1
"""Pyramid level whose patches are compared, where poses are good; coarser forgives worse poses."""
PATCH = PatchRules(
    size=11, max_view_angle_deg=80.0, min_cell_px=12, min_score_sigma=0.0,
    dark=0.0, bright=float(SATURATED), min_usable=0.5, tries=4,
)  # fmt: skip
"""Patches whose means are compared."""
CELLS = 600
"""Patches per image, about, on a regular grid ..."""
FEW_CELLS = 150
"""... and where exposures are only those that poses are solved with: a tenth of a percent moves none."""
WINDOW = 5
"""Compared with this many images before and after, and through the global map with any."""
MIN_SCALE = 0.25
"""Least size of the patch in the other image, in its worse direction; the finer level is read there. Of a road, images
3 m apart share little that is seen at a half."""
MAX_SCALE = 1.25
"""Its largest size. A patch laid out in the farther view covers more surface, and more of it that is no plane: measured,
only those comparisons were biased, 0.1 % for a view 6 m nearer on a street."""
SIGMA_FLOOR = 0.01
"""Standard deviation of one patch's log ratio that no comparison beats: shine, planes not quite flat."""
INDEPENDENT = 6.0
"""A patch's differences count as this many independent ones: misalignment is alike over a patch."""
EDGE_FLOOR = 0.0005
"""Standard deviation of a pair of images' log ratio that no number of patches beats: what is common to all of them."""
FEW_PATCHES = 0.01
"""A pair of images compared by n patches has at least this over n as standard deviation: one may be wrong."""
BRIGHT = 248.0
"""Pixels near one of this grey value or more, in either image, are left out of both means, as those near one of up to
DARK are: a little less than clipped, for blur has dimmed some."""
MASK_REACH = 1
"""How near, px at the level compared: what blur carries from a clipped spot is in one view only."""
MIN_USABLE = 0.3
"""Least part of a patch's weight that must be left."""
STRETCH_M = 8.0
"""Size of the larger pieces of surface that are left out in turn: a stretch of road, a wall. Shade and gloss make patches
of one err alike, which pieces of a meter do not show: on a real street those predicted a sixth of what stretches tell."""
_RADIOMETRY_ROUNDS = 20
"""Most times that patches are weighed anew while vignetting and response are found."""
_RADIOMETRY_TOLERANCE = 1e-4
"""Change of all numbers below which they are not weighed again: a hundredth of a percent of the light."""


def solve(
    pyramid: Pyramid,
    cameras: Trajectory,
    surfaces: Surfaces,
    seen: VisibilityMap | None,
    level: int = LEVEL,
    depth: DepthBuffers | None = None,
    raw: Camera | None = None,
    points: ScenePoints | None = None,
    cells: int = CELLS,
    refined: bool = False,
) -> Exposures:
    """The relative exposures of all images at given poses.

    cells: patches per image, about, that are placed where there are no `points`; refined: as of `measure`
    Other arguments as of `ratios_at`.
    """
    camera, plain = pyramid.camera.at_level(level), _masked(pyramid, level, LINEAR)
    if points is None:
        points = place(plain[level], camera, cameras, surfaces, cells)
    if depth is None:
        depth = depth_of(pyramid, cameras, surfaces)
    poses = cameras.world_from_sensor

    def edges(curve: Response, falloff: Vignetting = vignetting.NONE) -> Edges:
        levels = _masked(pyramid, level, curve) if curve else plain
        ratios = measure(levels, level, camera, poses, points, seen, depth, raw, refined)
        return edges_of(replace(ratios, curve=curve), len(poses), Radiometry(falloff))

    summed = edges(LINEAR)
    if curve := summed.radiometry.response:
        # found from means of grey values, which contrast had changed: the light as it is now tells what is left
        falloff = summed.radiometry.vignetting
        known = edges(curve, falloff).known
        curve = curve if known is None else curve.then(radiometry.best(known).response)
        summed = edges(curve, falloff)
    return solve_edges(summed, len(poses))


def depth_of(pyramid: Pyramid, cameras: Trajectory, surfaces: Surfaces) -> DepthBuffers:
    """Depth buffers of all images of a pyramid, where no others are at hand."""
    return visibility.depth_buffers(
        pyramid.camera, cameras.world_from_sensor, cameras.times, surfaces.points, surfaces.scan_times
    )


def placed(
    pyramid: Pyramid,
    cameras: Trajectory,
    surfaces: Surfaces,
    level: int = LEVEL,
) -> ScenePoints:
    """The patches that are compared at given poses; arguments as of `ratios_at`."""
    images = completed(pyramid.levels[: level + 2], level)[level]
    images = blank_masked(images, MASK_REACH, float(DARK), BRIGHT)
    return place(images, pyramid.camera.at_level(level), cameras, surfaces)


def ratios_at(
    pyramid: Pyramid,
    cameras: Trajectory,
    surfaces: Surfaces,
    seen: VisibilityMap | None,
    level: int = LEVEL,
    depth: DepthBuffers | None = None,
    raw: Camera | None = None,
    curve: Response = LINEAR,
    points: ScenePoints | None = None,
) -> Ratios:
    """The log ratios of all patches at refined poses; `first` is the image that a patch was laid out in.

    cameras: of the images of the pyramid
    seen: the global visibility map, which ties images that are far apart in time; None: neighbours only
    level: of the pyramid, whose patches are compared; depth: of the same images; None: made here
    raw: camera of the raw images, where vignetting and response are asked for
    curve: of the response, as far as it is known: means are those of the light
    points: the patches; None: placed here
    """
    if depth is None:
        depth = depth_of(pyramid, cameras, surfaces)
    levels, camera = _masked(pyramid, level, curve), pyramid.camera.at_level(level)
    if points is None:
        points = place(levels[level], camera, cameras, surfaces)
    ratios = measure(levels, level, camera, cameras.world_from_sensor, points, seen, depth, raw, refined=True)
    return replace(ratios, curve=curve)


def _masked(pyramid: Pyramid, level: int, curve: Response) -> list[np.ndarray]:
    """Images of the finest levels, `level` and the two about it without what is dark or bright."""
    levels = list(pyramid.levels[: level + 2])
    if curve:
        full = levels[0]
        levels = [radiometry.divided(full, np.ones(full.shape[1:3], np.float32), curve)]
    levels = completed(levels, level)
    for used in range(max(level - 1, 0), level + 2):
        bright = float(curve.light(np.array(BRIGHT))) if curve else BRIGHT
        levels[used] = blank_masked(levels[used], MASK_REACH, float(DARK), bright)
    return levels


def completed(levels: Sequence[Images], level: int = LEVEL) -> list[Images]:
    """Levels of a pyramid, and those below that comparing patches of `level` needs. levels: (I, H, W, C) uint8 each"""
    made = list(levels)
    while len(made) < level + 2:
        made.append(halve(made[-1], SATURATED))
    return made


def place(
    images: Images,
    camera: Camera,
    cameras: Trajectory,
    surfaces: Surfaces,
    cells: int = CELLS,
) -> ScenePoints:
    """About so many patches on a regular grid over every image, each on one plane, whatever the image shows there."""
    config = PointsConfig(cells=cells)
    score = centrality(camera, scene_points.cell_size(camera, config, PATCH))
    return scene_points.select(LevelImages(images, camera, 0.0), cameras, surfaces, config, PATCH, score)


def centrality(camera: Camera, cell: int) -> np.ndarray:
    """(H, W) float32 score that is highest at the middle of every grid cell: what it picks depends on no image."""
    rows, columns = np.arange(camera.height) % cell, np.arange(camera.width) % cell
    off_row, off_column = rows - (cell - 1) / 2, columns - (cell - 1) / 2
    return (1 / (1 + off_row[:, None] ** 2 + off_column[None] ** 2)).astype(np.float32)


def measure(
    levels: list[np.ndarray],
    level: int,
    camera: Camera,
    world_from_camera: Poses,
    points: ScenePoints,
    seen: VisibilityMap | None,
    depth: DepthBuffers,
    raw: Camera | None = None,
    refined: bool = False,
) -> Ratios:
    """The log ratios of all patches in all images that see them; levels[level] belongs to `camera`.

    refined: poses are, so that texture says what hides most of an image
    """
    images = levels[level]
    point, target = local_pairs(points.reference, len(images), WINDOW)
    if seen is not None and len(points):
        rows = seen.rows(points.position_world)
        chosen = choose_global(points, rows, view_scores(points, camera, world_from_camera))
        far_point, far_target = global_pairs(chosen, rows, points.reference, seen)
        far = np.abs(points.reference[far_point] - far_target) > WINDOW
        point, target = np.append(point, far_point[far]), np.append(target, far_target[far])
    finer = levels[level - 1] if level else images
    means = patches_mean.measure_pairs(
        finer,
        images,
        levels[level + 1],
        np.ascontiguousarray(world_from_camera),
        intrinsics_of(camera),
        kernel_patches(points),
        point,
        target,
        PATCH.size,
        mean_gates(),
        depth.at(camera),
    )
    good = means[:, REFERENCE_MEAN] > 0
    if refined:
        place, ends = points.position_world[point[good]], (points.reference[point[good]], target[good])
        good[good] = same_surface.shown(means[good], place, *ends, len(images))
    sigma = np.sqrt(SIGMA_FLOOR**2 + means[good, SPREAD] ** 2 / INDEPENDENT)
    value = np.log(means[good, TARGET_MEAN] / means[good, REFERENCE_MEAN])
    point, target = point[good].astype(np.int32), target[good].astype(np.int32)
    places = None if raw is None else _places(raw, camera, world_from_camera, points, point, target)
    return Ratios(
        first=points.reference[point],
        second=target,
        value=value,
        sigma=sigma,
        block=surface_blocks(points.position_world)[point],
        stretch=surface_blocks(points.position_world, STRETCH_M)[point],
        places=places,
        nearer=None if raw is None else _nearer(world_from_camera, points, point, target),
        level=0.5 * np.log(means[good, TARGET_MEAN] * means[good, REFERENCE_MEAN]),
        patch=point.astype(np.int64),
    )


def _nearer(
    world_from_camera: np.ndarray, points: ScenePoints, point: np.ndarray, target: np.ndarray
) -> np.ndarray:
    """(N,): log of how many times nearer points (N,) are to targets (N,) than to their reference images."""
    position, camera = points.position_world[point], world_from_camera[:, :3, 3]
    to_reference = np.linalg.norm(position - camera[points.reference[point]], axis=1)
    return nearness.log_nearer(to_reference, np.linalg.norm(position - camera[target], axis=1))


def _places(
    raw: Camera,
    camera: Camera,
    world_from_camera: np.ndarray,
    points: ScenePoints,
    point: np.ndarray,
    target: np.ndarray,
) -> PairPlaces:
    """Where points (N,) are in their reference images and in targets (N,)."""
    pixels = points.pixel.astype(float)
    landed, _, _ = photometric_shared.centers(
        point,
        target,
        np.ascontiguousarray(world_from_camera),
        intrinsics_of(camera),
        kernel_patches(points)._replace(pixel=pixels),
    )
    reference = vignetting.places(raw, camera, pixels)
    return PairPlaces(reference[point], vignetting.places(raw, camera, landed))


def mean_gates() -> patches_mean.MeanGates:
    """What a pair must pass to be compared; what is dark or bright is already blank (`ratios_at`)."""
    return patches_mean.MeanGates(
        min_view_cosine=0.1,
        min_normal_cosine=float(np.cos(np.radians(PATCH.max_view_angle_deg))),
        min_scale=MIN_SCALE,
        max_scale=MAX_SCALE,
        dark=0.0,
        bright=256.0,
        min_usable=MIN_USABLE,
        hiding=HIDDEN_M,
    )


def surface_blocks(position_world: Vectors, size: float = 1.0) -> np.ndarray:
    """Which of BLOCKS sets of voxels of `size` m each point (P, 3) falls in, (P,) int64; neighbours differ."""
    voxel = np.floor(position_world / size).astype(np.int64)
    return np.asarray((voxel @ np.array([1, 3, 5])) % BLOCKS)


def solve_ratios(ratios: Ratios, images: int) -> Exposures:
    """The exposures that explain the log ratios best: robust per pair of images, then robust over the graph."""
    return solve_edges(edges_of(ratios, images), images)


def edges_of(ratios: Ratios, images: int, start: Radiometry = radiometry.NONE) -> Edges:
    """The ratios summed up robustly per pair of images. start: a guess of what the radiometry is"""
    low, high = np.minimum(ratios.first, ratios.second), np.maximum(ratios.first, ratios.second)
    sign = np.where(ratios.first == low, 1.0, -1.0)
    value = sign * ratios.value
    codes, edge = np.unique(low.astype(np.int64) * images + high, return_inverse=True)
    light, known, by_numbers = radiometry.NONE, None, np.zeros((len(value), radiometry.NUMBERS))
    if ratios.places is not None:
        known = radiometry_sums(edge, sign, ratios, start)
        light = radiometry.solve(known, response.TAKEN_OUT if ratios.curve else None)
        value = sign * ratios.of_surfaces(light)
        expected = sign * edge_means(edge, value, ratios.sigma, len(codes))[0][edge]
        by_numbers = sign[:, None] * ratios.by_numbers(light, expected + ratios.of_views(light))
    mean, sigma, weight = edge_means(edge, value, ratios.sigma, len(codes))
    sharing, correlation = shared_errors(edge, ratios.patch, sign * weight * ratios.sigma)
    count = np.bincount(edge, minlength=len(codes))
    sigma = np.sqrt(sigma**2 + EDGE_FLOOR**2 + (FEW_PATCHES / np.maximum(count, 1)) ** 2)
    pieces = [pieces_of_means(edge, value, weight, each, mean) for each in (ratios.block, ratios.stretch)]
    return Edges(
        first=codes // images,
        second=codes % images,
        mean=mean,
        sigma=sigma,
        weight_fraction=np.concatenate([fraction for fraction, _ in pieces], axis=1),
        pull=np.concatenate([pull for _, pull in pieces], axis=1),
        sharing=sharing,
        correlation=correlation,
        pairs=len(value),
        spread=robust_std(value - mean[edge]),
        radiometry=light,
        by_radiometry=weighted_means(edge, weight, by_numbers, len(codes)),
        known=known,
        curve=ratios.curve,
    )


def radiometry_sums(
    edge: Indices, sign: np.ndarray, ratios: Ratios, start: Radiometry = radiometry.NONE
) -> RadiometrySums:
    """What the log ratios tell of vignetting and response, the level of each edge left open; robust as `edge_means`.

    edge: (N,) of each ratio; sign: (N,) float64, 1 or -1, of the ratio in its edge; start: a guess of the radiometry
    """
    assert ratios.places is not None
    edges, count = int(edge.max(initial=-1)) + 1, len(ratios.value)
    present, mean, weight = start, medians(edge, sign * ratios.value, edges), ratios.sigma**-2
    known = radiometry.sums(
        edge, ratios.block, ratios.value, weight, np.zeros((count, radiometry.NUMBERS)), BLOCKS
    )
    seen = ratios.arrays(sign)
    for _ in range(_RADIOMETRY_ROUNDS if count else 0):
        by_numbers, left, rest = light_ratios.linearize(
            seen, mean[edge], present.numbers, response.KNOTS, response.STEEPEST
        )
        residual = (rest - mean[edge]) / ratios.sigma
        scale = max(robust_std(residual), 1e-3)
        weight = 1 / (ratios.sigma**2 * (1 + (residual / (2 * scale)) ** 2))
        known = radiometry.sums(edge, ratios.block, left, weight, by_numbers, BLOCKS)
        before, present = present, radiometry.best(known)
        rest = left - np.einsum("nk,k->n", by_numbers, present.numbers)
        mean = np.bincount(edge, weight * rest, edges) / np.bincount(edge, weight, edges)
        if np.abs(present.numbers - before.numbers).max() < _RADIOMETRY_TOLERANCE:
            break
    return known
