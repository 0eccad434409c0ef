"""Who sees a scene point: neighbours in time, and through the global visibility voxel map cameras anywhere."""

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from lvba.arrays import Indices, Poses, Times, Vectors
from lvba.camera import Camera
from lvba.kernels import visibility as kernels
from lvba.kernels.scene import NearestPoints, PlanePatches
from lvba.kernels.visibility_depth import nearest_points
from lvba.lidar.plane import PlanePoints
from lvba.settings import Group, setting
from lvba.visual.image import DARK, SATURATED, LevelImages, intrinsics_of
from lvba.visual.scene_points import HIDDEN_M, SCENE_POINTS, Observations, ScenePoints, near_ranges, take

_log = logging.getLogger(__name__)
_GATES = ("passed", "behind", "outside", "slanted", "scaled", "hidden", "masked", "unlike")


@dataclass(frozen=True)
class VisibilityConfig(Group):
    """Which images become targets of a scene point."""

    window: int = setting(
        5,
        meaning="Local targets of a scene point lie up to this many keyframes before and after its reference.",
        unit="keyframes",
        low=1,
        high=1000,
        change_when="Neighboring keyframes hardly differ (more), or hardly overlap (fewer).",
        advanced=True,
    )
    max_local: int = setting(
        4,
        meaning="Local targets kept per scene point, spread over the window.",
        low=1,
        high=1000,
        change_when="Runs take too long (fewer).",
        advanced=True,
    )
    max_global: int = setting(
        6,
        meaning="Global targets kept of the point that is seen best in its voxel, spread over the recording; of others, "
        "half as many.",
        low=1,
        high=1000,
        change_when="Places are seen many times again and should be tied more (more), or runs take too long (fewer).",
        advanced=True,
    )


MIN_VIEW_COSINE = 0.17
"""alpha_1 of eq. (3): least cosine between the target's axis and the direction to the point; 80 degrees."""
MAX_VIEW_ANGLE_DEG = 84.0
"""alpha_2: largest angle between view direction and normal, at target and reference. A little more than scene points
are chosen with: a target may see a street from further off than its reference."""
MIN_NCC = 0.8
"""alpha_3: least correlation of the two patches, their noise taken off."""
MIN_SCALE = 0.6
"""The target must see the patch at this part of the reference's resolution, in its worse direction. A target much
farther away is blurred against the reference, and has points of its own that see it the other way."""
MAX_SCALE = 3.5
"""Nor larger than this: bilinear samples of a finer image alias."""
MIN_STD_SIGMA = 0.5
"""Floor of a patch's contrast in the correlation, in standard deviations of the noise. Half the noise is about the least
contrast at which 9 x 9 pixels still tell the same patch from another."""
MIN_USABLE = 0.8
"""Least part of the patch masked in neither image: less than that of a reference, for two images mask some."""
VOXEL_M = 0.5
"""m, edge of the voxels of the global map: as large as planes of common scenes."""
NEAR_TIME_S = 0.5
"""A camera sees what a scan saw within this time, s (and `NEAR_TIME_M`)."""
NEAR_TIME_M = 3.0
"""But not when it was further than this from the scan, m (the camera closest in time always does)."""
NEAR_SPACE_M = 0.4
"""A camera sees what a scan saw from within this distance at any time, m; less than a wall and a step."""
_FAR_TRIED = 16
"""Cameras of its voxel that each scene point is compared with, beside those near its reference. The best point of a voxel
alone, which is compared with all, ties little of a small place: of 100 images of a kitchen, 100 pairs of 70,000 were far
apart in time, and poses of images that see the same were 30 mm off what matched features say; now they are 19."""
_GOLDEN = 0.6180339887
_BLOCK = 16
"""Cells of the finest buffer along a block: a tenth of the width, some rings of a spinning LiDAR."""


@dataclass(frozen=True)
class VisibilityMap:
    """The global visibility voxel map: which cameras see a voxel, because LiDAR scans near them did.

    keys: (V,) int64, ascending, of the voxels; offsets: (V + 1,) int64; cameras: int32, ascending in each row
    voxel_m: edge of a voxel, m
    """

    keys: np.ndarray
    offsets: np.ndarray
    cameras: np.ndarray
    voxel_m: float

    def rows(self, points_world: Vectors) -> np.ndarray:
        """The row (P,) int64 of the voxel that holds each point (P, 3); -1 where the map has none."""
        keys = kernels.voxel_keys(np.ascontiguousarray(points_world, dtype=np.float64), self.voxel_m)
        row = np.minimum(np.searchsorted(self.keys, keys), max(len(self.keys) - 1, 0))
        if len(self.keys) == 0:
            return np.full(len(keys), -1)
        return np.where(self.keys[row] == keys, row, -1)


@dataclass(frozen=True)
class DepthBuffers:
    """The nearest LiDAR point in every cell of every image.

    nearest: (I, rows, columns) int32, index into points_world, -1: none; empty: nothing is known to hide anything
    points_world: (M, 3) float32; cell: edge of a cell as a part of the focal length fx (the same at every level)
    """

    nearest: np.ndarray
    points_world: np.ndarray
    cell: float

    def at(self, camera: Camera) -> NearestPoints:
        """As kernels take it, in pixels of this camera, of any level."""
        return NearestPoints(self.nearest, self.points_world, float(self.cell * camera.fx))


NOTHING_HIDES = DepthBuffers(np.empty((0, 0, 0), np.int32), np.empty((0, 3), np.float32), 1.0)


def depth_buffers(
    camera: Camera,
    world_from_camera: Poses,
    image_times: Times,
    plane_points: PlanePoints,
    scan_times: Times,
    time_window_s: float = 0.5,
    max_points: int = 1_000_000,
) -> DepthBuffers:
    """Depth buffers of all images from the scans near each in time.

    camera: of any level; world_from_camera: (I, 4, 4); image_times: (I,) s; scan_times: (S,) s
    A cell is wide enough that few are empty where there are any: 1.5 mean spacings of LiDAR points, 1/160 to 1/40 of the
    width.
    """
    window = np.full(len(image_times), time_window_s)
    ranges = near_ranges(image_times, scan_times, plane_points.scan_offsets, window, max_points)
    intrinsics = intrinsics_of(camera)
    poses, points = np.ascontiguousarray(world_from_camera), plane_points.points_world

    def buffers(part: slice, size: float) -> np.ndarray:
        # the kernel compiles for one layout
        own, at = np.ascontiguousarray(ranges[part]), np.ascontiguousarray(poses[part])
        return nearest_points(points, own, at, intrinsics, camera.width, camera.height, size, 0.1)

    finest = camera.width / 160
    some = buffers(slice(None, None, max(len(poses) // 8, 1)), finest)
    # of n points thrown on cells, a part exp(-n) of the cells stays empty
    held = min(float(np.median([_held(each >= 0) for each in some])), 0.999) if len(some) else 0.0
    cell = finest * float(np.clip(1.5 / np.sqrt(max(-np.log1p(-held), 1e-9)), 1, 4))
    return DepthBuffers(buffers(slice(None), cell), points, cell / camera.fx)


def _held(cells: np.ndarray) -> float:
    """The part of the cells (rows, columns) bool that hold points, where the LiDAR looks: not in the sky, say."""
    pad = [(0, -size % _BLOCK) for size in cells.shape]
    blocks = np.pad(cells, pad).reshape(-(-cells.shape[0] // _BLOCK), _BLOCK, -1, _BLOCK).sum(axis=(1, 3))
    sizes = np.pad(np.ones_like(cells), pad).reshape(len(blocks), _BLOCK, -1, _BLOCK).sum(axis=(1, 3))
    looked_at = blocks > 0
    return float(blocks[looked_at].sum() / max(sizes[looked_at].sum(), 1))


def cameras_near_scans(
    scan_times: Times,
    scan_positions: Vectors,
    image_times: Times,
    camera_positions: Vectors,
) -> tuple[np.ndarray, np.ndarray]:
    """Compressed rows of the cameras that see what a scan saw: offsets (S + 1,) int64, cameras int32.

    scan_times (S,), scan_positions (S, 3) of the sensor; image_times (I,), camera_positions (I, 3); world frame
    """
    rows = []
    for time, position in zip(scan_times, scan_positions, strict=True):
        gap = np.abs(image_times - time)
        distance = np.linalg.norm(camera_positions - position, axis=1)
        near = (gap <= NEAR_TIME_S) & (distance <= NEAR_TIME_M)
        near |= distance <= NEAR_SPACE_M
        near[gap.argmin()] |= gap.min() <= NEAR_TIME_S
        rows.append(np.flatnonzero(near).astype(np.int32))
    offsets = np.concatenate([[0], np.cumsum([len(row) for row in rows])]).astype(np.int64)
    return offsets, np.concatenate(rows) if rows else np.empty(0, np.int32)


def map_near_scans(
    scan_times: np.ndarray,
    sensors: np.ndarray,
    image_times: np.ndarray,
    world_from_camera: Poses,
    points: PlanePoints,
) -> VisibilityMap:
    """The `build_map` of cameras (I, 4, 4) near the scans whose points these are; further arguments as of
    `cameras_near_scans`.

    scan_times: (S,) float64, s; sensors: (S, 3) float64, m, world frame; image_times: (I,) float64, s
    """
    near = cameras_near_scans(scan_times, sensors, image_times, world_from_camera[:, :3, 3])
    return build_map(points.points_world, points.scan_offsets, near, len(world_from_camera))


def build_map(
    points_world: np.ndarray,
    scan_offsets: np.ndarray,
    near: tuple[np.ndarray, np.ndarray],
    images: int,
    voxel_m: float = VOXEL_M,
) -> VisibilityMap:
    """The global visibility voxel map of all scans; Li et al., II-C3a.

    points_world: (M, 3) float32, scan_offsets: (S + 1,) int64, as in PlanePoints; near: from `cameras_near_scans`
    """
    keys, count = kernels.scan_voxels(points_world, scan_offsets, voxel_m)
    parts = [keys[start : start + n] for start, n in zip(scan_offsets[:-1], count, strict=True)]
    every = np.concatenate(parts) if parts else np.empty(0, np.int64)
    scans = np.repeat(np.arange(len(count)), count)
    order = np.argsort(every, kind="stable")
    unique, first = np.unique(every[order], return_index=True)
    offsets = np.append(first, len(every)).astype(np.int64)
    rows, cameras = kernels.voxel_cameras(offsets, scans[order], near[0], near[1], images)
    return VisibilityMap(unique, rows, cameras, voxel_m)


def view_scores(
    points: ScenePoints, camera: Camera, world_from_camera: Poses, form: str = "area"
) -> np.ndarray:
    """How well the reference sees each point (P,): larger is better; Li et al., eq. (4).

    "area": pixels per m^2 of surface, fx fy |n.(p - t)| / z^3, which is what the paper's text describes.
    "as printed": |n.(p - t)| / |p - t|^2 (with the absolute value that eq. (4) lacks).
    """
    pose = world_from_camera[points.reference]
    view = points.position_world - pose[:, :3, 3]
    facing = np.abs(np.einsum("pi,pi->p", points.normal_world, view))
    if form == "as printed":
        return np.asarray(facing / np.einsum("pi,pi->p", view, view))
    depth = np.einsum("pi,pi->p", pose[:, :3, 2], view)
    return np.asarray(camera.fx * camera.fy * facing / depth**3)


def choose_global(points: ScenePoints, rows: Indices, score: np.ndarray) -> np.ndarray:
    """(P,) bool: the best point of every voxel; of equal scores the first. rows: (P,) voxel, -1: none.

    score: (P,) float64, of `view_scores`
    """
    order = np.lexsort((np.arange(len(rows)), -score, rows))
    best = np.ones(len(rows), bool)
    best[1:] = rows[order][1:] != rows[order][:-1]
    chosen = np.zeros(len(rows), bool)
    chosen[order[best]] = True
    return chosen & (rows >= 0)


def local_pairs(reference: Indices, images: int, window: int) -> tuple[np.ndarray, np.ndarray]:
    """Candidate (point, target), (O,) int32 each: the keyframes within `window` of each reference; sorted."""
    steps = np.concatenate([np.arange(-window, 0), np.arange(1, window + 1)])
    target = reference[:, None].astype(np.int64) + steps
    point = np.broadcast_to(np.arange(len(reference))[:, None], target.shape)
    inside = (target >= 0) & (target < images)
    return point[inside].astype(np.int32), target[inside].astype(np.int32)


def global_pairs(
    chosen: np.ndarray, rows: Indices, reference: Indices, seen: VisibilityMap
) -> tuple[np.ndarray, np.ndarray]:
    """Candidate (point, target), (O,) int32 each: the cameras of each chosen point's voxel; sorted.

    chosen: (P,) bool, of `choose_global`
    """
    index = np.flatnonzero(chosen)
    start, stop = seen.offsets[rows[index]], seen.offsets[rows[index] + 1]
    count = stop - start
    point = np.repeat(index, count)
    within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    target = seen.cameras[np.repeat(start, count) + within]
    other = target != reference[point]
    return point[other].astype(np.int32), target[other].astype(np.int32)


def far_pairs(
    wanted: np.ndarray, rows: Indices, reference: Indices, seen: VisibilityMap, window: int
) -> tuple[np.ndarray, np.ndarray]:
    """Candidate (point, target), (O,) int32 each: of each wanted point, some cameras of its voxel more than `window` from
    its reference, spread evenly over all of them, others for each point; sorted.

    wanted: (P,) bool; rows: (P,) voxel, -1: none; reference: (P,)
    """
    index = np.flatnonzero(wanted & (rows >= 0))
    start = seen.offsets[rows[index]]
    cameras = seen.offsets[rows[index] + 1] - start
    tried = np.minimum(cameras, _FAR_TRIED)
    step, phase = np.repeat(cameras / np.maximum(tried, 1), tried), np.repeat(index * _GOLDEN % 1.0, tried)
    within = np.arange(tried.sum()) - np.repeat(np.cumsum(tried) - tried, tried)
    point = np.repeat(index, tried)
    target = seen.cameras[np.repeat(start, tried) + ((within + phase) * step).astype(np.int64)]
    apart = np.abs(reference[point] - target) > window
    return point[apart].astype(np.int32), target[apart].astype(np.int32)


PairShifts = Callable[[ScenePoints, Indices, Indices], np.ndarray]
"""(O, 2) float64, px: by how much pairs of points (O,) and targets (O,) are off in the targets by the calibration."""


def find(
    level: LevelImages,
    world_from_camera: Poses,
    points: ScenePoints,
    seen: VisibilityMap | None,
    config: VisibilityConfig = VisibilityConfig(),
    depth: DepthBuffers = NOTHING_HIDES,
    *,
    patch: int = SCENE_POINTS.size,
    score: str = "area",
    shifts: PairShifts | None = None,
) -> tuple[ScenePoints, Observations]:
    """The scene points that some target sees, with `is_global` set, and their pairs, at one pyramid level.

    world_from_camera: (I, 4, 4), of the images of the level; points: from `scene_points.select`
    seen: the global map; None: local targets only
    depth: of the same images, to refuse hidden targets by geometry; without, the correlation alone judges
    patch: N of the N x N patch, px, odd, that of the scene points; score: as of `view_scores`
    shifts: how far the calibration moves pairs in their targets; None: not at all

    Source: Li et al., II-C2, II-C3 and eq. (3), without the bars round d.z_C, with the whole warped patch inside the
    target, a gate on its scale, and the union of local and global targets. Ours: points that are not the best of their
    voxel have global targets, too.
    """
    count = len(level.images)

    def passing(candidates: Pairs, limit: int) -> tuple[Pairs, int, int]:
        good, compared = _passing(*candidates, level, world_from_camera, points, patch, depth, shifts)
        return _spread(good, limit), compared, len(good[0])

    local, compared, alike = passing(local_pairs(points.reference, count, config.window), config.max_local)
    if seen is None:
        none = np.empty(0, np.int32), np.empty(0, np.int32)
        return _union(points, local, none, count, compared=compared, alike=alike)
    rows = seen.rows(points.position_world)
    chosen = choose_global(points, rows, view_scores(points, level.camera, world_from_camera, score))
    candidates = _without(global_pairs(chosen, rows, points.reference, seen), local, count)
    of_chosen = passing(candidates, config.max_global)[0]
    others = passing(
        far_pairs(~chosen, rows, points.reference, seen, config.window),
        (config.max_global + 1) // 2,
    )[0]
    chosen[others[0]] = True
    far = (np.append(of_chosen[0], others[0]), np.append(of_chosen[1], others[1]))
    points = replace(points, is_global=chosen)
    return _union(points, local, far, count, compared=compared, alike=alike)


Pairs = tuple[np.ndarray, np.ndarray]


def pair_gates(patch: int, noise: float) -> kernels.PairGates:
    """What a pair must pass. patch: px, side; noise: standard deviation of the images' noise, grey values"""
    return kernels.PairGates(
        half=patch // 2,
        min_view_cosine=MIN_VIEW_COSINE,
        min_normal_cosine=float(np.cos(np.radians(MAX_VIEW_ANGLE_DEG))),
        min_scale=MIN_SCALE,
        max_scale=MAX_SCALE,
        min_ncc=MIN_NCC,
        contrast_floor=float((MIN_STD_SIGMA * noise) ** 2),
        dark=float(DARK),
        bright=float(SATURATED),
        min_usable=MIN_USABLE,
        hiding=HIDDEN_M,
        noise=float(noise**2),
    )


def kernel_patches(points: ScenePoints) -> PlanePatches:
    """Scene points as kernels take them."""
    return PlanePatches(points.position_world, points.normal_world, points.reference, points.pixel)


def _passing(
    point: np.ndarray,
    target: np.ndarray,
    level: LevelImages,
    world_from_camera: np.ndarray,
    points: ScenePoints,
    patch: int,
    depth: DepthBuffers,
    shifts: PairShifts | None,
) -> tuple[Pairs, int]:
    """The pairs that pass eq. (3), and of how many the patches were compared: by geometry, both images show them."""
    shift = np.zeros((0, 2)) if shifts is None else np.ascontiguousarray(shifts(points, point, target))
    verdict, _ = kernels.judge_pairs(
        level.images,
        np.ascontiguousarray(world_from_camera),
        intrinsics_of(level.camera),
        kernel_patches(points),
        point,
        target,
        pair_gates(patch, level.noise),
        depth.at(level.camera),
        shift,
    )
    counts = np.bincount(verdict, minlength=len(_GATES))
    _log.debug("pairs: %s", ", ".join(f"{n} {name}" for name, n in zip(_GATES, counts, strict=True)))
    good = verdict == kernels.PASSED
    compared = int(counts[kernels.PASSED] + counts[kernels.UNLIKE])
    return (point[good], target[good]), compared


def _spread(pairs: Pairs, limit: int) -> Pairs:
    keep = kernels.keep_spread(pairs[0], limit)
    return pairs[0][keep], pairs[1][keep]


def _without(pairs: Pairs, others: Pairs, images: int) -> Pairs:
    """The pairs that are not among `others`, which are sorted."""
    codes, known = _codes(pairs, images), _codes(others, images)
    if len(known) == 0:
        return pairs
    place = np.minimum(np.searchsorted(known, codes), len(known) - 1)
    new = known[place] != codes
    return pairs[0][new], pairs[1][new]


def _codes(pairs: Pairs, images: int) -> np.ndarray:
    return np.asarray(pairs[0].astype(np.int64) * images + pairs[1])


def _union(
    points: ScenePoints, local: Pairs, far: Pairs, images: int, *, compared: int, alike: int
) -> tuple[ScenePoints, Observations]:
    """Points with at least one pair, and all pairs by (point, target)."""
    point, target = np.concatenate([local[0], far[0]]), np.concatenate([local[1], far[1]])
    through_map = np.arange(len(point)) >= len(local[0])
    order = np.argsort(_codes((point, target), images), kind="stable")
    seen = np.zeros(len(points), bool)
    seen[point] = True
    renumbered = (np.cumsum(seen) - 1)[point[order]]
    observations = Observations(
        renumbered.astype(np.int32), target[order].astype(np.int32), through_map[order], compared, alike
    )
    return take(points, seen), observations
