"""Images of a colored cloud: the nearest point of every pixel, times the image's exposure."""

from dataclasses import dataclass, replace

import numpy as np

from lvba.arrays import CloudPoints, Indices, LogExposures
from lvba.kernels import colorize as color_kernels
from lvba.kernels import splats
from lvba.kernels import zbuffer as kernels
from lvba.kernels.visibility_depth import HIDING_PART
from lvba.products.cloud import Blocks, Cloud, sort_into_blocks
from lvba.products.colorize import NOISE, ColorizeConfig, PaperColors, Samples, blend, collect
from lvba.products.views import Views
from lvba.settings import Group, setting
from lvba.visual.response import LINEAR, Response

SEVERAL = -(1 << 30)
"""Source of a point that several images colored: it remains when one of them is left out."""

ALL, OTHERS = 0, 1
"""Variants of a rendering: from all colored points, and from those that other images colored (leave-one-out)."""

HIDING_CELLS = 80
"""Cells across an image, of a splat at least, in which the nearest point hides what lies behind it: wider than the gaps
between lines of a spinning LiDAR on a wall that is a few meters away."""
BEHIND_M = 0.05
"""So much, beside HIDING_PART of the depth, points of one surface may be apart along a ray."""


@dataclass(frozen=True)
class RenderConfig(Group):
    """How points become pixels."""

    splat_px: int = setting(
        3,
        meaning="Edge of the square of pixels that a point fills. Larger covers more and blurs more.",
        unit="px",
        low=1,
        high=15,
        odd=True,
        change_when="Points are much sparser than pixels and coverage is low (larger).",
        advanced=True,
    )


@dataclass(frozen=True)
class ColoredCloud:
    """Colored points in blocks, ready to be rendered.

    points_world: (3, M) float32, m, by axis; gray: (M, 3) float32, gray values in the image `source` (M,) int32
    samples: of points colored by several images; then gray holds radiances, and source is the image of points that only
        one image colored, else SEVERAL
    noise: of a gray value of the samples
    even: (M, 3) float32, light of these gray values if all had arrived; None: it has
    """

    points_world: np.ndarray
    gray: np.ndarray
    source: np.ndarray
    blocks: Blocks
    samples: Samples | None = None
    noise: float = 0.0
    even: np.ndarray | None = None


@dataclass(frozen=True)
class Rendering:
    """One image, seen from all points and from those of other images; the first axis is ALL, OTHERS.

    color: (2, H, W, 3) float32, 0..255, black where empty
    covered: (2, H, W) bool
    """

    color: np.ndarray
    covered: np.ndarray


def colored_cloud(points_world: CloudPoints, colors: PaperColors) -> ColoredCloud:
    """The colored ones of the points (M, 3), sorted into blocks."""
    order = np.flatnonzero(colors.source >= 0).astype(np.int32)
    blocks = sort_into_blocks(points_world[order])
    order = order[blocks.order]
    return ColoredCloud(
        points_world=_by_axis(points_world, order),
        gray=colors.gray[order],
        source=colors.source[order],
        blocks=replace(blocks, order=np.empty(0, np.int32)),  # which is not needed any more
        even=None if colors.even is None else colors.even[order],
    )


def _by_axis(points_world: CloudPoints, order: np.ndarray) -> np.ndarray:
    """(3, K) float32: points (M, 3) in an order (K,), without a copy beside."""
    by_axis = np.empty((3, len(order)), np.float32)
    for axis, values in enumerate(by_axis):
        np.take(points_world[:, axis], order, out=values)
    return by_axis


def blended_cloud(
    cloud: Cloud, views: Views, config: ColorizeConfig, held_out: Indices | None = None
) -> ColoredCloud:
    """The points colored by several views each, with the samples, so that any one image can be left out."""
    blocks = sort_into_blocks(cloud.points_world)
    points = np.ascontiguousarray(cloud.points_world[blocks.order].T)
    origins = cloud.origins(np.arange(len(cloud)))
    samples = collect(points, blocks, views, config, origins=origins, held_out=held_out)
    radiance = blend(samples, views.log_exposure, config).radiance
    seen = samples.ranks > 0
    first = np.where(seen, samples.images, np.iinfo(np.int32).max).min(1)
    last = np.where(seen, samples.images, -1).max(1)
    source = np.where(first == last, first, SEVERAL).astype(np.int32)
    # a point that no image colors is nowhere: it neither shows nor hides anything
    points[:, last < 0] = np.nan
    return ColoredCloud(
        points_world=points, gray=radiance, source=source, blocks=blocks, samples=samples, noise=NOISE
    )


def nearest(
    cloud: ColoredCloud,
    views: Views,
    image: int,
    config: RenderConfig | None = None,
    guard_images: int = 0,
) -> np.ndarray:
    """What each pixel of an image sees, ALL and OTHERS: entries (2, H, W) int64 for `shade` and `depth`.

    Each point fills `splat_px` x `splat_px` pixels round its projection; the nearest point wins. Points that the image
    colored are not among OTHERS, but hide what lies behind them there, too, also between them.
    guard_images: OTHERS leaves out the points of this many images before and after, too
    """
    if guard_images and cloud.samples is not None:
        raise ValueError("guard_images needs colors of one image each")
    config = config or RenderConfig()
    entries = splats.splat(
        cloud.blocks.holding(cloud.points_world),
        cloud.source,
        views.poses[image],
        views.intrinsics,
        image,
        guard_images,
        config.splat_px // 2,
        views.camera.height,
        views.camera.width,
    )
    cell = max(views.camera.width // HIDING_CELLS, config.splat_px)
    kernels.take_out_hidden(entries, cell, HIDING_PART, BEHIND_M)
    return entries


def covered(entries: np.ndarray) -> np.ndarray:
    """Whether a pixel sees anything, (2, H, W) bool, as `shade` has it. entries: (2, H, W) int64, of `nearest`"""
    return np.asarray(entries != kernels.EMPTY)


def points(entries: np.ndarray) -> np.ndarray:
    """Which point of the cloud each pixel sees, int64 as the entries, -1: none. entries: (H, W) int64, of `nearest`"""
    return np.asarray(np.where(entries == kernels.EMPTY, -1, entries & 0xFFFFFFFF))


def shade(
    entries: np.ndarray,
    cloud: ColoredCloud,
    log_exposure: LogExposures,
    image: int,
    *,
    only_others: bool = False,
    light: np.ndarray | None = None,
    curve: Response = LINEAR,
) -> Rendering:
    """The rendering of an image: gray values divided by their image's exposure, times this one's, clipped at 255.

    only_others: the colors of ALL are not wanted, and are anything
    light: (H, W) float32, part of the light that arrives at each pixel of all images, as of `Views`; None: all
    curve: that gray values passed
    entries: (2, H, W) int64, of `nearest`
    """
    # where nothing is covered too: a curve is taken of all
    color = np.zeros((*entries.shape, 3), np.float32)
    covered = np.empty(entries.shape, bool)
    arriving = np.ones(entries.shape[1:], np.float32) if light is None else light
    if cloud.samples is not None:
        gains = np.exp(-log_exposure).astype(np.float32)
        color_kernels.shade_blended(
            *(entries, cloud.gray, cloud.samples.arrays, gains, np.float32(cloud.noise), image, arriving),
            *(color, covered),
        )
        return Rendering(curve.grey(color) if curve else color, covered)
    ratio = np.exp(log_exposure[image] - log_exposure).astype(np.float32)
    gray = cloud.gray if light is None or cloud.even is None else cloud.even
    splats.shade(entries, gray, cloud.source, ratio, arriving, int(only_others), color, covered)
    return Rendering(curve.grey(color) if curve else color, covered)


def fill(entries: np.ndarray, radius_px: int) -> np.ndarray:
    """The entries with small gaps between points closed, for pictures that people look at; never for figures.

    entries: (2, H, W) int64, of `nearest`
    """
    return splats.fill(entries, radius_px)


def depth(entries: np.ndarray) -> np.ndarray:
    """Depth maps (2, H, W) float32, m, inf where empty.

    entries: (2, H, W) int64, of `nearest`
    """
    return kernels.split(entries)[0]


def render(
    cloud: ColoredCloud, views: Views, image: int, config: RenderConfig | None = None, guard_images: int = 0
) -> Rendering:
    """One image, rendered from all points and from those of other images; guard_images: as of `nearest`."""
    entries = nearest(cloud, views, image, config, guard_images)
    return shade(entries, cloud, views.log_exposure, image, light=views.light, curve=views.curve)
