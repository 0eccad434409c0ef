"""Jumps of rough scan poses that surfaces do not tell of: mended by features of the images on both sides.

A depth camera or a narrow LiDAR sees one wall before a jump and another one after it; images of some other moment may
have seen both. Between jumps, poses are as good as an odometry's: a few scans show on which planes features are.
"""

from collections.abc import Sequence

import cv2
import numpy as np

from lvba import geometry, trajectory
from lvba.arrays import Indices, Pose, Poses
from lvba.camera import Camera
from lvba.dataset import Dataset
from lvba.io import dataset as recordings
from lvba.loop_closure.submap import Patch
from lvba.trajectory import Trajectory
from lvba.visual import image, image_groups, relocalization
from lvba.visual.relocalization import Matcher

_SCANS = 6
"""Scans of the same run, the nearest in time, whose surfels an image may see."""
_CELLS = 16
"""Across the image: what is behind the nearest surfel of a cell is hidden ..."""
_BEHIND, _BEHIND_M = 1.3, 0.1
"""... where it is so many times as far away, and so many meters more."""
_LEAST_DEPTH_M = 0.2
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
    together = image_groups.put_together(
        _matcher(dataset, patches, world_from_scan, run, numbers, of_run, cameras), cameras, of_run
    )
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


def _matcher(
    dataset: Dataset,
    patches: Sequence[Patch | None],
    world_from_scan: Poses,
    run: np.ndarray,
    numbers: Indices,
    of_run: np.ndarray,
    cameras: Poses,
) -> Matcher:
    """Of some images (I,), whose planes are the surfels of scans (S) of the same run, as cameras (I, 4, 4) see them."""
    pinhole = image.measuring_camera(dataset.camera)
    small, undistort = relocalization.at_features_size(pinhole), image.Undistorter(dataset.camera, pinhole)
    size = small.width, small.height

    def look(index: int) -> np.ndarray:
        grey = cv2.cvtColor(recordings.load_image(dataset, int(numbers[index])), cv2.COLOR_RGB2GRAY)
        return cv2.resize(undistort(grey), size, interpolation=cv2.INTER_AREA)[..., None]

    def planes(index: int, pose: Pose) -> tuple[np.ndarray, np.ndarray]:
        scans = np.flatnonzero(run == of_run[index])
        off = np.abs(dataset.scans.times[scans] - dataset.images.times[numbers[index]])
        camera_from_world = geometry.inverse(cameras[index])
        near = [
            patch.moved(camera_from_world @ world_from_scan[scan])
            for scan in scans[np.argsort(off, kind="stable")[:_SCANS]]
            if (patch := patches[scan]) is not None
        ]
        if not near:
            return np.zeros((0, 3)), np.zeros((0, 3))
        center, normal = (
            np.concatenate([getattr(each, name) for each in near]) for name in ("center", "normal")
        )
        seen = _seen(center, small)
        return geometry.transform_points(pose, center[seen]), normal[seen] @ pose[:3, :3].T

    return Matcher(planes, small, look)


def _seen(center: np.ndarray, camera: Camera) -> np.ndarray:
    """Which surfels (N, 3), m, camera frame, are in the image and behind no other, (n,) int64."""
    front = np.flatnonzero(center[:, 2] > _LEAST_DEPTH_M)
    pixel = center[front, :2] / center[front, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    inside = ((pixel > 0) & (pixel < [camera.width, camera.height])).all(axis=1)
    front, pixel = front[inside], pixel[inside]
    column, row = (pixel * _CELLS / camera.width).astype(np.int64).T
    cell, depth = row * _CELLS + column, center[front, 2]
    nearest = np.full(cell.max(initial=0) + 1, np.inf)
    np.minimum.at(nearest, cell, depth)
    return np.asarray(front[depth < _BEHIND * nearest[cell] + _BEHIND_M])
