"""The size of the images that judge and color a map: that of a pyramid level, where images are larger than that needs.

In an image of 5 megapixels, points of a scan of 200,000 are 12 px apart on average (2 px along a line of a spinning
LiDAR). What its finest pixels show between them no figure of a rendering tells; they cost four times as much as those of
half the size. Poses are measured in the full images all the same.
"""

import cv2
import numpy as np

from lvba.arrays import Picture
from lvba.camera import Camera

MOST_PIXELS = 1_500_000
"""Images of more are halved until they have no more."""


def level(camera: Camera) -> int:
    """Pyramid level whose images judge; 0: the full ones."""
    number = 0
    while _pixels(camera.at_level(number)) > MOST_PIXELS:
        number += 1
    return number


def judging(camera: Camera) -> Camera:
    """The camera, with its lens, of the images that judge."""
    return camera.at_level(level(camera))


def reduced(photo: Picture, camera: Camera) -> np.ndarray:
    """An image as those that judge are, (h, w, 3) uint8: means of blocks of pixels; itself where it judges.

    photo: (H, W, 3) uint8; camera: of it
    """
    edge, small = 1 << level(camera), judging(camera)
    if edge == 1:
        return photo
    blocks = photo[: edge * small.height, : edge * small.width]
    return np.asarray(cv2.resize(blocks, (small.width, small.height), interpolation=cv2.INTER_AREA))


def _pixels(camera: Camera) -> int:
    return camera.width * camera.height
