"""Images that were lost: put where features say they are, so that patches can find them again.

Patches find an image that is a few pixels off at the coarsest level. Where the sensor turns by 40 degrees a second, or
stamps have a gap, the trajectory may leave a single image 3 degrees off: no patch of it looks like its neighbors' then,
and it stays wrong where all others come to a tenth of a millimeter. Such an image has hardly any pairs where others have
hundreds. Features that match at any distance (SIFT: Lowe 2004) with places on LiDAR planes from the images about it give
its pose (perspective n-point in RANSAC, OpenCV); the levels that follow say what it is worth.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from scipy.spatial import cKDTree

from lvba import geometry
from lvba.arrays import Indices, Picture, Pose, Poses
from lvba.camera import Camera
from lvba.visual.image import Pyramid
from lvba.visual.photometric import Problem
from lvba.visual.scene_points import Observations, ScenePoints, take_observed
from lvba.visual.states import VisualState

logger = logging.getLogger(__name__)

FEW = 0.05
"""An image is lost that has less than this part of the pairs that half of the images have ..."""
_ENOUGH = 100
"""... where that half has as many as this: else pairs are few anyway."""
BY_CHANCE = 12
"""Pairs that an image has by chance: of a thousand patches that see something else, so many may look alike."""
_NEIGHBORS = 8
"""Images whose places are matched with those of a lost one."""
_TURN_DEG, _STEP_M = 30.0, 1.0
"""They are those that look the same way from the same place: a turn counts as much as a step."""
_FEATURES = 2000
_CONTRAST = 0.01
"""A quarter of what SIFT asks for: of dark images there would be eight features, and nobody needs more than the best."""
_MOST_PIXELS = 1_500_000
"""Of an image: features need no more."""
_REMEMBERED = 100
"""Images whose features are in memory at a time, a megabyte of each."""
_LEVELS = 6
_RATIO = 0.75
"""The best match must be this much nearer than the second best (Lowe 2004)."""
_NEAR_POINT = 0.05
"""A feature is on the plane of a scene point so near in the image, as a part of its width."""
_REPROJECTION_PX = 2.0
_FEWEST_INLIERS = 30
"""Chance brings five."""
_LEAST_AGREEING = 0.3
"""Part of the matches that must be inliers."""
_FARTHEST_DEG, _FARTHEST_M = 30.0, 1.0
"""The trajectory is not off by more: what says so is another place that looks alike."""
_LEAST_DEPTH_M = 0.2


def lost(points: ScenePoints, observations: Observations, images: int) -> np.ndarray:
    """(n,) int64, images that hardly any other is compared with, where others are with many."""
    pairs = _pairs(points, observations, images)
    return np.flatnonzero(pairs < FEW * usual(pairs))


def _pairs(points: ScenePoints, observations: Observations, images: int) -> np.ndarray:
    """(I,) int64, how many patches of an image are compared with one of another."""
    ends = np.concatenate([points.reference[observations.point], observations.target])
    return np.bincount(ends, minlength=images)


def usual(pairs: Indices) -> float:
    """What half of the images have of (I,) pairs each; 0: so few that no image is missing any."""
    middle = float(np.median(pairs))
    return middle if middle >= _ENOUGH else 0.0


def without_chance(
    points: ScenePoints, observations: Observations, images: int
) -> tuple[ScenePoints, Observations]:
    """Points and pairs without those of images that have no more than chance brings, where others have many.

    Three patches that look alike by chance hold an image to a millimeter, wherever it is.
    """
    pairs = _pairs(points, observations, images)
    chance = pairs < min(BY_CHANCE, FEW * usual(pairs))
    kept = ~chance[points.reference[observations.point]] & ~chance[observations.target]
    if kept.all():
        return points, observations
    used = np.zeros(len(points), bool)
    used[observations.point[kept]] = True
    left = replace(
        observations,
        point=observations.point[kept],
        target=observations.target[kept],
        is_global=observations.is_global[kept],
    )
    return take_observed(points, left, used)


def relocalized(problem: Problem, pyramid: Pyramid, state: VisualState) -> VisualState:
    """The state with lost images where features have them; as it is where there are none, or features do not say.

    problem: solved to this state, at any level of the pyramid
    """
    missing = lost(problem.points, problem.observations, len(problem.images))
    if not len(missing):
        return state
    matcher = Matcher.of(problem.points, pyramid)
    poses = state.cameras.world_from_camera.copy()
    others = np.setdiff1d(np.arange(len(poses)), missing)
    for image in missing:
        by_features = matcher.pose(int(image), nearest(poses, int(image), others), poses, _FARTHEST_M)
        if by_features is None:
            logger.info("image %d is lost, and features do not say where it is", image)
            continue
        pose, _ = by_features
        meters, degrees = apart(pose, poses[image])
        logger.info("image %d was lost by %.0f mm and %.2f degrees", image, 1e3 * meters, degrees)
        poses[image] = pose
    return replace(state, cameras=replace(state.cameras, world_from_camera=poses))


PlanesOf = Callable[[int, Pose], tuple[np.ndarray, np.ndarray]]
"""Of an image at a pose (4, 4): places (N, 3), m, world, that it sees, and the normals (N, 3) of the planes there."""


class Matcher:
    """Poses of images by their features, matched with places that those of other images have on planes.

    planes: that an image sees; camera: pinhole; image: gives one, (H, W, C) uint8, as that camera sees it
    """

    def __init__(self, planes: PlanesOf, camera: Camera, image: Callable[[int], Picture]) -> None:
        self._planes, self._camera = planes, camera
        self._look = lru_cache(_REMEMBERED)(lambda number: _features(image(number)))

    @staticmethod
    def of(points: ScenePoints, pyramid: Pyramid) -> "Matcher":
        """Of images whose planes are those of their scene points."""
        level = _level([each.shape[1] * each.shape[2] for each in pyramid.levels])

        def planes(image: int, _: Pose) -> tuple[np.ndarray, np.ndarray]:
            mine = points.reference == image
            return points.position_world[mine], points.normal_world[mine]

        return Matcher(planes, pyramid.camera.at_level(level), lambda image: pyramid.levels[level][image])

    def pose(
        self, image: int, near: Indices, poses: Poses, farthest_m: float, fewest: int = _FEWEST_INLIERS
    ) -> tuple[Pose, int] | None:
        """world_from_camera (4, 4) of an image by those (n,) near it, where poses (I, 4, 4) have them, and how many
        features agree on it; None: fewer do, or on one further than so many m from where it is."""
        places = [
            _places(*self._planes(int(each), poses[each]), poses[each], self._camera, self._look(int(each)))
            for each in near
        ]
        seen = self._look(image)
        by_features = _pose(seen, [each for each in places if len(each.descriptor) > 1], self._camera, fewest)
        if by_features is None:
            return None
        meters, degrees = apart(by_features[0], poses[image])
        return by_features if meters <= farthest_m and degrees <= _FARTHEST_DEG else None


def at_features_size(camera: Camera) -> Camera:
    """The camera of images no larger than features need."""
    levels = [camera.at_level(level) for level in range(_LEVELS)]
    return levels[_level([each.width * each.height for each in levels])]


def _level(sizes: Sequence[int]) -> int:
    """The finest level whose images, of so many pixels, are no larger than features need."""
    return next((level for level, size in enumerate(sizes) if size <= _MOST_PIXELS), len(sizes) - 1)


@dataclass(frozen=True)
class _Features:
    """pixel: (N, 2) float64; descriptor: (N, 128) float32"""

    pixel: np.ndarray
    descriptor: np.ndarray


@dataclass(frozen=True)
class _Places:
    """Features of known images. position_world: (N, 3) m; descriptor: (N, 128) float32"""

    position_world: np.ndarray
    descriptor: np.ndarray


def _features(image: np.ndarray) -> _Features:
    """Of one image (H, W, C) uint8."""
    grey = image[..., 0] if image.shape[2] == 1 else image.mean(axis=2).astype(np.uint8)
    keys, descriptor = cv2.SIFT.create(_FEATURES, contrastThreshold=_CONTRAST).detectAndCompute(
        np.ascontiguousarray(grey), None
    )
    if descriptor is None:
        return _Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    # threads may find them in any order
    table = np.array([(*key.pt, key.size, key.angle) for key in keys])
    order = np.lexsort(table.T)
    return _Features(table[order, :2], descriptor[order])


def nearest(poses: Poses, image: int, others: Indices) -> np.ndarray:
    """(n,) int64: the others that look the same way from the same place as an image, by their poses (I, 4, 4), nearest
    first."""
    return np.asarray(others[np.argsort(distance(poses, image, others), kind="stable")[:_NEIGHBORS]])


def distance(poses: Poses, image: int, others: Indices) -> np.ndarray:
    """(n,) float64: how far each of (n,) others is from an image: a step of a meter and a turn of 30 degrees are 1."""
    off = geometry.inverse(poses[image]) @ poses[others]
    angle = np.degrees(np.arccos(np.clip(off[:, 2, 2], -1.0, 1.0)))
    return np.asarray(angle / _TURN_DEG + np.linalg.norm(off[:, :3, 3], axis=1) / _STEP_M)


def _places(position: np.ndarray, normal: np.ndarray, pose: Pose, camera: Camera, seen: _Features) -> _Places:
    """The features of an image that are near one of the places (N, 3) that it sees, on the plane of that.

    normal: (N, 3) of the planes
    """
    inside = geometry.transform_points(geometry.inverse(pose), position)
    inside = inside[:, :2] / inside[:, 2:]
    if not len(inside) or not len(seen.pixel):
        return _Places(np.zeros((0, 3)), np.zeros((0, 128), np.float32))
    distance, nearest = cKDTree(inside * [camera.fx, camera.fy] + [camera.cx, camera.cy]).query(seen.pixel)
    ray = np.column_stack([*camera.normalized(seen.pixel), np.ones(len(seen.pixel))]) @ pose[:3, :3].T
    away = np.einsum("ni,ni->n", normal[nearest], position[nearest] - pose[:3, 3])
    along = np.einsum("ni,ni->n", normal[nearest], ray)
    depth = away / np.where(np.abs(along) > 1e-6, along, np.inf)
    good = (distance < _NEAR_POINT * camera.width) & (depth > _LEAST_DEPTH_M)
    return _Places((pose[:3, 3] + depth[:, None] * ray)[good], seen.descriptor[good])


def _pose(seen: _Features, places: list[_Places], camera: Camera, fewest: int) -> tuple[Pose, int] | None:
    """world_from_camera (4, 4) of the image with these features, and how many agree on it; None: fewer do."""
    if len(seen.pixel) < fewest:
        return None
    matches = [_matched(seen, each) for each in places]
    if sum(len(pixel) for pixel, _ in matches) < fewest:
        return None
    pixel = np.concatenate([each for each, _ in matches])
    position = np.concatenate([each for _, each in matches])
    middle = position.mean(axis=0)
    solved, turn, shift, agreed = cv2.solvePnPRansac(
        position - middle, pixel, camera.matrix, None, reprojectionError=_REPROJECTION_PX,
        iterationsCount=1000, confidence=0.9999,
    )  # fmt: skip
    if not solved or agreed is None or len(agreed) < max(fewest, _LEAST_AGREEING * len(pixel)):
        return None
    index = agreed.ravel()
    turn, shift = cv2.solvePnPRefineLM(
        (position - middle)[index], pixel[index], camera.matrix, None, turn, shift
    )
    rotation = np.asarray(cv2.Rodrigues(turn)[0], float)
    camera_from_middle = geometry.from_rotation_translation(rotation, np.asarray(shift, float).ravel())
    pose = geometry.inverse(camera_from_middle)
    pose[:3, 3] += middle
    return (pose, len(index)) if np.isfinite(pose).all() else None


def _matched(seen: _Features, places: _Places) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (N, 2) of features, and the places (N, 3) of those of a known image that they match, one to one.

    Where that has few places, the ratio to the second best says little: a hundred features may match the same one.
    """
    pairs = cv2.BFMatcher().knnMatch(seen.descriptor, places.descriptor, k=2)
    good = [one for one, other in pairs if one.distance < _RATIO * other.distance]
    # each place with the feature that is nearest to it
    best = {one.trainIdx: one.queryIdx for one in sorted(good, key=lambda each: -each.distance)}
    there, here = np.array(list(best.items()), np.int64).reshape(-1, 2).T
    return seen.pixel[here], places.position_world[there]


def apart(one: Pose, other: Pose) -> tuple[float, float]:
    """m and degrees from one pose (4, 4) to another."""
    off = geometry.inverse(other) @ one
    return float(np.linalg.norm(off[:3, 3])), float(geometry.rotation_angle_deg(off))
