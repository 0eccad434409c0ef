"""The images of a recording as the stages want them, kept from one stage to the next so that each is decoded once."""

import dataclasses
import weakref
from typing import Any

import numpy as np

from lvba.dataset import Dataset
from lvba.io import dataset as recordings
from lvba.products.views import Views
from lvba.progress import Progress, silent
from lvba.visual import image
from lvba.visual.image import ImageConfig, Pyramid

_KEPT: dict[int, dict[str, Any]] = {}


def _kept(dataset: Dataset) -> dict[str, Any]:
    """What is in memory about a recording, until it goes or another one (or part) is looked at."""
    key = id(dataset)
    if key not in _KEPT:
        _KEPT.clear()
        _KEPT[key] = {}
        weakref.finalize(dataset, _KEPT.pop, key, None)
    return _KEPT[key]


class Undistorted:
    """Undistorted images by index; the first ones that fit are kept in memory, the rest read again each time."""

    def __init__(self, dataset: Dataset, kept_bytes: int = 1 << 28) -> None:
        # a copy: what is kept for a recording must not keep the recording
        self._dataset = dataclasses.replace(dataset)
        self._undistort = image.Undistorter(dataset.camera)
        size = max(1, dataset.camera.width * dataset.camera.height * 3)
        self._capacity = kept_bytes // size
        self._kept: dict[int, np.ndarray] = {}

    def __call__(self, index: int) -> np.ndarray:
        """(H, W, 3) uint8 RGB."""
        if index in self._kept:
            return self._kept[index]
        return self._keep(index, recordings.load_image(self._dataset, index))

    def raw(self, index: int) -> np.ndarray:
        """The image as it is in its file, (H, W, 3) uint8 RGB; while it is at hand, it is undistorted as well."""
        picture = recordings.load_image(self._dataset, index)
        if index not in self._kept and len(self._kept) < self._capacity:
            self._keep(index, picture)
        return picture

    def _keep(self, index: int, raw: np.ndarray) -> np.ndarray:
        picture = np.ascontiguousarray(self._undistort(raw))
        if len(self._kept) < self._capacity:
            self._kept[index] = picture
        return picture


def undistorted(dataset: Dataset) -> Undistorted:
    """The undistorted images of a recording, the same ones for all stages."""
    kept = _kept(dataset)
    if "undistorted" not in kept:
        kept["undistorted"] = Undistorted(dataset)
    return kept["undistorted"]


def views_of(dataset: Dataset) -> Views:
    """The undistorted images at their rough poses, all equally exposed."""
    camera = dataset.camera
    return Views(
        load=undistorted(dataset),
        camera=camera.undistorted(),
        times=dataset.images.times,
        world_from_camera=dataset.images.world_from_sensor,
        log_exposure=np.zeros(len(dataset.image_paths)),
        valid=image.undistort(np.full((camera.height, camera.width, 3), 255, np.uint8), camera)[..., 0] > 0,
    )


def pyramid(
    dataset: Dataset,
    chosen: np.ndarray,
    levels: int,
    config: ImageConfig,
    progress: Progress = silent,
    *,
    keep: bool = False,
) -> Pyramid:
    """The pyramid of the chosen images (K,). keep: it stays in memory until it is asked for without `keep`."""
    kept, key = _kept(dataset), (levels, config, chosen.tobytes())
    known, found = kept.pop("pyramid", (None, None))
    if found is None or known != key:
        load = undistorted(dataset).raw
        found = image.load_images(
            lambda index: load(int(chosen[index])),
            len(chosen),
            dataset.camera,
            levels,
            config,
            progress,
        )
    if keep:
        kept["pyramid"] = key, found
    return found
