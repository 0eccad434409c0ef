"""Color samples of points in images: one view by eq. (10), or the best few views behind an occlusion test."""

from typing import NamedTuple

import numpy as np
from numba import prange

from lvba.kernels.compiled import kernel, parallel_kernel
from lvba.kernels.facing import LEAST_COSINE, NORMAL, SCATTER, TO_LIDAR
from lvba.kernels.occlusion import FirstPoints, Tolerance, hides, tolerance_of
from lvba.kernels.scene import BlockPoints, Intrinsics
from lvba.kernels.zbuffer import (
    EMPTY,
    NEAR_M,
    RUN,
    in_view,
    sphere_in_view,
    view_buffers,
    view_slopes,
)

_CLIPPED_RANK = np.float32(1e-9)
_TOUCHING = np.float32(2.0)
"""Cells between a point and another of the same surface that an image is asked about."""


class UsableGray(NamedTuple):
    """Gray values, float32: samples whose brightest channel is not above `dark`, or reaches `bright`, are clipped."""

    dark: np.float32
    bright: np.float32


class Samples(NamedTuple):
    """The best views of every point, in no order.

    ranks: (M, K) float32, 1/m^2, 0: none; colors: (M, K, 3) uint8; images: (M, K) int32
    """

    ranks: np.ndarray
    colors: np.ndarray
    images: np.ndarray


@kernel
def _bilinear(image: np.ndarray, u: float, v: float, color: np.ndarray) -> np.float32:
    """Writes the bilinear RGB at (u, v), inside the image, and returns the largest channel value it touches."""
    height, width = image.shape[0], image.shape[1]
    column, row = min(int(u), width - 2), min(int(v), height - 2)
    a, b = u - np.float32(column), v - np.float32(row)
    high = np.float32(0.0)
    one = np.float32(1.0)
    for c in range(3):
        p, q = np.float32(image[row, column, c]), np.float32(image[row, column + 1, c])
        r, s = np.float32(image[row + 1, column, c]), np.float32(image[row + 1, column + 1, c])
        color[c] = (one - b) * ((one - a) * p + a * q) + b * ((one - a) * r + a * s)
        high = max(high, max(max(p, q), max(r, s)))
    return high


@kernel
def sample_image(
    points: np.ndarray,
    pose: np.ndarray,
    intrinsics: Intrinsics,
    image: np.ndarray,
    valid: np.ndarray,
    gray: np.ndarray,
    seen: np.ndarray,
) -> None:
    """Writes the bilinear color of each point that projects into the image; eq. (10).

    points: (N, 3) float32, m, world; pose: (4, 4) float32, world_from_camera; intrinsics: float32;
    image: (H, W, 3) uint8; valid: (H, W) bool, pixels that hold a picture; gray: (N, 3) float32 and seen: (N,) bool, out
    """
    height, width = image.shape[0], image.shape[1]
    for i in range(points.shape[0]):
        seen[i] = False
        dx, dy, dz = points[i, 0] - pose[0, 3], points[i, 1] - pose[1, 3], points[i, 2] - pose[2, 3]
        z = pose[0, 2] * dx + pose[1, 2] * dy + pose[2, 2] * dz
        if z < NEAR_M:
            continue
        inverse = np.float32(1.0) / z
        u = intrinsics.fx * (pose[0, 0] * dx + pose[1, 0] * dy + pose[2, 0] * dz) * inverse + intrinsics.cx
        v = intrinsics.fy * (pose[0, 1] * dx + pose[1, 1] * dy + pose[2, 1] * dz) * inverse + intrinsics.cy
        if not (u >= 0 and v >= 0 and u <= width - 1 and v <= height - 1):
            continue
        if not valid[int(v + np.float32(0.5)), int(u + np.float32(0.5))]:
            continue
        _bilinear(image, u, v, gray[i])
        seen[i] = True


@kernel
def _worst(ranks: np.ndarray) -> int:
    """The first slot of the least rank."""
    slot = 0
    for k in range(1, ranks.shape[0]):
        if ranks[k] < ranks[slot]:
            slot = k
    return slot


@parallel_kernel
def collect_views(
    cloud: BlockPoints,
    surface: np.ndarray,
    tolerance: Tolerance,
    poses: np.ndarray,
    intrinsics: Intrinsics,
    pictures: np.ndarray,
    numbers: np.ndarray,
    valid: np.ndarray,
    seen_first: FirstPoints,
    usable: UsableGray,
    samples: Samples,
) -> None:
    """Adds the samples of a batch of images to the best views of every point.

    surface: (M, 8) float32, see `facing.surfaces`; poses: (B, 4, 4) float32, world_from_camera; intrinsics: float32
    pictures: (B, H, W, 3) uint8; numbers: (B,) int32, image numbers; valid: (H, W) bool, pixels that hold a picture
    seen_first: of the same images
    samples: in and out, of the points of these blocks alone. A better view takes the place of the worst, so that the K
    best remain; of equal ones the earlier stays.
    """
    points, start, cell = cloud.position, cloud.start, seen_first.cell
    base = start[0]
    first_seen, front = seen_first.point, seen_first.front
    ranks, colors, images = samples.ranks, samples.colors, samples.images
    height, width, columns = pictures.shape[1], pictures.shape[2], first_seen.shape[2]
    right, bottom = np.float32(width - 1), np.float32(height - 1)
    half, pixel = np.float32(0.5), np.float32(1.0) / min(intrinsics.fx, intrinsics.fy)
    twice = np.float32(1.9999) * pixel * pixel
    touching = _TOUCHING * np.float32(cell) * pixel
    cell_of = np.arange(max(height, width)) // cell
    half_of = (2 * (np.arange(max(height, width)) % cell) + 1) // cell
    for b in prange(start.shape[0] - 1):
        color = np.empty(3, np.float32)
        buffers, slopes = view_buffers(), view_slopes(intrinsics, width, height)
        u, v, depth, which = buffers.u, buffers.v, buffers.depth, buffers.which
        for image in range(len(numbers)):
            pose = poses[image]
            if not sphere_in_view(cloud.spheres[b], pose, slopes):
                continue
            for first in range(start[b], start[b + 1], RUN):
                seen = in_view(points, first, start[b + 1], pose, intrinsics, width, height, buffers)
                for k in which[:seen]:
                    column, row = int(u[k] + half), int(v[k] + half)
                    if not valid[row, column]:
                        continue
                    i = first + k
                    own_ranks = ranks[i - base]
                    slot = _worst(own_ranks)
                    # no view ranks higher than one that is no nearer and faces the surface
                    if own_ranks[slot] * twice * depth[k] * depth[k] >= 1:
                        continue
                    rank = _rank(points, surface, i, pose, pixel)
                    if not rank > own_ranks[slot]:
                        continue
                    r, c = cell_of[row], cell_of[column]
                    other = front[image, r, c, half_of[row], half_of[column]]
                    own, near = first_seen[image, r, c], first_seen[image, other // columns, other % columns]
                    if _hidden(own, points, surface, tolerance, i, pose, depth[k], touching):
                        continue
                    if _hidden(near, points, surface, tolerance, i, pose, depth[k], touching):
                        continue
                    x, y = min(max(u[k], np.float32(0.0)), right), min(max(v[k], np.float32(0.0)), bottom)
                    high = _bilinear(pictures[image], x, y, color)
                    if high >= usable.bright or high <= usable.dark:
                        rank *= _CLIPPED_RANK
                        if not rank > own_ranks[slot]:
                            continue
                    own_ranks[slot], images[i - base, slot] = rank, numbers[image]
                    for channel in range(3):
                        colors[i - base, slot, channel] = np.uint8(color[channel] + half)


@kernel
def _rank(points: np.ndarray, surface: np.ndarray, i: int, pose: np.ndarray, pixel: np.float32) -> np.float32:
    """How good the view is: one over the mean square distance, along the surface, of what it shows from the point, 1/m^2.

    A pixel covers distance / focal length of the surface, and 1 / cos times as much lengthwise. And the point is off the
    surface by its scatter, along the beam that measured it; the view through it meets the surface elsewhere, by the
    difference of beam and view, each over its cosine: nowhere else where camera and LiDAR look the same way. 0: seen from
    further off the normal than may be. Where the beam is not known, the surface has two sides.
    """
    one = np.float32(1.0)
    dx, dy, dz = points[0, i] - pose[0, 3], points[1, i] - pose[1, 3], points[2, i] - pose[2, 3]
    nx, ny, nz = surface[i, NORMAL], surface[i, NORMAL + 1], surface[i, NORMAL + 2]
    lx, ly, lz = surface[i, TO_LIDAR], surface[i, TO_LIDAR + 1], surface[i, TO_LIDAR + 2]
    square = dx * dx + dy * dy + dz * dz
    if nx == 0 and ny == 0 and nz == 0:
        return one / (np.float32(2.0) * pixel * pixel * square)
    height = -(nx * dx + ny * dy + nz * dz)
    if lx == 0 and ly == 0 and lz == 0:
        height = abs(height)
    squared = height * height
    if not (height > 0 and squared > surface[i, LEAST_COSINE] * square):
        return np.float32(0.0)
    ax, ay, az = lx * height + dx, ly * height + dy, lz * height + dz
    off = surface[i, SCATTER] * surface[i, SCATTER] * (ax * ax + ay * ay + az * az)
    return squared / (pixel * pixel * square * (squared + square) + off)


@kernel(inline=True)
def _hidden(
    first_seen: np.ndarray,
    points: np.ndarray,
    surface: np.ndarray,
    tolerance: Tolerance,
    i: int,
    pose: np.ndarray,
    depth: np.float32,
    touching: np.float32,
) -> bool:
    """Whether what a cell sees first, (8,), hides a point."""
    allowed = tolerance_of(surface[i], tolerance)
    nx, ny, nz = surface[i, NORMAL], surface[i, NORMAL + 1], surface[i, NORMAL + 2]
    if surface[i, TO_LIDAR] == 0 and surface[i, TO_LIDAR + 1] == 0 and surface[i, TO_LIDAR + 2] == 0:
        toward = np.float32(0.0)
        for a in range(3):
            toward += surface[i, NORMAL + a] * (pose[a, 3] - points[a, i])
        if toward < 0:
            nx, ny, nz = -nx, -ny, -nz
    return hides(
        first_seen, points[0, i], points[1, i], points[2, i], depth, nx, ny, nz, allowed, touching * depth
    )


@kernel
def _sort(values: np.ndarray, weights: np.ndarray, count: int) -> None:
    """Sorts the first `count` values in place, their weights along with them.

    Neighbors change places without branches: for so few values, guessing wrong costs more than continuing.
    """
    for turn in range(count):
        for k in range(turn & 1, count - 1, 2):
            value, other, weight, beside = values[k], values[k + 1], weights[k], weights[k + 1]
            swap = value > other
            values[k], values[k + 1] = (other if swap else value), (value if swap else other)
            weights[k], weights[k + 1] = (beside if swap else weight), (weight if swap else beside)


@kernel
def _weighted_median(weights: np.ndarray, count: int, half: np.float32) -> int:
    """Which of the sorted values is the first at which half of the weight is reached."""
    reached = np.float32(0.0)
    for k in range(count):
        reached += weights[k]
        if reached >= half:
            return k
    return count - 1


@kernel
def _median_distance(
    values: np.ndarray, weights: np.ndarray, count: int, middle: int, half: np.float32
) -> np.float32:
    """The weighted median distance of the sorted values from the middle one: outwards until half the weight is met."""
    low, high, none = middle, middle + 1, np.float32(np.inf)
    reached, distance = np.float32(0.0), np.float32(0.0)
    while reached < half and (low >= 0 or high < count):
        left = values[middle] - values[low] if low >= 0 else none
        right = values[high] - values[middle] if high < count else none
        distance = min(left, right)
        if left <= right:
            reached += weights[low]
            low -= 1
        else:
            reached += weights[high]
            high += 1
    return distance


@kernel
def robust_mean(
    samples: np.ndarray,
    weights: np.ndarray,
    count: int,
    floor: np.float32,
    scratch: np.ndarray,
    out: np.ndarray,
) -> np.float32:
    """Writes the Huber mean per channel, started at the weighted median; returns the spread of the samples.

    samples: (3, K) float32, radiances; weights: (K,) float32; floor: float32, least noise of a sample, same unit;
    scratch: (2, K) float32; out: (3,) float32. Spread: weighted root mean square of the difference from the mean, all
    channels.
    """
    total, squares, one = np.float32(0.0), np.float32(0.0), np.float32(1.0)
    values, ordered = scratch[0], scratch[1]
    for k in range(count):
        total += weights[k]
    half = np.float32(0.5) * total
    for c in range(3):
        for k in range(count):
            values[k], ordered[k] = samples[c, k], weights[k]
        _sort(values, ordered, count)
        middle = _weighted_median(ordered, count, half)
        center = values[middle]
        scale = np.float32(1.4826) * _median_distance(values, ordered, count, middle, half)
        knee = np.float32(1.5) * max(scale, floor)
        weight, value = np.float32(0.0), np.float32(0.0)
        for k in range(count):
            distance = abs(samples[c, k] - center)
            w = weights[k] * (one if distance <= knee else knee / distance)
            weight += w
            value += w * samples[c, k]
        out[c] = value / weight
        for k in range(count):
            squares += weights[k] * (samples[c, k] - out[c]) ** 2
    return np.sqrt(squares / (np.float32(3.0) * total))


@kernel
def _gather(
    best: Samples, point: int, gains: np.ndarray, without: int, samples: np.ndarray, weights: np.ndarray
) -> tuple[int, np.float32]:
    """Writes a point's usable samples as radiances (3, K) and their weights (K,), those of image `without` left out.

    Returns their number and the sum of their gains. Clipped samples are usable only where there is no other.
    """
    ranks, colors, images = best.ranks[point], best.colors[point], best.images[point]
    highest = np.float32(0.0)
    for k in range(ranks.shape[0]):
        if images[k] != without:
            highest = max(highest, ranks[k])
    count, gain = 0, np.float32(0.0)
    for k in range(ranks.shape[0]):
        if ranks[k] > np.float32(1e-6) * highest and images[k] != without:
            factor = gains[images[k]]
            gain += factor
            weights[count] = ranks[k]
            for c in range(3):
                samples[c, count] = np.float32(colors[k, c]) * factor
            count += 1
    return count, gain


@parallel_kernel
def blend_views(
    best: Samples,
    gains: np.ndarray,
    floor: np.float32,
    radiance: np.ndarray,
    views: np.ndarray,
    spread: np.ndarray,
) -> None:
    """Blends every point's samples: out radiance (M, 3) float32, views (M,) uint8, spread (M,) float32.

    gains: (I,) float32, 1 / relative exposure; floor: noise of a gray value, 0..255
    """
    number, slots = best.ranks.shape
    for run in prange((number + RUN - 1) // RUN):
        samples, weights = np.empty((3, slots), np.float32), np.empty(slots, np.float32)
        scratch = np.empty((2, slots), np.float32)
        for i in range(run * RUN, min(number, (run + 1) * RUN)):
            count, gain = _gather(best, i, gains, -1, samples, weights)
            views[i] = count
            if count:
                noise = floor * gain / np.float32(count)
                spread[i] = robust_mean(samples, weights, count, noise, scratch, radiance[i])


@kernel
def shade_blended(
    entries: np.ndarray,
    radiance: np.ndarray,
    best: Samples,
    gains: np.ndarray,
    floor: np.float32,
    image: int,
    light: np.ndarray,
    color: np.ndarray,
    covered: np.ndarray,
) -> None:
    """Writes colors (2, H, W, 3) float32, 0..255, and whether anything is seen (2, H, W) bool, of one image.

    entries: (2, H, W) int64 of lvba.kernels.zbuffer; radiance: (M, 3) float32, of all samples: the first picture. In
    the second, points with a sample of the image itself are blended again without it.
    gains: (I,) float32, see `blend_views`; light: (H, W) float32, part of it that arrives at each pixel
    color: (2, H, W, 3) float32, out; covered: (2, H, W) bool, out
    """
    slots = best.ranks.shape[1]
    samples, weights = np.empty((3, slots), np.float32), np.empty(slots, np.float32)
    scratch, value = np.empty((2, slots), np.float32), np.empty(3, np.float32)
    exposure, white = np.float32(1.0) / gains[image], np.float32(255.0)
    for variant in range(2):
        for row in range(entries.shape[1]):
            for column in range(entries.shape[2]):
                entry = entries[variant, row, column]
                covered[variant, row, column] = entry != EMPTY
                for c in range(3):
                    color[variant, row, column, c] = 0.0
                if entry == EMPTY:
                    continue
                i = int(entry & 0xFFFFFFFF)
                own = False
                for k in range(slots):
                    own |= best.ranks[i, k] > 0 and best.images[i, k] == image
                value[:] = radiance[i]
                if variant == 1 and own:
                    count, gain = _gather(best, i, gains, image, samples, weights)
                    robust_mean(samples, weights, count, floor * gain / np.float32(count), scratch, value)
                for c in range(3):
                    color[variant, row, column, c] = min(value[c] * exposure * light[row, column], white)
