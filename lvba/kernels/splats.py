"""Images of a point cloud: of the points in front, each pixel shows the one in its middle.

A pixel's entry is one integer, as in `kernels.zbuffer`.
"""

from typing import NamedTuple

import numpy as np

from lvba.kernels.compiled import kernel
from lvba.kernels.scene import BlockPoints, Intrinsics
from lvba.kernels.zbuffer import (
    EMPTY,
    FAR_M,
    RUN,
    STEPS,
    in_view,
    sphere_in_view,
    view_buffers,
    view_slopes,
)

_SAME_SURFACE = np.float32(0.05)
"""Points of a surface are deeper by less than this part of their depth from one pixel to the next."""
_EIGHTHS = np.float32(8.0)
_MIDDLE = np.float32(3.5)
"""Where a point is in a pixel is known to an eighth of it; in its middle in so many."""
_COARSE = np.float32(16384.0)
"""Steps of depth per m that points in a pixel are compared by."""


class OwnPoints(NamedTuple):
    """The own point of each pixel.

    entry: (H, W) int64, EMPTY where there is none; depth: (H, W) float32, m, inf where there is none
    right, down: (H, W) float32, px, from the middle of the pixel
    """

    entry: np.ndarray
    depth: np.ndarray
    right: np.ndarray
    down: np.ndarray


@kernel(inline=True)
def _farther(right: np.int64, down: np.int64) -> np.float32:
    """How many times as deep a point counts. right, down: where it is in its pixel, in eighths of one from the corner"""
    aside = abs(np.float32(right) - _MIDDLE) + abs(np.float32(down) - _MIDDLE)
    return np.float32(1.0) + _SAME_SURFACE / _EIGHTHS * aside


@kernel
def splat(
    cloud: BlockPoints,
    source: np.ndarray,
    pose: np.ndarray,
    intrinsics: Intrinsics,
    image: int,
    guard: int,
    radius: int,
    height: int,
    width: int,
) -> np.ndarray:
    """What each pixel of one image sees, of all points and of those of other images: entries (2, H, W) int64.

    Of points in one pixel the one in its middle, for the nearest one is at the edge where a slanted surface comes closer,
    and all that is seen would be moved there. So depths count as larger by a part of themselves for each pixel that they
    are from the middle, along rows and along columns: a slope that is less than that moves nothing.
    source: (M,) int32, image that colored the point; pose: (4, 4) float32, world_from_camera; intrinsics: float32
    guard: points whose source is within `guard` of the image are left out of variant 1; radius: half a splat, px.
    Entry: depth in 2^-20 m << 32 | index of the point; EMPTY where there is none.
    """
    # both variants side by side: they nearly always touch the same line of memory
    nearest = np.full((height, width, 2), EMPTY, np.int64)
    slopes = view_slopes(intrinsics, width, height)
    half = np.float32(0.5)
    buffers = view_buffers()
    u, v, depth, which = buffers.u, buffers.v, buffers.depth, buffers.which
    points, start = cloud.position, cloud.start
    for b in range(start.shape[0] - 1):
        if not sphere_in_view(cloud.spheres[b], pose, slopes):
            continue
        for first in range(start[b], start[b + 1], RUN):
            seen = in_view(points, first, start[b + 1], pose, intrinsics, width, height, buffers)
            for k in which[:seen]:
                x, y = np.int64((u[k] + half) * _EIGHTHS), np.int64((v[k] + half) * _EIGHTHS)
                row, column, right, down = y >> 3, x >> 3, x & 7, y & 7
                counted = np.int64(min(depth[k] * _farther(right, down), FAR_M) * _COARSE)
                entry = (counted << 38) | (right << 35) | (down << 32) | (first + k)
                # stores without branches: which point is nearer cannot be predicted
                other = entry if abs(source[first + k] - image) > guard else EMPTY
                nearest[row, column, 0] = min(nearest[row, column, 0], entry)
                nearest[row, column, 1] = min(nearest[row, column, 1], other)
    out = np.empty((2, height, width), np.int64)
    for variant in range(2):
        _spread(_own_points(nearest[:, :, variant]), radius, out[variant])
    return out


@kernel
def _own_points(nearest: np.ndarray) -> OwnPoints:
    """What is known of the points of entries (H, W) int64 as `splat` compares them."""
    height, width = nearest.shape
    entries = np.empty((height, width), np.int64)
    places = np.empty((3, height, width), np.float32)
    for row in range(height):
        for column in range(width):
            entry = nearest[row, column]
            right, down = (entry >> 35) & 7, (entry >> 32) & 7
            depth = np.float32(entry >> 38) / (_COARSE * _farther(right, down))
            empty = entry == EMPTY
            places[0, row, column] = np.float32(np.inf) if empty else depth
            places[1, row, column] = (np.float32(right) - _MIDDLE) / _EIGHTHS
            places[2, row, column] = (np.float32(down) - _MIDDLE) / _EIGHTHS
            entries[row, column] = EMPTY if empty else (np.int64(depth * STEPS) << 32) | (entry & 0xFFFFFFFF)
    return OwnPoints(entries, places[0], places[1], places[2])


@kernel
def _spread(own: OwnPoints, radius: int, out: np.ndarray) -> None:
    """Every pixel takes its own point. Where it has none, or one behind those of the pixels within `radius` (a square),
    it takes of what is in front the point that is nearest to its middle.

    Points that are hardly deeper than the nearest of them are in front.
    out: (H, W) int64, entries
    """
    height, width = own.entry.shape
    front = np.empty((height, width), np.float32)
    _least_around(own.depth, radius, front)
    side = 2 * radius + 1
    limit, least, choice = np.empty(width, np.float32), np.empty(width, np.float32), np.empty(width, np.int32)
    for row in range(height):
        lacking = 0
        for column in range(width):
            limit[column] = front[row, column] * (np.float32(1.0) + _SAME_SURFACE)
            kept = own.depth[row, column] <= limit[column]
            # of an own point that is kept, none is nearer
            least[column], choice[column] = (
                np.float32(-1.0 if kept else np.inf),
                np.int32(side * radius + radius),
            )
            lacking += not kept
            out[row, column] = own.entry[row, column]
        if not lacking:
            continue
        for other in range(max(0, row - radius), min(height, row + radius + 1)):
            for shift in range(-radius, radius + 1):
                number = np.int32((other - row + radius) * side + shift + radius)
                _choose(own, row, other, shift, number, limit, least, choice)
        for column in range(width):
            if least[column] >= 0 and least[column] < np.inf:
                other, beside = choice[column] // side, choice[column] % side
                out[row, column] = own.entry[row + other - radius, column + beside - radius]


@kernel
def _choose(
    own: OwnPoints,
    row: int,
    other: int,
    shift: int,
    number: np.int32,
    limit: np.ndarray,
    least: np.ndarray,
    choice: np.ndarray,
) -> None:
    """Points of the row `other`, `shift` pixels on, for the pixels of a row: without branches, so that many are compared
    at a time.

    limit: (W,) float32, m, of what is in front; least: (W,) float32, squared distance (px) of the nearest point, and
    choice: (W,) int32, its number: in and out
    """
    width, beside = len(limit), np.float32(shift)
    first, stop = max(0, -shift), min(width, width - shift)
    below = np.float32(other - row)
    depth = own.depth[other, first + shift : stop + shift]
    right, down = (
        own.right[other, first + shift : stop + shift],
        own.down[other, first + shift : stop + shift],
    )
    limit, least, choice = limit[first:stop], least[first:stop], choice[first:stop]
    for k in range(stop - first):
        x, y = right[k] + beside, down[k] + below
        square = x * x + y * y
        better = (depth[k] <= limit[k]) & (square < least[k])
        least[k] = square if better else least[k]
        choice[k] = number if better else choice[k]


@kernel
def _least_around(values: np.ndarray, radius: int, out: np.ndarray) -> None:
    """The least of the values (H, W) float32 within `radius` of each (a square)."""
    height, width = values.shape
    across = np.empty((height, width), np.float32)
    line = np.full(width + 2 * radius, np.float32(np.inf))
    for row in range(height):
        for column in range(width):
            line[column + radius] = values[row, column]
        for column in range(width):
            across[row, column] = line[column]
        for shift in range(1, 2 * radius + 1):
            for column in range(width):
                across[row, column] = min(across[row, column], line[column + shift])
    for row in range(height):
        for column in range(width):
            out[row, column] = across[row, column]
        for other in range(max(0, row - radius), min(height, row + radius + 1)):
            for column in range(width):
                out[row, column] = min(out[row, column], across[other, column])


@kernel
def fill(entries: np.ndarray, radius: int) -> np.ndarray:
    """The entries (2, H, W), where empty those of the nearest pixel within `radius` of what is in front there.

    entries: (2, H, W) int64
    """
    height, width = entries.shape[1:]
    out = np.empty_like(entries)
    places = np.zeros((3, height, width), np.float32)
    for variant in range(2):
        for row in range(height):
            for column in range(width):
                entry = entries[variant, row, column]
                places[0, row, column] = np.inf if entry == EMPTY else np.float32(entry >> 32) / STEPS
        own = OwnPoints(entries[variant], places[0], places[1], places[2])
        _spread(own, radius, out[variant])
        for row in range(height):
            for column in range(width):
                if entries[variant, row, column] != EMPTY:
                    out[variant, row, column] = entries[variant, row, column]
    return out


@kernel
def shade(
    entries: np.ndarray,
    gray: np.ndarray,
    source: np.ndarray,
    ratio: np.ndarray,
    light: np.ndarray,
    first: int,
    color: np.ndarray,
    covered: np.ndarray,
) -> None:
    """Writes the colors (2, H, W, 3) float32, 0..255, and whether anything is seen (2, H, W) bool.

    entries: (2, H, W) int64; gray: (M, 3) float32, gray values in the source image; source: (M,) int32; ratio: (I,)
    float32, relative exposure of this image over that of each source. Clipped at 255, as the sensor does. light: (H, W)
    float32, part of it that arrives at each pixel. first: 1 if the first picture's colors are not wanted, and are not
    written; else 0
    color: (2, H, W, 3) float32, out; covered: (2, H, W) bool, out
    """
    for row in range(entries.shape[1]):
        for column in range(entries.shape[2]):
            for variant in range(2):
                entry = entries[variant, row, column]
                covered[variant, row, column] = entry != EMPTY
                if variant < first:
                    continue
                if entry == EMPTY:
                    for c in range(3):
                        color[variant, row, column, c] = 0.0
                elif variant > first and entry == entries[0, row, column]:
                    for c in range(3):
                        color[1, row, column, c] = color[0, row, column, c]
                else:
                    i = np.int32(entry & 0xFFFFFFFF)
                    gain = ratio[source[i]] * light[row, column]
                    for c in range(3):
                        color[variant, row, column, c] = min(gray[i, c] * gain, np.float32(255.0))
