"""How bright images are beside each other, by what colored maps show of each in the colors of the others.

Before cameras are refined, exposures are not known yet, and what they differ by makes most of how badly a map predicts
an image: scans 1 mm off instead of 24 changed leave-one-out PSNR by -.33 +- .10 dB, and by +.12 +- .07 with exposures.
Ratios over many pixels forgive what poses are off.
"""

from collections.abc import Iterable, Iterator, Sequence
from math import sqrt

import numpy as np

from lvba.arrays import Indices
from lvba.products import render
from lvba.products.render import OTHERS, ColoredCloud, RenderConfig
from lvba.products.views import Views
from lvba.visual import exposure
from lvba.visual.exposure_graph import robust_std
from lvba.visual.image import DARK
from lvba.visual.ratios import Ratios

_PIXELS = 4000
"""About so many of an image are compared, on a regular grid."""
_SIGMA = 0.1
"""Standard deviation of the log ratio of one pixel: texture that poses and splats misplace."""
_FEWEST_PIXELS = 100
"""That an exposure is told by."""
_FEWEST_KNOWN = 5
"""Known exposures that tell how good others are."""
_NEARLY_ALL = 0.9
"""Part of the images with known exposures whose pixels agree no less than is usual."""


def log_exposures(
    maps: Sequence[tuple[ColoredCloud, Views]], config: RenderConfig | None = None
) -> np.ndarray:
    """(I,) float64: natural logs of the relative exposures of all images, the first one's zero where it shows anything.

    maps: colored by the images themselves, one source for each point, with cameras as each map has them; the images are
        the same in all
    """
    images = len(maps[0][1])
    parts = [each for cloud, views in maps for each in _pixels(cloud, views, range(images), config)]
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


def of_others(
    cloud: ColoredCloud, views: Views, images: Indices, known: Indices, config: RenderConfig | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Natural logs of the relative exposures of images that colored nothing, NaN where too little tells, and their
    standard deviations, inf where nobody knows, both (J,) float64.

    They are as good as those of images that are known, found likewise; and no better than pixels of an image agree, where
    these agree less than in nearly all of the known ones: people may stand before it.
    cloud: colored by images of known exposures, one source for each point; images: (J,) int32
    known: (K,) int32, of those that colored it
    """
    by_pixels, scatter = _medians(cloud, views, images, config)
    of_known, usual = _medians(cloud, views, known, config)
    off = of_known - views.log_exposure[known]
    seen = np.isfinite(off)
    if np.count_nonzero(seen) < _FEWEST_KNOWN:
        return by_pixels, np.full(len(by_pixels), np.inf)
    more = np.maximum(scatter**2 - np.quantile(usual[seen], _NEARLY_ALL) ** 2, 0.0)
    sigma = np.sqrt(robust_std(off[seen]) ** 2 + more)
    return by_pixels, np.where(np.isfinite(by_pixels), sigma, np.inf)


def _medians(
    cloud: ColoredCloud, views: Views, images: Indices, config: RenderConfig | None
) -> tuple[np.ndarray, np.ndarray]:
    """(J,) float64: log exposures of images by the median of their pixels, and how far pixels are apart; NaN where there
    are few."""
    rows = np.full((len(images), 2), np.nan)
    for row, (source, _, value, _, _) in enumerate(_pixels(cloud, views, images, config)):
        ratio = value + views.log_exposure[source]
        if len(ratio) >= _FEWEST_PIXELS:
            rows[row] = np.median(ratio), robust_std(ratio - np.median(ratio))
    return rows[:, 0], rows[:, 1]


def _pixels(
    cloud: ColoredCloud, views: Views, images: Iterable[int], config: RenderConfig | None
) -> Iterator[tuple[np.ndarray, ...]]:
    """Of each of some images (n,) source image, its own number, log ratio of light to the source, mean log of both, and
    (n, 3) place, m, of pixels that other images colored."""
    step = max(round(sqrt(views.camera.width * views.camera.height / _PIXELS)), 1)
    even = cloud.gray if cloud.even is None else cloud.even
    for image in map(int, images):
        index = render.points(render.nearest(cloud, views, image, config)[OTHERS, ::step, ::step])
        covered = index >= 0
        index, own = index[covered], views.load(image)[::step, ::step][covered]
        lowest, highest = (pick(own, cloud.gray[index]).mean(axis=1) for pick in (np.minimum, np.maximum))
        used = (lowest > DARK) & (highest < exposure.BRIGHT)
        index = index[used]
        lights = views.load_even(image)[::step, ::step][covered][used], even[index]
        logs = [np.log(np.maximum(each.mean(axis=1, dtype=np.float64), 1.0)) for each in lights]
        yield (
            cloud.source[index],
            np.full(len(logs[0]), image),
            logs[0] - logs[1],
            0.5 * (logs[0] + logs[1]),
            cloud.points_world[:, index].T,
        )
