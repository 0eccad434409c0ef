"""The images of a recording as evaluation and products see them: without distortion."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from lvba.camera import Camera
from lvba.dataset import Dataset
from lvba.io import calibration
from lvba.io import dataset as recordings
from lvba.products import judging_size
from lvba.products.views import Views
from lvba.visual import image, radiometry, response, vignetting
from lvba.visual.radiometry import Radiometry


class Undistorted:
    """Undistorted images by index; the first ones that fit are kept in memory, the rest read again each time.

    full: as large as they were taken; else at the size at which they judge
    turns: (I, 3) float64, rad, of the cameras while the rows of each image are read; None: they are read at once
    """

    def __init__(
        self,
        dataset: Dataset,
        kept_bytes: int = 1 << 28,
        *,
        full: bool = True,
        turns: np.ndarray | None = None,
    ) -> None:
        self._dataset, self._full, self._turns = dataset, full, turns
        camera = dataset.camera if full else judging_size.judging(dataset.camera)
        self._undistort = image.Undistorter(camera)
        size = max(1, camera.width * camera.height * 3)
        self._capacity = kept_bytes // size
        self._kept: dict[int, np.ndarray] = {}

    def __call__(self, index: int) -> np.ndarray:
        """(H, W, 3) uint8 RGB."""
        if index in self._kept:
            return self._kept[index]
        return self._keep(index, recordings.load_image(self._dataset, index))

    def _keep(self, index: int, raw: np.ndarray) -> np.ndarray:
        raw = raw if self._full else judging_size.reduced(raw, self._dataset.camera)
        turn = None if self._turns is None else self._turns[index]
        picture = np.ascontiguousarray(self._undistort(raw, turn))
        if len(self._kept) < self._capacity:
            self._kept[index] = picture
        return picture


def light_in(supposed: Radiometry, camera: Camera) -> np.ndarray | None:
    """(H, W) float32: the light at each pixel of the undistorted images; None: all. camera: of the raw images"""
    return vignetting.light_of_pixels(supposed.vignetting, camera, camera.undistorted()) if supposed else None


def radiometry_of(result: str | Path) -> Radiometry:
    """What a result's calibration.yaml has of vignetting and response. Raises InputError: it is damaged."""
    slopes = calibration.read_slopes(result, response.SLOPES)
    curve = response.LINEAR if slopes is None else response.of_numbers(slopes - 1)
    return Radiometry(vignetting.of_numbers(calibration.read_vignetting(result)), curve)


def views_of(
    dataset: Dataset,
    load: Callable[[int], np.ndarray] | None = None,
    supposed: Radiometry = radiometry.NONE,
    *,
    full: bool = False,
) -> Views:
    """The undistorted images at their rough poses, all equally exposed, by the camera that the dataset has.

    load: gives image i as (H, W, 3) uint8 RGB, undistorted; None: from the files; supposed: their radiometry
    full: as large as they were taken; else at the size at which they judge (`judging_size`)
    """
    camera = dataset.camera if full else judging_size.judging(dataset.camera)
    return Views(
        load=load or Undistorted(dataset, full=full),
        camera=camera.undistorted(),
        times=dataset.images.times,
        world_from_camera=dataset.images.world_from_sensor,
        log_exposure=np.zeros(len(dataset.image_paths)),
        valid=image.undistort(np.full((camera.height, camera.width, 3), 255, np.uint8), camera)[..., 0] > 0,
        light=light_in(supposed, camera),
        curve=supposed.response,
    )
