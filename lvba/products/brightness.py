"""How bright images are beside each other, by what colored maps show of each in the colors of the others.

Before cameras are refined, exposures are not known yet, and what they differ by makes most of how badly a map predicts
an image: scans 1 mm off instead of 24 changed leave-one-out PSNR by -.33 +- .10 dB, and by +.12 +- .07 with exposures.
Ratios over many pixels forgive what poses are off.
"""

from collections.abc import Iterator, Sequence
from math import sqrt

import numpy as np

from lvba.kernels import zbuffer
from lvba.products import render
from lvba.products.render import OTHERS, ColoredCloud, RenderConfig
from lvba.products.views import Views
from lvba.visual import exposure
from lvba.visual.image import DARK
from lvba.visual.ratios import Ratios

_PIXELS = 4000
"""About so many of an image are compared, on a regular grid."""
_SIGMA = 0.1
"""Standard deviation of the log ratio of one pixel: texture that poses and splats misplace."""


def log_exposures(
    maps: Sequence[tuple[ColoredCloud, Views]], config: RenderConfig | None = None
) -> np.ndarray:
    """(I,) float64: natural logs of the relative exposures of all images, the first one's zero where it shows anything.

    maps: colored by the images themselves, one source for each point, with cameras as each map has them; the images are
        the same in all
    """
    images = len(maps[0][1])
    parts = [each for cloud, views in maps for each in _pixels(cloud, views, config)]
    together = [np.concatenate(each) for each in zip(*parts, strict=True)]
    source, image, value, level, position = together
    ratios = Ratios(
        first=source.astype(np.int32),
        second=image.astype(np.int32),
        value=value,
        sigma=np.full(len(value), _SIGMA),
        block=exposure.surface_blocks(position),
        stretch=exposure.surface_blocks(position, exposure.STRETCH_M),
        level=level,
        patch=np.arange(len(value)),
    )
    return exposure.solve_ratios(ratios, images).log_exposure


def _pixels(
    cloud: ColoredCloud, views: Views, config: RenderConfig | None
) -> Iterator[tuple[np.ndarray, ...]]:
    """Of each image (n,) source image, its own number, log ratio to the source, mean log grey value, and (n, 3) place, m,
    of pixels that other images colored."""
    step = max(round(sqrt(views.camera.width * views.camera.height / _PIXELS)), 1)
    for image in range(len(views)):
        entries = render.nearest(cloud, views, image, config)[OTHERS:, ::step, ::step]
        index = zbuffer.split(np.ascontiguousarray(entries))[1][0]
        own = views.load(image)[::step, ::step].mean(axis=2)
        other = np.where(index >= 0, cloud.gray[index].mean(axis=2), 0.0)
        used = (np.minimum(own, other) > DARK) & (np.maximum(own, other) < exposure.BRIGHT)
        own, other, index = np.log(own[used]), np.log(other[used]), index[used]
        yield (
            cloud.source[index],
            np.full(len(index), image),
            own - other,
            0.5 * (own + other),
            cloud.points_world[:, index].T,
        )
