"""How a camera's white balance changes from image to image: relative exposures found for each color by itself.

A camera that balances its colors anew for each image changes the grey value of a red wall otherwise than that of a blue
one. One exposure per image, from grey values, then depends on what the image shows. By color there is one number for each
image again, found as exposures of grey images are. The relative exposure is the mean of their logarithms; what each color
is off that is the white balance.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lvba.arrays import Images
from lvba.camera import Camera
from lvba.lidar.plane import Surfaces
from lvba.trajectory import Trajectory
from lvba.visual import exposure
from lvba.visual.image import DARK, SATURATED, Pyramid, build_pyramid
from lvba.visual.radiometry import Radiometry
from lvba.visual.response import Response
from lvba.visual.scene_points import ScenePoints, take
from lvba.visual.visibility import DepthBuffers, VisibilityMap

SmallerColors = tuple[Callable[[int], Images], Camera]
"""Red (0), green or blue of all undistorted images, (I, h, w, 1) uint8, and the camera of these."""

COLORS = 3
_LUMA = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in a grey value."""
_SIGMAS = 3.0
_LEAST = 0.005
"""Root mean square change of a color below which nobody sees it: there exposures of grey values are as good."""
_FEW = 4
"""One patch in so many is asked first. Where they say that the white balance changes by less than half of what anybody
sees, the others are not asked: chance makes changes seem larger, not smaller."""
_SAME = 4
"""Images that are asked whether they have colors at all."""


@dataclass(frozen=True)
class WhiteBalance:
    """log_exposure: (I,) float64, mean over the colors, 0 on average; sigma: (I,) float64, of it
    log_gain: (I, 3) float64, by how much red, green and blue of an image are brighter than that; each 0 on average
    """

    log_exposure: np.ndarray
    sigma: np.ndarray
    log_gain: np.ndarray


def solve(
    colors: Callable[[int], Images],
    camera: Camera,
    cameras: Trajectory,
    surfaces: Surfaces,
    seen: VisibilityMap | None,
    light: Radiometry,
    raw: Camera | None,
    depth: DepthBuffers | None = None,
    points: ScenePoints | None = None,
    smaller: SmallerColors | None = None,
) -> WhiteBalance | None:
    """The white balance of all images; None where it does not change, or where images have no color.

    colors: red (0), green or blue of all undistorted images, (I, H, W, 1) uint8; camera: of these; raw: before they were
    undistorted; light: radiometry of the images; other arguments as of `exposure.ratios_at`
    smaller: the same images, by which few patches are asked first; None: they are asked in the full ones
    """

    def by_color(
        one_in: int, colors: Callable[[int], Images], camera: Camera, points: ScenePoints | None
    ) -> tuple[np.ndarray, np.ndarray] | None:
        log_exposure, sigma = np.empty((len(cameras), COLORS)), np.empty((len(cameras), COLORS))
        first: np.ndarray | None = None
        for color in range(COLORS):
            images = colors(color)
            if first is not None and np.array_equal(images[:_SAME], first):
                return None
            first = images[:_SAME].copy()
            levels = exposure.completed([light.taken_out_of(images, raw, camera)])
            pyramid = Pyramid(tuple(levels), camera, np.zeros(len(levels)))
            if points is None:
                points = exposure.placed(pyramid, cameras, surfaces)
            some = take(points, np.arange(0, len(points), one_in))
            solved = exposure.solve(pyramid, cameras, surfaces, seen, depth=depth, points=some, refined=True)
            log_exposure[:, color], sigma[:, color] = solved.log_exposure, solved.sigma
        return log_exposure, sigma

    few = by_color(_FEW, *((colors, camera, points) if smaller is None else (*smaller, None)))
    if few is None or _stays(*few):
        return None
    every = by_color(1, colors, camera, points)
    return None if every is None else judged(*every)


def taken_out_of(
    pyramid: Pyramid, colors: Callable[[int], Images], balance: WhiteBalance, curve: Response
) -> Pyramid:
    """The images as a camera whose white balance stays would have taken them; clipped and dark pixels stay as they are.

    colors: red (0), green or blue of the images of the pyramid, (I, H, W, 1) uint8; curve: the response of the camera
    """
    channels = [colors(color) for color in range(COLORS)]
    before = pyramid.levels[0]
    full = np.empty_like(before)
    grey_values = np.arange(256, dtype=np.float32)
    for index, gains in enumerate(np.exp(balance.log_gain)):
        corrected = [
            curve.grey(curve.light(grey_values) / np.float32(gain))[channel[index]]
            for channel, gain in zip(channels, gains, strict=True)
        ]
        if before.shape[-1] == 1:
            corrected = [sum(weight * each for weight, each in zip(_LUMA, corrected, strict=True))]
        rounded = np.rint(np.concatenate(corrected, axis=-1)).astype(np.uint8)
        clipped = (before[index] >= SATURATED) | (rounded >= SATURATED)
        full[index] = np.where(before[index] <= DARK, before[index], np.where(clipped, 255, rounded))
    return build_pyramid(full, pyramid.camera, len(pyramid))


def judged(log_exposure: np.ndarray, sigma: np.ndarray) -> WhiteBalance | None:
    """The white balance from the exposures by color; None where its changes may be chance, or cannot be seen.

    log_exposure, sigma: (I, 3) float64, as solved for each color, and their standard deviations
    """
    known = np.isfinite(sigma).all(axis=1)
    if np.count_nonzero(known) < COLORS:
        return None
    common, gain = _apart(log_exposure, known)
    size, chance = _size(gain, known), _size(sigma, known)
    if size <= max(_LEAST, _SIGMAS * chance):
        return None
    return WhiteBalance(common, np.sqrt(np.square(sigma).mean(axis=1)), gain)


def _stays(log_exposure: np.ndarray, sigma: np.ndarray) -> bool:
    """Whether exposures by color, from few patches, say that the white balance stays. Arguments as of `judged`."""
    known = np.isfinite(sigma).all(axis=1)
    return bool(known.all()) and _size(_apart(log_exposure, known)[1], known) <= _LEAST / 2


def _apart(log_exposure: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What is common to the colors of each image (I,), and what each color is off that (I, 3); 0 on average, and for the
    images that are not known, of which each color says only how they compare among themselves."""
    about = log_exposure - log_exposure[known].mean(axis=0)
    if not known.all():
        rest = about[~known]
        about[~known] = rest - rest.mean(axis=0) + rest.mean()
    common = about.mean(axis=1)
    return common, about - common[:, None]


def _size(values: np.ndarray, known: np.ndarray) -> float:
    """Root mean square of the values of known images."""
    return float(np.sqrt(np.square(values[known]).mean()))
