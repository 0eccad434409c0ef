"""Images as the visual part wants them: undistorted, as a pyramid of contiguous arrays, with their noise."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np

from lvba import lens
from lvba.arrays import Images, Picture
from lvba.camera import Camera
from lvba.kernels import moving_rows
from lvba.kernels.noise import block_residuals
from lvba.kernels.patches_pyramid import halve
from lvba.kernels.scene import Intrinsics
from lvba.lens import Lens, widest_angle
from lvba.parallel import in_order
from lvba.progress import Progress, silent
from lvba.settings import Group, setting

SATURATED = 250
"""Grey value (of 255) from which a pixel counts as clipped."""
DARK = 3
"""Grey values up to this count as no image, wherever images are read: undistorted images are 0 where there is none, and
resampling leaves a rim."""
_WIDER = 0.95
"""Focal length of undistorted images over that of the raw ones."""
_FARTHEST_DEG = 65.0
"""How far off the axis images of a fisheye are used: there, ten pixels of a pinhole show what a raw one does."""
_NOISE_BLOCK = 16
_NOISE_QUANTILE = 0.05
_NOISE_BIAS = 0.866
"""What the 5 % quantile of the block estimates below is for white noise of sigma 1 (8 bit images, simulated)."""
_HALVED_NOISE = 0.65
"""Part of the noise that a 2x2 mean leaves at most: 0.5 for white noise, more after resampling."""
_MIN_NOISE = 0.29
"""Standard deviation of rounding to whole grey values."""


def intrinsics_of(camera: Camera) -> Intrinsics:
    """The camera as kernels take it."""
    return Intrinsics(float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy))


@dataclass(frozen=True)
class ImageConfig(Group):
    """How images are loaded."""

    channels: Literal[1, 3] = setting(
        1,
        meaning="1: grey; 3: RGB, which takes three times the memory and time and gained no accuracy where measured.",
        choices=(1, 3),
        change_when="Neighboring surfaces differ in hue but not in brightness.",
        advanced=True,
    )


@dataclass(frozen=True)
class Pyramid:
    """All images at every level, undistorted.

    levels: per level (I, H, W, C) uint8, C-contiguous. 0 marks pixels without image, values from SATURATED on clipped
        ones (a coarse pixel that covers a clipped one is 255)
    camera: of level 0, without distortion; `camera.at_level(k)` belongs to `levels[k]`
    noise: (levels,) float64, grey values: standard deviation of the sensor's noise at each level
    """

    levels: tuple[np.ndarray, ...]
    camera: Camera
    noise: np.ndarray

    def __len__(self) -> int:
        return len(self.levels)


@dataclass(frozen=True)
class LevelImages:
    """The images of one pyramid level.

    images: (I, H, W, C) uint8 or float32, undistorted; camera: of this level
    noise: grey values, standard deviation of the sensor's noise at this level
    """

    images: np.ndarray
    camera: Camera
    noise: float


def usable_levels(camera: Camera, wanted: int, min_width: int = 80) -> int:
    """How many pyramid levels to use: `wanted`, fewer where the coarsest would be narrower than `min_width` px.

    None is so low that it holds no block to read its noise off.
    """
    levels = 1
    while levels < wanted:
        coarser = camera.at_level(levels)
        if coarser.width < min_width or min(coarser.width, coarser.height) < _NOISE_BLOCK + 2:
            break
        levels += 1
    return levels


def memory_bytes(count: int, camera: Camera, levels: int, channels: int = 1) -> int:
    """Bytes that the pyramid of `count` images takes."""
    sizes = [camera.at_level(level) for level in range(levels)]
    per_image = sum(c.width * c.height for c in sizes)
    return count * channels * per_image


_NO_MAP = np.empty(0, np.uint16)
"""Parts of pixels for `cv2.remap`: none."""


class Undistorter:
    """Resamples images of one camera to a pinhole camera; zero where there is no image.

    pinhole: of any size; None: `camera.undistorted()`
    """

    def __init__(self, camera: Camera, pinhole: Camera | None = None) -> None:
        self.camera, self._pinhole = camera, pinhole or camera
        self.identity = camera.is_pinhole
        self._maps: tuple[np.ndarray, np.ndarray] | None = None
        self._empty: np.ndarray | None = None
        if self.identity:
            return
        self._maps = _maps(camera, self._pinhole)
        self._upper_left = _upper_left(*self._maps)
        # beyond its widest angle the model folds back into the picture
        folded = _angles(self._pinhole) >= widest_angle(camera.lens, camera.distortion)
        self._empty = _outside(*self._maps, camera) | folded

    def __call__(self, image: np.ndarray, turn: np.ndarray | None = None) -> np.ndarray:
        """The undistorted (H, W) or (H, W, C) uint8 image.

        turn: (3,) float64, rad, by which the camera turned about its own axes from the first row of the image to the
            last: as if all rows had been read with the middle one; None: they were. What the middle row's camera would
            see beyond the rim of the image has the color of the rim
        """
        if turn is not None and not turn.any():
            turn = None
        if self.identity and turn is None:
            return image
        maps = self._whole_maps() if turn is None else self._turned(turn)
        resampled = cv2.remap(image, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        clipped = cv2.threshold(image, SATURATED - 1, 255, cv2.THRESH_BINARY)[1]
        if clipped.any():
            # a mixture of clipped and good pixels is no measurement either: any of the 4 x 4 that are mixed
            wide = cv2.dilate(clipped, np.ones((4, 4), np.uint8), anchor=(1, 1))
            corner = self._upper_left if turn is None else _upper_left(*maps)
            cv2.max(resampled, cv2.remap(wide, corner, _NO_MAP, cv2.INTER_NEAREST), resampled)
        if self._empty is not None:
            resampled[self._empty] = 0
        return resampled

    def empty(self, turn: np.ndarray | None = None) -> np.ndarray:
        """(H, W) bool: which pixels of the undistorted image the camera did not see.

        turn: (3,) float64, rad, as for the image
        """
        nowhere = (
            np.zeros((self._pinhole.height, self._pinhole.width), bool)
            if self._empty is None
            else self._empty
        )
        if turn is None or not turn.any():
            return nowhere
        return np.asarray(nowhere | _outside(*self._turned(turn), self.camera))

    def _whole_maps(self) -> tuple[np.ndarray, np.ndarray]:
        """As `_maps`, of an image that was taken at once."""
        if self._maps is None:
            self._maps = _maps(self.camera, self._pinhole)
        return self._maps

    def _turned(self, turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As `_maps`, of an image during which the camera turned."""
        maps = self._whole_maps()
        across, down = (np.empty_like(each) for each in maps)
        moving_rows.turned_back(
            *maps,
            intrinsics_of(self._pinhole),
            np.ascontiguousarray(turn, float),
            self.camera.height,
            across,
            down,
        )
        return across, down


def _maps(camera: Camera, pinhole: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Where in an image the pixels of its undistorted one are, across and down, each (H, W) float32, px."""
    size, coefficients = (pinhole.width, pinhole.height), np.array(camera.distortion)
    if camera.lens is Lens.EQUIDISTANT:
        maps = cv2.fisheye.initUndistortRectifyMap(
            camera.matrix, coefficients, np.eye(3), pinhole.matrix, size, cv2.CV_32FC1
        )
    else:
        maps = cv2.initUndistortRectifyMap(
            camera.matrix, coefficients, None, pinhole.matrix, size, cv2.CV_32FC1
        )
    return maps[0], maps[1]


def _upper_left(across: np.ndarray, down: np.ndarray) -> np.ndarray:
    """(H, W, 2) int16: the whole pixels up and left of places (H, W), px; those far outside are empty anyway."""
    corner = np.floor(np.nan_to_num(np.stack([across, down], axis=-1)))
    return np.asarray(np.clip(corner, -1, np.iinfo(np.int16).max), np.int16)


def _outside(across: np.ndarray, down: np.ndarray, camera: Camera) -> np.ndarray:
    """(H, W) bool: which places (H, W), px, are in no image of the camera."""
    inside = (across >= 0) & (across <= camera.width - 1) & (down >= 0) & (down <= camera.height - 1)
    return np.asarray(~inside)


def _angles(pinhole: Camera) -> np.ndarray:
    """(H, W) float32: radians off the axis of the pixels of a pinhole."""
    x = (np.arange(pinhole.width, dtype=np.float32) - np.float32(pinhole.cx)) / np.float32(pinhole.fx)
    y = (np.arange(pinhole.height, dtype=np.float32) - np.float32(pinhole.cy)) / np.float32(pinhole.fy)
    return np.asarray(np.arctan(np.hypot(x[None, :], y[:, None])))


def measuring_camera(camera: Camera) -> Camera:
    """The pinhole camera whose images the poses are measured in: of a slightly wider view where there is distortion, and
    of a larger picture where the lens is a fisheye.

    Resampling does not put details near the limit of resolution quite where they belong: it draws them to the pixels of
    the raw image. With the same focal length the nearest one lies to the same side over large parts of the picture, in
    all images: rings that seem too wide or too narrow, and set the cameras some millimeters too far forward. With another
    focal length it lies to every side within a few patches, and the errors cancel.
    """
    pinhole = camera.undistorted()
    if camera.is_pinhole:
        return pinhole
    wider = replace(pinhole, fx=_WIDER * pinhole.fx, fy=_WIDER * pinhole.fy)
    return _with_borders(wider, camera) if camera.lens is Lens.EQUIDISTANT else wider


def _with_borders(pinhole: Camera, fisheye: Camera) -> Camera:
    """The pinhole larger on all sides, up to the rim of its fisheye's images or `_FARTHEST_DEG` off the axis.

    A fisheye is there for what it sees to the sides; but towards 90 degrees a pinhole's pixels show ever less of it.
    """
    right, bottom = fisheye.width - 1, fisheye.height - 1
    rim = np.array([[0, fisheye.cy], [right, fisheye.cy], [fisheye.cx, 0], [fisheye.cx, bottom]])
    x, y = lens.undistort(fisheye.lens, fisheye.distortion, *fisheye.normalized(rim))
    seen = np.minimum(np.hypot(x, y), np.tan(np.radians(_FARTHEST_DEG)))
    seen_px = seen * [pinhole.fx, pinhole.fx, pinhole.fy, pinhole.fy]
    inside_px = [pinhole.cx, right - pinhole.cx, pinhole.cy, bottom - pinhole.cy]
    west, east, north, south = (int(border) for border in np.maximum(seen_px - inside_px, 0))
    return replace(
        pinhole,
        width=pinhole.width + west + east,
        height=pinhole.height + north + south,
        cx=pinhole.cx + west,
        cy=pinhole.cy + north,
    )


def undistort(rgb: np.ndarray, camera: Camera) -> np.ndarray:
    """The (H, W, C) uint8 image that the pinhole camera `camera.undistorted()` would have taken; 0 outside.

    rgb: (H, W, C) uint8
    """
    return Undistorter(camera)(rgb)


def grey(rgb: Picture) -> np.ndarray:
    """Linear luma (0.299, 0.587, 0.114) of an (H, W, 3) uint8 image, (H, W) uint8; 255 where any channel is clipped."""
    luma = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    luma[cv2.inRange(rgb, (0, 0, 0), (SATURATED - 1,) * 3) == 0] = 255
    return luma


def load_images(
    read: Callable[[int], np.ndarray],
    count: int,
    camera: Camera,
    levels: int,
    config: ImageConfig = ImageConfig(),
    progress: Progress = silent,
) -> Pyramid:
    """The pyramid of `count` images with `levels` levels, read a few at a time.

    read: gives the raw (H, W, 3) uint8 RGB image of an index; called from several threads
    camera: of the raw images, with distortion
    """
    full = load_undistorted(read, count, camera, config, progress)
    return build_pyramid(full, measuring_camera(camera), levels)


def load_undistorted(
    read: Callable[[int], np.ndarray],
    count: int,
    camera: Camera,
    config: ImageConfig = ImageConfig(),
    progress: Progress = silent,
) -> np.ndarray:
    """What level 0 of the pyramid is made of, (I, H, W, C) uint8, as `measuring_camera` sees it.

    read, camera: see `load_images`
    """
    pinhole = measuring_camera(camera)
    full = np.empty((count, pinhole.height, pinhole.width, config.channels), np.uint8)
    undistorter = Undistorter(camera, pinhole)

    def load(index: int) -> None:
        raw = read(index)
        plain = grey(raw) if config.channels == 1 else raw
        full[index] = undistorter(plain).reshape(full.shape[1:])

    for done, _ in enumerate(in_order(load, range(count))):
        progress("images", done + 1, count)
    return full


def build_pyramid(full: Images, camera: Camera, levels: int) -> Pyramid:
    """The pyramid over undistorted images (I, H, W, C) uint8 of a pinhole camera."""
    arrays = [full]
    for _ in range(1, levels):
        arrays.append(halve(arrays[-1], SATURATED))
    noise = [sensor_noise(array) for array in arrays]
    for level in range(1, levels):
        # coarse images hold texture in every block: halving leaves at most this much of the finer level's noise
        noise[level] = min(noise[level], float(np.hypot(_HALVED_NOISE * noise[level - 1], _MIN_NOISE)))
    return Pyramid(tuple(arrays), camera, np.array(noise))


def sensor_noise(images: Images, samples: int = 24) -> float:
    """Standard deviation of white noise in (I, H, W, C) uint8 images, grey values, from the calmest parts of some.

    The residual is the second difference in both directions (Immerkaer 1996), blind to edges along rows and columns;
    each block of 16 x 16 gives a mean absolute residual, and a low quantile over blocks leaves texture out.
    """
    chosen = images[np.unique(np.linspace(0, len(images) - 1, min(samples, len(images))).astype(int))]
    blocks = np.concatenate([_block_noise(image) for image in chosen])
    if len(blocks) == 0:
        return _MIN_NOISE
    return max(float(np.quantile(blocks, _NOISE_QUANTILE)) / _NOISE_BIAS, _MIN_NOISE)


def _block_noise(image: Picture) -> np.ndarray:
    """Noise estimate of every block without masked pixels, (B,), of one (H, W, C) uint8 image, channel by channel."""
    channels = (np.ascontiguousarray(image[..., channel]) for channel in range(image.shape[-1]))
    residuals = [block_residuals(channel, _NOISE_BLOCK, SATURATED) for channel in channels]
    return np.asarray(np.concatenate(residuals) / (6 * np.sqrt(2 / np.pi)))
