"""The radiance of textured rectangles as a pixel sees it: every detail fades to its mean before it is too fine."""

from typing import NamedTuple

import numpy as np
from numba import prange

from lvba.kernels.compiled import kernel, parallel_kernel

ORIGIN, ALONG_U, ALONG_V, NORMAL = range(4)
"""Rows of a rectangle's frame (4, 3): a corner, m, and three unit vectors."""
RED, GREEN, BLUE, CONTRAST, DENSITY = range(5)
"""Columns of a rectangle's style (5,): its color, contrast of the octaves, part of the cells that hold a patch."""
WAVELENGTH, AMPLITUDE, COSINE, SINE, TEXELS = range(5)
"""Columns of an octave (5,): m; its amplitude; cosine and sine of its turn; texels per meter."""
_CELL_M = 0.7
"""Edge of the cells that hold one flat patch at most."""
_MAX_TAPS = 4
_TAP = 1.6
"""A footprint longer than this many times its width is split along its length."""
_FINEST = 1.5
"""Wavelengths below this many footprints are gone; those above twice as many are whole."""
_SMOOTH = 10.0
"""Wavelengths above this many pixels are looked up once in a pixel."""


class Look(NamedTuple):
    """What Q textured rectangles look like, in the frame of the scene.

    frames: (Q, 4, 3) float64, ORIGIN to NORMAL; style: (Q, 5) float64, RED to DENSITY
    phases: (Q, K, 2) float64, texels; octaves: (K, 5) float64, WAVELENGTH to TEXELS, coarsest first
    tile: (2^n, 2^n, 4) float32, three of mean 0; sky: (3,) float64, radiance where there is nothing
    """

    frames: np.ndarray
    style: np.ndarray
    phases: np.ndarray
    octaves: np.ndarray
    tile: np.ndarray
    sky: np.ndarray


class Hit(NamedTuple):
    """Where a ray meets a plane: m along its axes; depth, m; length of its footprint over its width; and the direction of
    that length along u and v."""

    u: float
    v: float
    depth: float
    stretch: float
    along_u: float
    along_v: float


@kernel
def _hash(i: int, j: int, key: int) -> np.uint64:
    h = np.uint64(i * 73856093) ^ np.uint64(j * 19349663) ^ np.uint64(key * 83492791)
    h = (h ^ (h >> np.uint64(31))) * np.uint64(0x9E3779B97F4A7C15)
    h = (h ^ (h >> np.uint64(29))) * np.uint64(0xBF58476D1CE4E5B9)
    return h ^ (h >> np.uint64(32))


@kernel(inline=True)
def _part(h: np.uint64, index: int) -> float:
    """The byte `index` of a hash, 0 to 1."""
    return float((h >> np.uint64(8 * index)) & np.uint64(255)) / 255.0


@kernel(inline=True)
def _overlap(x: float, half: float, foot: float) -> float:
    """The part of [x - foot/2, x + foot/2] that lies in [-half, half]."""
    low, high = max(x - 0.5 * foot, -half), min(x + 0.5 * foot, half)
    return max(high - low, 0.0) / foot


@kernel
def patch(u: float, v: float, foot: float, key: int, density: float) -> tuple[float, float, float, float]:
    """How much of a square footprint a flat patch covers, and the patch's color."""
    i, j = int(np.floor(u / _CELL_M)), int(np.floor(v / _CELL_M))
    h = _hash(i, j, key)
    if _part(h, 0) >= density:
        return 0.0, 1.0, 1.0, 1.0
    half_x, half_y = 0.03 + 0.17 * _part(h, 1), 0.03 + 0.17 * _part(h, 2)
    reach = np.sqrt(half_x * half_x + half_y * half_y)
    x = u - i * _CELL_M - reach - (_CELL_M - 2 * reach) * _part(h, 3)
    y = v - j * _CELL_M - reach - (_CELL_M - 2 * reach) * _part(h, 4)
    if max(abs(x), abs(y)) > reach + foot:
        return 0.0, 1.0, 1.0, 1.0
    angle = np.pi * _part(h, 5)
    c, s = np.cos(angle), np.sin(angle)
    covered = _overlap(c * x + s * y, half_x, foot) * _overlap(c * y - s * x, half_y, foot)
    # a few are bright enough to clip
    level = 0.35 + 1.1 * _part(h, 6) if _part(h, 6) < 0.9 else 2.6
    tint = 2 * np.pi * _part(h, 7)
    red, green, blue = 0.3 * np.cos(tint), 0.3 * np.cos(tint + 2.1), 0.3 * np.cos(tint + 4.2)
    return covered, level * (1 + red), level * (1 + green), level * (1 + blue)


@kernel
def octaves_product(
    u: float,
    v: float,
    foot: float,
    finest: float,
    first: int,
    contrast: float,
    phases: np.ndarray,
    octaves: np.ndarray,
    tile: np.ndarray,
) -> tuple[np.floating, np.floating, np.floating, int]:
    """The product of octaves from `first` down to wavelengths above `finest` (m), each of mean 1; and the next octave.

    u, v: m; foot: m, width of the footprint; phases: (K, 2) float64, texels; octaves: (K, 5) float64, tile: (2^n, 2^n, 4)
    float32, see `Look`
    """
    red = green = blue = np.float32(1.0)
    one = np.float32(1.0)
    mask = np.uint64(tile.shape[0] - 1)
    scale, k = 1.0 / (_FINEST * foot), first
    while k < octaves.shape[0]:
        octave = octaves[k]
        whole = octave[WAVELENGTH] * scale - 1.0
        if whole <= 0 or octave[WAVELENGTH] <= finest:
            break
        weight = np.float32(contrast * octave[AMPLITUDE] * min(1.0, whole))
        x = (octave[COSINE] * u - octave[SINE] * v) * octave[TEXELS] + phases[k, 0]
        y = (octave[SINE] * u + octave[COSINE] * v) * octave[TEXELS] + phases[k, 1]
        column, row = int(np.floor(x)), int(np.floor(y))
        a, b = np.float32(x - column), np.float32(y - row)
        i0, j0 = np.uint64(column) & mask, np.uint64(row) & mask
        i1, j1 = np.uint64(column + 1) & mask, np.uint64(row + 1) & mask
        w11, w01, w10 = a * b, a * (one - b), (one - a) * b
        w00 = one - w11 - w01 - w10
        p, q, r, s = tile[j0, i0], tile[j0, i1], tile[j1, i0], tile[j1, i1]
        red *= one + weight * (w00 * p[0] + w01 * q[0] + w10 * r[0] + w11 * s[0])
        green *= one + weight * (w00 * p[1] + w01 * q[1] + w10 * r[1] + w11 * s[1])
        blue *= one + weight * (w00 * p[2] + w01 * q[2] + w10 * r[2] + w11 * s[2])
        k += 1
    return red, green, blue, k


@kernel
def _meet(pose: np.ndarray, ray: np.ndarray, frame: np.ndarray) -> Hit:
    """Where a ray of the camera's frame meets a rectangle's plane. pose: (4, 4) float64, scene_from_camera"""
    x = pose[0, 0] * ray[0] + pose[0, 1] * ray[1] + pose[0, 2] * ray[2]
    y = pose[1, 0] * ray[0] + pose[1, 1] * ray[1] + pose[1, 2] * ray[2]
    z = pose[2, 0] * ray[0] + pose[2, 1] * ray[1] + pose[2, 2] * ray[2]
    origin, unit_u, unit_v, normal = frame[ORIGIN], frame[ALONG_U], frame[ALONG_V], frame[NORMAL]
    dx, dy, dz = pose[0, 3] - origin[0], pose[1, 3] - origin[1], pose[2, 3] - origin[2]
    ray_u = x * unit_u[0] + y * unit_u[1] + z * unit_u[2]
    ray_v = x * unit_v[0] + y * unit_v[1] + z * unit_v[2]
    slope = abs(x * normal[0] + y * normal[1] + z * normal[2]) + 1e-9
    depth = abs(dx * normal[0] + dy * normal[1] + dz * normal[2]) / slope
    across = np.sqrt(ray_u * ray_u + ray_v * ray_v)
    u = dx * unit_u[0] + dy * unit_u[1] + dz * unit_u[2] + depth * ray_u
    v = dx * unit_v[0] + dy * unit_v[1] + dz * unit_v[2] + depth * ray_v
    stretch = min(np.sqrt(slope * slope + across * across) / slope, 50.0)
    return Hit(u, v, depth, stretch, ray_u / (across + 1e-12), ray_v / (across + 1e-12))


@kernel
def _footprint(
    met: Hit,
    width: float,
    quad: int,
    coarse: tuple[np.floating, np.floating, np.floating, int],
    look: Look,
) -> tuple[float, float, float]:
    """The mean radiance over a footprint of `width` (m), long as its slant makes it: the mean of several squares."""
    style = look.style[quad]
    taps = min(_MAX_TAPS, int(np.ceil(met.stretch / _TAP)))
    step = width * met.stretch / taps
    foot = max(width, step)
    red = green = blue = 0.0
    for tap in range(taps):
        shift = (tap - 0.5 * (taps - 1)) * step
        u, v = met.u + shift * met.along_u, met.v + shift * met.along_v
        fine = octaves_product(
            u, v, foot, 0.0, coarse[3], style[CONTRAST], look.phases[quad], look.octaves, look.tile
        )
        covered, patch_red, patch_green, patch_blue = patch(u, v, foot, quad, style[DENSITY])
        flat = 1.0 - 0.8 * covered
        red += (1 + flat * (float(coarse[0] * fine[0]) - 1)) * (1 + covered * (patch_red - 1))
        green += (1 + flat * (float(coarse[1] * fine[1]) - 1)) * (1 + covered * (patch_green - 1))
        blue += (1 + flat * (float(coarse[2] * fine[2]) - 1)) * (1 + covered * (patch_blue - 1))
    return style[RED] * red / taps, style[GREEN] * green / taps, style[BLUE] * blue / taps


@kernel
def _pixel(
    pose: np.ndarray, rays: np.ndarray, quads: np.ndarray, width: float, look: Look, out: np.ndarray
) -> None:
    """Writes the mean radiance of a pixel's four rays."""
    one = np.float32(1.0)
    coarse = (one, one, one, 0)
    first = quads[0]
    if first >= 0 and first == quads[1] and first == quads[2] and first == quads[3]:
        # one surface: what is smooth over the pixel is looked up at its middle
        frame = look.frames[first]
        a, b = _meet(pose, rays[0], frame), _meet(pose, rays[3], frame)
        foot = 2 * width * 0.5 * (a.depth + b.depth)
        u, v, smooth = 0.5 * (a.u + b.u), 0.5 * (a.v + b.v), _SMOOTH * foot * a.stretch
        contrast = look.style[first, CONTRAST]
        coarse = octaves_product(u, v, 1e-9, smooth, 0, contrast, look.phases[first], look.octaves, look.tile)
    red = green = blue = 0.0
    for sample in range(4):
        quad = quads[sample]
        if quad < 0:
            r, g, b_ = look.sky[0], look.sky[1], look.sky[2]
        else:
            met = _meet(pose, rays[sample], look.frames[quad])
            r, g, b_ = _footprint(met, width * met.depth, quad, coarse, look)
        red, green, blue = red + r, green + g, blue + b_
    out[0], out[1], out[2] = 0.25 * red, 0.25 * green, 0.25 * blue


@parallel_kernel
def render(
    scene_from_camera: np.ndarray, rays: np.ndarray, quads: np.ndarray, width: float, look: Look
) -> np.ndarray:
    """The image (H, W, 3) float32 of mean radiances over the four rays of each pixel.

    scene_from_camera: (4, 4) float64; rays: (H, W, 4, 3) float64, camera frame, z = 1
    quads: (H, W, 4) int32, the rectangle each ray meets, -1 none
    width: what a ray stands for at depth 1, half a pixel
    """
    height, columns = quads.shape[0], quads.shape[1]
    image = np.empty((height, columns, 3), np.float32)
    for row in prange(height):
        for column in range(columns):
            _pixel(scene_from_camera, rays[row, column], quads[row, column], width, look, image[row, column])
    return image
