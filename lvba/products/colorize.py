"""Colors for the points of a map: the paper's one-view protocol, and robust blending of several views.

Colors are radiances: gray values 0..255 divided by the image's relative exposure, so that all images agree.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise, starmap

import numpy as np

from lvba.arrays import Indices, LogExposures
from lvba.kernels import colorize as kernels
from lvba.kernels import occlusion
from lvba.parallel import in_order
from lvba.products.cloud import Blocks, Cloud, Origins, sort_into_blocks, surfaces
from lvba.products.views import Views
from lvba.progress import Progress, silent
from lvba.settings import Group, setting
from lvba.trajectory import nearest_in_time
from lvba.visual.image import DARK, SATURATED
from lvba.visual.response import LINEAR, Response

logger = logging.getLogger(__name__)

_WIDE = 3.0
"""Tolerance in standard deviations where there is no surface: these then are the extent of what is there, not noise."""


@dataclass(frozen=True)
class ColorizeConfig(Group):
    """How several views of a point are blended."""

    max_views: int = setting(
        8,
        meaning="Views blended per point, the best ones.",
        low=1,
        high=32,
        change_when="Colors are noisy (more), or details should stay as sharp as in one image (fewer).",
        advanced=True,
    )
    max_angle_deg: float = setting(
        80.0,
        meaning="No color from a view that is further than this off the normal of a point's surface.",
        unit="degrees",
        low=1,
        high=90,
        change_when="Surfaces seen at a slant only stay gray (larger), or are smeared (smaller).",
        advanced=True,
    )


TOLERANCE = 6.0
"""A point is hidden when it is more than this behind another surface, and that one as much before its own, in standard
deviations of points across the surface: two points of one surface are each within three of it."""
CELL_PX = 4
"""Cells of the occlusion z-buffer, px; larger closes gaps between points, and leaves out more near edges."""
BRIGHTEST = float(SATURATED)
"""Samples that touch a channel value of this or more are left out as saturated, those whose brightest channel is at most
DARK as black."""
_MOST_SAMPLES = 40_000_000
"""Samples that are collected at a time, of 11 bytes each. Beyond that points take turns, and images are read for each."""
NOISE = 2.0
"""Noise of a gray value (0..255): differences below it never count as outliers."""


@dataclass(frozen=True)
class PaperColors:
    """One color per point, from one image.

    gray: (M, 3) float32, gray values 0..255 in that image, 0 where uncolored
    source: (M,) int32, the image the color is from; -1: uncolored
    even: (M, 3) float32, the light of these gray values if all had arrived; None: it has
    """

    gray: np.ndarray
    source: np.ndarray
    even: np.ndarray | None = None

    def radiance(self, log_exposure: LogExposures) -> np.ndarray:
        """(M, 3) float32: gray values over the relative exposure of their image."""
        gain = np.exp(-np.append(log_exposure, 0.0)).astype(np.float32)
        gray = self.gray if self.even is None else self.even
        return np.asarray(gray * gain[self.source][:, None])


@dataclass(frozen=True)
class BlendedColors:
    """One color per point, from several images.

    radiance: (M, 3) float32, 0 where uncolored
    views: (M,) uint8, number of samples blended; 0: uncolored
    spread: (M,) float32, weighted RMS difference of the samples from the color, radiance
    """

    radiance: np.ndarray
    views: np.ndarray
    spread: np.ndarray


@dataclass(frozen=True)
class Samples:
    """The best samples of points, filled in place, in no order.

    ranks (M, K) float32, 0 where there is none; gray (M, K, 3) uint8; images (M, K) int32
    """

    ranks: np.ndarray
    gray: np.ndarray
    images: np.ndarray

    @property
    def arrays(self) -> kernels.Samples:
        """As kernels take them."""
        return kernels.Samples(self.ranks, self.gray, self.images)


def paper(
    cloud: Cloud, views: Views, held_out: Indices | None = None, progress: Progress = silent
) -> PaperColors:
    """Colors each point by its projection into the image nearest in time to its scan; no occlusion test.

    held_out: indices of images that must not color anything. Source: Li et al., eq. (10).
    """
    return paper_each([(cloud, views)], held_out, progress)[0]


def paper_each(
    states: Sequence[tuple[Cloud, Views]], held_out: Indices | None = None, progress: Progress = silent
) -> list[PaperColors]:
    """The colors that `paper` gives each of some states of one recording, image by image: each is loaded once for all.

    held_out: indices of images that must not color anything
    """
    colorings = [_Coloring(cloud, views, held_out) for cloud, views in states]
    images = sorted({image for coloring in colorings for image in coloring.images})

    def color(image: int) -> None:
        for coloring in colorings:
            coloring.color(image)

    for done, _ in enumerate(in_order(color, images)):
        progress("color points", done + 1, len(images))
    return [coloring.result() for coloring in colorings]


class _Coloring:
    """The colors of one cloud while its images are gone through, in any order. images: the ones that color it."""

    def __init__(self, cloud: Cloud, views: Views, held_out: Indices | None) -> None:
        usable = np.setdiff1d(np.arange(len(views)), [] if held_out is None else held_out)
        self._cloud, self._views = cloud, views
        self._gray = np.zeros((len(cloud), 3), np.float32)
        self._source = np.full(len(cloud), -1, np.int32)
        self._light = None if views.light is None else np.repeat(views.light[:, :, None], 3, axis=2)
        self._part = None if self._light is None else np.ones_like(self._gray)
        self._image_of_scan = np.zeros(0, np.int64)
        if len(usable):
            self._image_of_scan = usable[nearest_in_time(views.times[usable], cloud.scan_times)]
        self.images = [int(image) for image in np.unique(self._image_of_scan)]
        self._mask, self._poses = views.mask, views.poses

    def color(self, image: int) -> None:
        """Gives the points of the scans nearest in time to an image their colors."""
        scans = np.flatnonzero(self._image_of_scan == image)
        if not len(scans):
            return
        cloud, intrinsics, pose = self._cloud, self._views.intrinsics, self._poses[image]
        picture = np.ascontiguousarray(self._views.load(image))
        for s in scans:
            span = slice(cloud.scan_offsets[s], cloud.scan_offsets[s + 1])
            seen, points = np.empty(span.stop - span.start, bool), cloud.points_world[span]
            kernels.sample_image(points, pose, intrinsics, picture, self._mask, self._gray[span], seen)
            self._source[span][seen] = image
            if self._light is not None and self._part is not None:
                kernels.sample_image(
                    points, pose, intrinsics, self._light, self._mask, self._part[span], seen
                )

    def result(self) -> PaperColors:
        """The colors so far."""
        even = self._part
        if even is not None:
            # in place and scan by scan: of dense scans, what this takes beside would be most of an evaluation
            for span in starmap(slice, pairwise(map(int, self._cloud.scan_offsets))):
                even[span] = self._views.curve.light(self._gray[span]) / even[span]
        return PaperColors(self._gray, self._source, even)


def blended(
    points_world: np.ndarray,
    views: Views,
    config: ColorizeConfig | None = None,
    *,
    origins: Origins | None = None,
    held_out: Indices | None = None,
    progress: Progress = silent,
    batch: int = 8,
) -> BlendedColors:
    """Colors each point by a robust mean over its best views that nothing hides.

    points_world: (M, 3) float32, m; origins: from where they were measured, or None: a wall thinner than the tolerance
    then takes colors from both of its sides; held_out: indices of images that must not color anything.
    A view ranks by how far along the surface its color is off, and not at all beyond `max_angle_deg`. Hidden: behind what
    the map's own z-buffer shows there (`occlusion.hides`). Saturated and black samples count only where a point has no
    other.
    """
    config = config or ColorizeConfig()
    blocks = sort_into_blocks(points_world)
    points = np.ascontiguousarray(points_world[blocks.order].T)
    scene = _Scene(points, surfaces(points, blocks, origins, np.radians(config.max_angle_deg)), blocks, views)
    usable, spans = _usable(views, held_out), blocks.spans(max(1, _MOST_SAMPLES // config.max_views))
    radiance = np.zeros((len(points_world), 3), np.float32)
    number, spread = np.zeros(len(points_world), np.uint8), np.zeros(len(points_world), np.float32)
    for turn, span in enumerate(spans):
        of_span = partial(_progress_of_piece, progress, turn, len(spans))
        samples = _samples(scene, span, usable, config.max_views, of_span, batch)
        colors = blend(samples, views.log_exposure, config)
        del samples  # most of what is held
        into = blocks.order[blocks.start[span.start] : blocks.start[span.stop]]
        radiance[into], number[into], spread[into] = colors.radiance, colors.views, colors.spread
    return BlendedColors(radiance, number, spread)


def _progress_of_piece(progress: Progress, turn: int, turns: int, what: str, done: int, total: int) -> None:
    progress(what, turn * total + done, turns * total)


def collect(
    points: np.ndarray,
    blocks: Blocks,
    views: Views,
    config: ColorizeConfig,
    *,
    origins: Origins | None = None,
    held_out: Indices | None = None,
    progress: Progress = silent,
    batch: int = 8,
) -> Samples:
    """The best samples of points in the order of their blocks; see `blended`.

    points: (3, M) float32, m, world, by axis; origins: of the points before they were sorted
    """
    scene = _Scene(points, surfaces(points, blocks, origins, np.radians(config.max_angle_deg)), blocks, views)
    every = slice(0, len(blocks.spheres))
    return _samples(scene, every, _usable(views, held_out), config.max_views, progress, batch)


def _usable(views: Views, held_out: Indices | None) -> np.ndarray:
    """(n,) int32: numbers of the images that may color."""
    return np.setdiff1d(np.arange(len(views)), [] if held_out is None else held_out).astype(np.int32)


@dataclass(frozen=True)
class _Scene:
    """points: (3, M) float32, m, world, in the order of their blocks; surface: (M, 8) float32, as of `cloud.surfaces`"""

    points: np.ndarray
    surface: np.ndarray
    blocks: Blocks
    views: Views


def _samples(
    scene: _Scene, span: slice, usable: np.ndarray, most: int, progress: Progress, batch: int
) -> Samples:
    """The `most` best samples of the points of a span of blocks, which all points may hide."""
    start, views = scene.blocks.start, scene.views
    slots = (int(start[span.stop] - start[span.start]), most)
    samples = Samples(
        np.zeros(slots, np.float32), np.zeros((*slots, 3), np.uint8), np.full(slots, -1, np.int32)
    )
    pictures = in_order(views.load_even, map(int, usable))
    for first in range(0, len(usable), batch):
        numbers = usable[first : first + batch]
        stack = np.stack([next(pictures) for _ in numbers])
        _collect(scene, span, numbers, stack, samples)
        progress("color map", first + len(numbers), len(usable))
    return samples


def _collect(scene: _Scene, span: slice, numbers: np.ndarray, pictures: np.ndarray, samples: Samples) -> None:
    """Adds the samples of some images to the lists of the best views, in place. numbers: of the pictures."""
    views, blocks = scene.views, scene.blocks
    poses, mask = views.poses[numbers], views.mask
    tolerance = occlusion.Tolerance(np.float32(TOLERANCE), np.float32(_WIDE))
    cloud = blocks.holding(scene.points)
    seen_first = occlusion.first_points(
        cloud, scene.surface, tolerance, poses, views.intrinsics, CELL_PX, *mask.shape
    )
    kernels.collect_views(
        cloud._replace(start=blocks.start[span.start : span.stop + 1], spheres=blocks.spheres[span]),
        scene.surface,
        tolerance,
        poses,
        views.intrinsics,
        pictures,
        numbers,
        mask,
        seen_first,
        kernels.UsableGray(np.float32(DARK), np.float32(BRIGHTEST)),
        samples.arrays,
    )


def blend(samples: Samples, log_exposure: LogExposures, config: ColorizeConfig) -> BlendedColors:
    """The blended colors, in the order of the samples. log_exposure: (I,)"""
    count = len(samples.ranks)
    radiance, spread = np.zeros((count, 3), np.float32), np.zeros(count, np.float32)
    number = np.zeros(count, np.uint8)
    gains, floor = np.exp(-log_exposure).astype(np.float32), np.float32(NOISE)
    kernels.blend_views(samples.arrays, gains, floor, radiance, number, spread)
    seen = np.count_nonzero(number)
    logger.info("colored %d of %d points from %.1f views each", seen, count, number.sum() / max(seen, 1))
    return BlendedColors(radiance, number, spread)


def display_gain(log_exposure: LogExposures) -> float:
    """What turns a radiance into a gray value for display: the typical (median) relative exposure."""
    return float(np.exp(np.median(log_exposure))) if len(log_exposure) else 1.0


def to_rgb8(radiance: np.ndarray, gain: float, curve: Response = LINEAR) -> np.ndarray:
    """(M, 3) uint8 colors of (M, 3) radiances times a gain, through the images' curve, rounded and clipped.

    radiance: (M, 3) float32
    """
    light = radiance * np.float32(gain)
    return np.clip(np.rint(curve.grey(light) if curve else light), 0, 255).astype(np.uint8)


def contrast(radiance: np.ndarray, gain: float, curve: Response) -> np.ndarray | np.float32:
    """(M,) float32: how much grey values change with the light at colors; 1 without a curve.

    radiance: (M, 3) float32; gain: grey value of a radiance of 1 without the curve
    """
    if not curve:
        return np.float32(1.0)
    light = np.maximum(radiance.mean(axis=1) * np.float32(gain), np.float32(1.0))
    grey = np.maximum(curve.grey(light), np.float32(1.0))
    return np.asarray(grey / light / curve.slope(np.log(grey)), np.float32)
