"""Whether scan poses are meant in another way than they are read, by the scans: do these agree far better another way?

A few pairs of scans are laid on each other by the poses as given and by each other reading, where the two differ by
four meters. Right recordings are done after two pairs of each, for their scans agree as given. Poses that are merely
rough agree badly in every reading.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from lvba import geometry
from lvba.arrays import Poses

WORLD, W_FIRST, INVERSE = "world", "w_first", "inverse"


@dataclass(frozen=True)
class PoseReading:
    """What the files seem to hold instead, and the mend: both without a full stop."""

    problem: str
    mend: str


READINGS = {
    W_FIRST: PoseReading(
        "scans agree far better if the quaternions are read w first", "write t tx ty tz qx qy qz qw"
    ),
    INVERSE: PoseReading(
        "scans agree far better with the inverse of the poses", "write poses from body to world"
    ),
    WORLD: PoseReading(
        "scans seem to be in the world frame, for they agree far better without their poses",
        "write them in the body frame",
    ),
}
_PAIRS, _FEWEST_PAIRS, _MOST_AGAINST = 6, 4, 1
"""Pairs tried of each reading, those needed to say anything, and those that may speak against it."""
_DIFFERENT_M, _AT_M, _FURTHEST_M = 4.0, 5.0, 15.0
"""m by which two readings of a motion must differ at points so far away; longer motions share too few surfaces."""
_WINDOW = 300
"""Scans after the first of a pair that are looked at for the second."""
_MOVED_M = 2.0
"""m between scans that are to agree without their poses ..."""
_FOLLOWS = 0.2
"""... and the part of that motion by which their points must move along: of a sensor that stands still, they do not."""
_FAR_BETTER = 4.0
"""Times by which points must be nearer to each other in the other reading."""
_QUERIES, _POINTS, _NEIGHBORS = 300, 10_000, 6
_NEAR_M = 1.0
"""m up to which points count as of one surface."""
_FEWEST_POINTS = 50

Load = Callable[[int], np.ndarray]


def find(world_from_scan: Poses, load: Load) -> str:
    """The key of the reading in which scans agree far better than as given, "" if there is none.

    world_from_scan: (S, 4, 4), m; load: the `thinned` points (N, 3) of a scan, m, asked for several times
    Raises: InputError if a scan cannot be read.
    """
    if len(world_from_scan) < _FEWEST_PAIRS:
        return ""
    others = {
        W_FIRST: w_first(world_from_scan),
        INVERSE: geometry.inverse(world_from_scan),
        WORLD: np.broadcast_to(np.eye(4), world_from_scan.shape),
    }
    gains = {name: _gain(world_from_scan, other, load, name == WORLD) for name, other in others.items()}
    best = max(gains, key=lambda name: gains[name])
    return best if gains[best] else ""


def w_first(poses: Poses) -> np.ndarray:
    """The poses (N, 4, 4) as meant if their quaternions were written w first, (N, 4, 4)."""
    return geometry.from_quaternion_translation(
        np.roll(geometry.quaternion(poses), -1, axis=-1), poses[:, :3, 3]
    )


def _gain(given: np.ndarray, other: np.ndarray, points: Load, world: bool) -> float:
    """By how many times scans agree better (median over pairs) where they clearly do; else 0."""
    pairs = _pairs(given, other, _MOVED_M if world else 0.0)
    if len(pairs) < _FEWEST_PAIRS:
        return 0.0
    gains: list[float] = []
    for first, second in pairs:
        ends = points(first), points(second)
        if min(map(len, ends)) < _FEWEST_POINTS:
            return 0.0
        distances = [_distance(*ends, _motion(poses, first, second)) for poses in (given, other)]
        gains.append(distances[0] / max(distances[1], 1e-6))
        if sum(gain < _FAR_BETTER for gain in gains) > _MOST_AGAINST:
            return 0.0
    if world and not _follow(given, pairs, points):
        return 0.0
    return float(np.median(gains))


def _pairs(given: np.ndarray, other: np.ndarray, moved_m: float) -> list[tuple[int, int]]:
    """Pairs of scans whose motions in two readings differ enough: as near in time as that allows, spread over all."""
    pairs = []
    starts = np.unique(np.linspace(0, len(given) - 1, 2 * _PAIRS, endpoint=False).astype(int))
    for first in starts.tolist():
        later = slice(first + 1, first + 1 + _WINDOW)
        motions = geometry.inverse(given[first]) @ given[later]
        others = geometry.inverse(other[first]) @ other[later]
        differences = geometry.inverse(motions) @ others
        off = np.linalg.norm(differences[:, :3, 3], axis=1)
        off += _AT_M * np.radians(geometry.rotation_angle_deg(differences))
        lengths = np.linalg.norm(motions[:, :3, 3], axis=1)
        fits = np.flatnonzero((off >= _DIFFERENT_M) & (lengths >= moved_m) & (lengths <= _FURTHEST_M))
        if len(fits):
            pairs.append((first, first + 1 + int(fits[0])))
    return [pairs[index] for index in _spread(len(pairs))]


def _spread(count: int) -> list[int]:
    """Indices of at most `_PAIRS` of so many."""
    return sorted({int(index) for index in np.linspace(0, count - 1, min(count, _PAIRS))}) if count else []


def _motion(poses: np.ndarray, first: int, second: int) -> np.ndarray:
    """(4, 4), the first scan's frame from the second's."""
    return np.asarray(geometry.inverse(poses[first]) @ poses[second])


def _follow(given: np.ndarray, pairs: list[tuple[int, int]], points: Load) -> bool:
    """Whether the middles of scans move along with the poses, as those of scans in the world frame do."""
    moved = np.array([given[second, :3, 3] - given[first, :3, 3] for first, second in pairs])
    middles = np.array(
        [np.median(points(second), axis=0) - np.median(points(first), axis=0) for first, second in pairs]
    )
    return bool(np.sum(moved * middles) >= _FOLLOWS * np.sum(moved * moved))


def thinned(points: np.ndarray) -> np.ndarray:
    """At most `_POINTS` of the points, spread evenly, (M, 3) float64.

    points: (N, 3) float32 or float64, m
    """
    return points[:: -(-len(points) // _POINTS)].astype(np.float64)


def _distance(first: np.ndarray, second: np.ndarray, first_from_second: np.ndarray) -> float:
    """m: median over some points of the second scan of the distance from the plane of the nearest points of the first.

    Where none is near, that of the nearest point.
    """
    some = geometry.transform_points(first_from_second, second[:: -(-len(second) // _QUERIES)])
    distances, numbers = cKDTree(first).query(some, _NEIGHBORS)
    nearest = first[numbers]
    middles = nearest.mean(axis=1)
    off = nearest - middles[:, None]
    _, axes = np.linalg.eigh(off.swapaxes(1, 2) @ off)
    from_plane = np.abs(((some - middles) * axes[:, :, 0]).sum(1))
    return float(np.median(np.where(distances[:, 0] <= _NEAR_M, from_plane, distances[:, 0])))
