"""The images that color a map and judge it, with their poses and exposures."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from lvba.camera import Camera
from lvba.kernels.scene import Intrinsics
from lvba.visual import radiometry
from lvba.visual.response import LINEAR, Response


@dataclass(frozen=True)
class Views:
    """Undistorted images, loaded one at a time.

    load: gives image i as (H, W, 3) uint8 RGB, undistorted
    camera: their pinhole camera
    times: (I,) float64, s
    world_from_camera: (I, 4, 4) float64
    log_exposure: (I,) float64, natural log of the relative exposure time
    valid: (H, W) bool, pixels that hold a picture (undistortion leaves empty corners); None: all
    light: (H, W) float32, part of the light that arrives at each pixel (`visual.vignetting`); None: all, and grey
        values are in proportion to it
    curve: that grey values passed
    white_balance: (I, 3) float64, log of how much brighter red, green and blue of an image are than its exposure says;
        None: all are alike
    """

    load: Callable[[int], np.ndarray]
    camera: Camera
    times: np.ndarray
    world_from_camera: np.ndarray
    log_exposure: np.ndarray
    valid: np.ndarray | None = field(default=None)
    light: np.ndarray | None = field(default=None)
    curve: Response = field(default=LINEAR)
    white_balance: np.ndarray | None = field(default=None)

    def __len__(self) -> int:
        return len(self.times)

    def load_even(self, index: int) -> np.ndarray:
        """Light of image i as if all had arrived, and colors were balanced as in all others, (H, W, 3) uint8."""
        picture, light = self.load(index), self.light
        if self.white_balance is not None:
            full = np.ones(picture.shape[:2], np.float32) if light is None else light
            light = full[..., None] * np.exp(self.white_balance[index]).astype(np.float32)
        return picture if light is None else radiometry.divided(picture[None], light, self.curve)[0]

    @property
    def intrinsics(self) -> Intrinsics:
        """Of the camera, float32."""
        camera = self.camera
        return Intrinsics(*(np.float32(value) for value in (camera.fx, camera.fy, camera.cx, camera.cy)))

    @property
    def mask(self) -> np.ndarray:
        """(H, W) bool, pixels that hold a picture."""
        if self.valid is not None:
            return self.valid
        return np.ones((self.camera.height, self.camera.width), bool)

    @property
    def poses(self) -> np.ndarray:
        """world_from_camera (I, 4, 4) float32, as kernels take it."""
        return np.ascontiguousarray(self.world_from_camera, np.float32)
