"""Jumps of rough scan poses that surfaces do not tell of: mended by features of the images on both sides.

A depth camera or a narrow LiDAR sees one wall before a jump and another one after it; images of some other moment may
have seen both. Between jumps, poses are as good as an odometry's: a few scans show on which planes features are.
"""

from collections.abc import Sequence

import numpy as np

from lvba import geometry, trajectory
from lvba.arrays import Indices, Poses
from lvba.dataset import Dataset
from lvba.loop_closure.submap import Patch
from lvba.steps import features_on_scans
from lvba.trajectory import Trajectory
from lvba.visual import image_groups

_SCANS = 6
"""Scans of the same run, the nearest in time, whose surfels an image may see."""
_BESIDE = 0.2
"""Of the time from a scan to the next: an image so near to one is where its motion leads, on whichever side of a jump."""
LEAST_M, LEAST_DEG = 0.1, 1.5
"""Features tell a motion no better: one that is nearer to theirs is left alone."""


def mended(
    dataset: Dataset, patches: Sequence[Patch | None], world_from_scan: Poses, after: Indices
) -> tuple[np.ndarray, np.ndarray]:
    """Poses (S, 4, 4) of the scans, the first unchanged, with those after jumps where images have them; and the scans
    (M,) int64 after which that moved the next ones.

    dataset: of these scans; patches: surfels of each; world_from_scan: (S, 4, 4); after: (J,) int64, scans after which
        poses jump
    Raises InputError: an image cannot be read.
    """
    run = np.zeros(len(world_from_scan), np.int64)
    run[1:] = np.cumsum(np.isin(np.arange(len(run) - 1), after))
    numbers, of_run = _of_images(dataset, run)
    if np.count_nonzero(np.bincount(of_run) > 1) < 2:
        return world_from_scan, np.zeros(0, np.int64)
    cameras = _cameras(dataset, world_from_scan, run, numbers, of_run)

    def scans_of(index: int) -> np.ndarray:
        own = np.flatnonzero(run == of_run[index])
        return features_on_scans.nearest_scans(dataset, numbers[index], own, _SCANS)

    matcher = features_on_scans.matcher(dataset, patches, world_from_scan, numbers, cameras, scans_of)
    together = image_groups.put_together(matcher, cameras, of_run)
    if together is None:
        return world_from_scan, np.zeros(0, np.int64)
    motion, joined = _of_runs(*together, cameras, of_run, run[-1] + 1)
    moved = _beside_each_other(motion, joined)[run] @ world_from_scan
    changed = after[trajectory.motions_differ(world_from_scan, moved, LEAST_M, LEAST_DEG)[after]]
    return (moved, changed) if len(changed) else (world_from_scan, changed)


def _of_runs(
    poses: Poses, group: np.ndarray, cameras: Poses, of_run: np.ndarray, runs: int
) -> tuple[np.ndarray, np.ndarray]:
    """The motion (R, 4, 4) of each run, from where its cameras (I, 4, 4) were to poses (I, 4, 4), and its group (R,)."""
    motion, joined = np.tile(np.eye(4), (runs, 1, 1)), -1 - np.arange(runs)
    known, first = np.unique(of_run, return_index=True)
    motion[known] = poses[first] @ geometry.inverse(cameras[first])
    joined[known] = group[first]
    return motion, joined


def _beside_each_other(motion: np.ndarray, joined: np.ndarray) -> np.ndarray:
    """(R, 4, 4): the same, all as the first run stays; groups are to those before as rough poses have them."""
    placed: dict[int, np.ndarray] = {}
    last, final = np.eye(4), np.empty_like(motion)
    for run, group in enumerate(joined):
        frame = placed.setdefault(int(group), last @ geometry.inverse(motion[run]))
        last = final[run] = frame @ motion[run]
    # to the last bit
    final[0] = np.eye(4)
    return final


def _of_images(dataset: Dataset, run: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Images (I,) taken between two scans of one run, or just beside one at a jump, and that run (I,)."""
    scans, images = dataset.scans.times, dataset.images.times
    before, fraction = trajectory.bracket(scans, images)
    nearest = run[before + (fraction > 0.5)]
    same = run[before] == run[before + 1]
    beside = np.minimum(fraction, 1.0 - fraction) < _BESIDE
    # two scans tell how the sensor moves
    long = np.bincount(run)[nearest] > 1
    numbers = np.flatnonzero((images >= scans[0]) & (images <= scans[-1]) & (same | beside) & long)
    return numbers, nearest[numbers]


def _cameras(
    dataset: Dataset, world_from_scan: Poses, run: np.ndarray, numbers: Indices, of_run: np.ndarray
) -> np.ndarray:
    """(I, 4, 4): cameras at some images (I,), each by the scans of its run alone."""
    times, poses = dataset.images.times[numbers], np.empty((len(numbers), 4, 4))
    for each in np.unique(of_run):
        mine, scans = of_run == each, run == each
        path = Trajectory(dataset.scans.times[scans], world_from_scan[scans])
        poses[mine] = trajectory.sample(path, times[mine])
        for end, last in ((0, slice(0, 2)), (-1, slice(-2, None))):
            past = times[mine] - path.times[end]
            past = np.minimum(past, 0.0) if end == 0 else np.maximum(past, 0.0)
            speed = geometry.log(geometry.steps(path.world_from_sensor[last]))[0] / np.diff(path.times[last])
            poses[mine] = geometry.retract(poses[mine], past[:, None] * speed)
    return np.asarray(poses @ geometry.inverse(dataset.camera_from_scan))
