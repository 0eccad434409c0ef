"""Images that lost the others as a group: moved together to where features of several of them say.

Along a corridor, the odometry may be off by decimeters from one scan to the next, and scans do not tell. Images before
that step look alike, and those after it, but patches of the ones find nothing in the others: the pairs of images fall
into groups. Within each, images hold each other. So features put several of its images (`relocalization`), and where
these agree on one rigid motion of the group, all of it moves.

Only along their own surfaces: those belong to the scans of the same moments, which stay. Where a group of scans is off as
well, its images are right as they are beside it.
"""

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from lvba import geometry
from lvba.arrays import Indices, Pose, Poses
from lvba.visual.image import Pyramid
from lvba.visual.photometric import Problem
from lvba.visual.relocalization import BY_CHANCE, FEW, Matcher, apart, distance, nearest, usual
from lvba.visual.scene_points import Observations, ScenePoints
from lvba.visual.states import VisualState

logger = logging.getLogger(__name__)

_BESIDE = 2
"""Groups that one is put beside: the nearest."""
_TRIED = 6
"""Images of a group that features put: those nearest to others."""
_FEWER = (3, 1)
"""Images that one is put by, where the usual number does not tell."""
_ENOUGH_ALONE = 60
"""Features by which a single image moves its group."""
_MAJORITY = 0.5
"""Part of all features that must agree: images that are not where their scans are contradict each other."""
_AGREE_M, _AGREE_DEG = 0.1, 1.5
"""Two images that move their group no further apart than this agree."""
_FARTHEST_M = 3.0
"""The trajectory is not off by more from one group to the next: what says so is another place that looks alike."""
_MOST, _OFF_M, _OFF_PART = 0.75, 0.1, 0.2
"""A motion is along surfaces that takes this part of what a group sees off its planes by no more than so many meters, or
that part of how far it moves: features put images to centimeters and tenths of degrees."""


def find(points: ScenePoints, observations: Observations, images: int) -> np.ndarray:
    """(I,) int64: the group of each image; more pairs than chance brings tie the images of one to each other.

    Where images have few pairs anyway, each is alone.
    """
    reference = points.reference[observations.point]
    ones = np.ones(len(reference), np.int64)
    pairs = coo_matrix((ones, (reference, observations.target)), shape=(images, images)).tocsr()
    pairs = pairs + pairs.T
    strongest = usual(pairs.max(axis=1).toarray().ravel())
    if not strongest:
        return np.arange(images)
    tied = pairs > max(BY_CHANCE, FEW * strongest)
    return np.asarray(connected_components(tied, directed=False)[1], np.int64)


def in_largest(group: Indices) -> np.ndarray:
    """(I,) bool: the images of the largest group. group: (I,) int64, -1: of none"""
    name, count = np.unique(group[group >= 0], return_counts=True)
    return np.asarray(group == name[count.argmax()])


def of_all(parts: Sequence[tuple[Indices, Indices]], images: int) -> np.ndarray:
    """(I,) int64: the groups of all images; those of two parts are one where both parts have an image of it.

    parts: for each, numbers (k,) of its images and their groups (k,) there
    """
    image, group, count = [], [], images
    for numbers, own in parts:
        image.append(numbers)
        group.append(count + own)
        count += int(own.max(initial=-1)) + 1
    if not image:
        return np.arange(images)
    ends = np.concatenate(image), np.concatenate(group)
    graph = coo_matrix((np.ones(len(ends[0])), ends), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1][:images], np.int64)


def rejoined(problem: Problem, pyramid: Pyramid, state: VisualState) -> VisualState:
    """The state with groups of images where features have them beside the others; as it is where there is one group, or
    features do not say.

    problem: solved to this state, at any level of the pyramid
    """
    group = find(problem.points, problem.observations, len(problem.images))
    if np.count_nonzero(np.bincount(group) > 1) < 2:
        return state
    together = put_together(
        Matcher.of(problem.points, pyramid), state.cameras.world_from_camera, group, problem.points
    )
    if together is None:
        return state
    return replace(state, cameras=replace(state.cameras, world_from_camera=together[0]))


def put_together(
    matcher: Matcher, poses: Poses, group: Indices, points: ScenePoints | None = None
) -> tuple[np.ndarray, np.ndarray] | None:
    """Poses (I, 4, 4) with groups of images where features have them beside larger ones, and which are of one group then,
    (I,) int64; None: features do not say of any.

    poses: (I, 4, 4); group: (I,) int64; points: groups move along the planes of theirs only; None: anywhere
    """
    poses, group = poses.copy(), np.array(group, np.int64)
    tried: set[tuple[bytes, bytes]] = set()
    moved = False
    while _some_join(matcher, points, poses, group, tried):
        moved = True
    return (poses, group) if moved else None


def _some_join(
    matcher: Matcher,
    points: ScenePoints | None,
    poses: Poses,
    group: np.ndarray,
    tried: set[tuple[bytes, bytes]],
) -> bool:
    """Whether features put a group beside a larger one that is near; it is moved there in poses, and is part of it then.

    group: (I,) int64, changed; tried: pairs of groups that features do not put beside each other, changed
    """
    size = np.bincount(group)
    for small in np.argsort(size, kind="stable"):
        if size[small] < 2:
            continue
        members = np.flatnonzero(group == small)
        for large in _near(poses, group, members, size):
            others = np.flatnonzero(group == large)
            pair = (members.tobytes(), others.tobytes())
            if pair in tried:
                continue
            tried.add(pair)
            if _joins(matcher, points, poses, members, others):
                group[members] = large
                return True
    return False


def _near(poses: Poses, group: np.ndarray, members: np.ndarray, size: np.ndarray) -> list[int]:
    """The groups that some images (n,) may be put beside: larger ones (or as large and later), the nearest first."""
    rank = np.lexsort((np.arange(len(size)), size)).argsort()
    larger = np.flatnonzero((rank[group] > rank[group[members[0]]]) & (size[group] > 1))
    if not len(larger):
        return []
    far = np.min([distance(poses, int(each), larger) for each in members], axis=0)
    order = group[larger[np.argsort(far, kind="stable")]]
    unique, first = np.unique(order, return_index=True)
    return [int(each) for each in unique[np.argsort(first)][:_BESIDE]]


def _joins(
    matcher: Matcher, points: ScenePoints | None, poses: Poses, members: Indices, others: Indices
) -> bool:
    """Whether features put some images (n,) beside others (m,); they are moved there in poses."""
    far = [distance(poses, int(each), others).min() for each in members]
    closest = members[np.argsort(far, kind="stable")[:_TRIED]]
    by_features = [
        _by_features(matcher, int(each), nearest(poses, int(each), others), poses) for each in closest
    ]
    seen = [each for each in by_features if each is not None]
    motion = _agreed(seen, poses[closest[0]])
    if motion is None or not (points is None or _along_surfaces(motion, points, members)):
        return False
    meters, degrees = apart(motion @ poses[members[0]], poses[members[0]])
    logger.info(
        "images %d to %d were off the others by %.0f mm and %.2f degrees",
        members[0], members[-1], 1e3 * meters, degrees,
    )  # fmt: skip
    poses[members] = motion @ poses[members]
    return True


def _along_surfaces(motion: Pose, points: ScenePoints, members: Indices) -> bool:
    """Whether a motion (4, 4) leaves what some images see on its planes."""
    mine = np.isin(points.reference, members)
    position = points.position_world[mine]
    if not len(position):
        return False
    shift = geometry.transform_points(motion, position) - position
    off = np.abs(np.einsum("ni,ni->n", points.normal_world[mine], shift))
    far = float(np.median(np.linalg.norm(shift, axis=1)))
    return bool(np.quantile(off, _MOST) < max(_OFF_M, _OFF_PART * far))


def _by_features(matcher: Matcher, image: int, near: Indices, poses: Poses) -> tuple[Pose, int] | None:
    """The motion (4, 4) that an image makes to where features have it, and how many agree; None: they do not say."""
    # few at a time where many dilute it: what those far away match is chance
    for count in (len(near), *_FEWER):
        by_features = matcher.pose(image, near[:count], poses, _FARTHEST_M)
        if by_features is not None:
            return by_features[0] @ geometry.inverse(poses[image]), by_features[1]
    return None


def _agreed(seen: list[tuple[Pose, int]], at: Pose) -> Pose | None:
    """The mean (4, 4), by features, of the motions that one of them agrees with at a pose, as many as can be; None: no
    two do, and none alone has features enough, or more features contradict it."""
    motions = [motion for motion, _ in seen]
    agree = np.array([[_alike(one, other, at) for other in motions] for one in motions], bool)
    if len(seen) == 0 or (agree.sum(axis=1).max() < 2 and max(count for _, count in seen) < _ENOUGH_ALONE):
        return None
    best = max(range(len(seen)), key=lambda k: (agree[k].sum(), seen[k][1]))
    features = np.array([count for _, count in seen])
    if features[agree[best]].sum() < _MAJORITY * features.sum():
        return None
    off = geometry.log(geometry.inverse(motions[best] @ at) @ np.stack(motions) @ at)
    mean = np.average(off, axis=0, weights=agree[best] * features)
    return np.asarray(geometry.retract(motions[best] @ at, mean) @ geometry.inverse(at))


def _alike(one: Pose, other: Pose, at: Pose) -> bool:
    meters, degrees = apart(one @ at, other @ at)
    return meters <= _AGREE_M and degrees <= _AGREE_DEG
