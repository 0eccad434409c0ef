"""Features of images with places on the surfels of scans, before anything is known of planes of a map."""

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from lvba import geometry
from lvba.arrays import Indices, Pose, Poses
from lvba.camera import Camera
from lvba.dataset import Dataset
from lvba.io import dataset as recordings
from lvba.loop_closure.submap import Patch
from lvba.visual import image, relocalization
from lvba.visual.relocalization import Matcher

_CELLS = 16
"""Across the image: what is behind the nearest surfel of a cell is hidden ..."""
_BEHIND, _BEHIND_M = 1.3, 0.1
"""... where it is so many times as far away, and so many meters more."""
_LEAST_DEPTH_M = 0.2


def matcher(
    dataset: Dataset,
    patches: Sequence[Patch | None],
    world_from_scan: Poses,
    numbers: Indices,
    cameras: Poses,
    scans_of: Callable[[int], Indices],
) -> Matcher:
    """Of some images (I,), whose planes are the surfels of scans (S) about them, as cameras (I, 4, 4) see them.

    scans_of: the scans whose surfels an image, by its place among the images, may see
    """
    pinhole = image.measuring_camera(dataset.camera)
    small, undistort = relocalization.at_features_size(pinhole), image.Undistorter(dataset.camera, pinhole)
    size = small.width, small.height

    def look(index: int) -> np.ndarray:
        grey = cv2.cvtColor(recordings.load_image(dataset, int(numbers[index])), cv2.COLOR_RGB2GRAY)
        return cv2.resize(undistort(grey), size, interpolation=cv2.INTER_AREA)[..., None]

    def planes(index: int, pose: Pose) -> tuple[np.ndarray, np.ndarray]:
        camera_from_world = geometry.inverse(cameras[index])
        near = [
            patch.moved(camera_from_world @ world_from_scan[scan])
            for scan in scans_of(index)
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


def nearest_scans(dataset: Dataset, number: int, scans: Indices, count: int) -> np.ndarray:
    """(n,) int64: so many of some scans (m,) at most, the nearest in time to an image first."""
    off = np.abs(dataset.scans.times[scans] - dataset.images.times[number])
    return np.asarray(scans[np.argsort(off, kind="stable")[:count]])


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
