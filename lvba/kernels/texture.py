"""The radiance of textured rectangles as a pixel sees it: every detail fades to its mean before it is too fine."""

import numpy as np
from numba import njit, prange

_CELL_M = 0.7
"""Edge of the cells that hold one flat patch at most."""
_MAX_TAPS = 4
_TAP = 1.6
"""A footprint longer than this many times its width is split along its length."""
_FINEST = 1.5
"""Wavelengths below this many footprints are gone; those above twice as many are whole."""
_SMOOTH = 10.0
"""Wavelengths above this many pixels are looked up once in a pixel."""


@njit(cache=True, nogil=True, error_model="numpy")
def _hash(i: int, j: int, key: int) -> np.uint64:
    h = np.uint64(i * 73856093) ^ np.uint64(j * 19349663) ^ np.uint64(key * 83492791)
    h = (h ^ (h >> np.uint64(31))) * np.uint64(0x9E3779B97F4A7C15)
    h = (h ^ (h >> np.uint64(29))) * np.uint64(0xBF58476D1CE4E5B9)
    return h ^ (h >> np.uint64(32))


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _part(h: np.uint64, index: int) -> float:
    """The byte `index` of a hash, 0 to 1."""
    return float((h >> np.uint64(8 * index)) & np.uint64(255)) / 255.0


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _overlap(x: float, half: float, foot: float) -> float:
    """The part of [x - foot/2, x + foot/2] that lies in [-half, half]."""
    low, high = max(x - 0.5 * foot, -half), min(x + 0.5 * foot, half)
    return max(high - low, 0.0) / foot


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
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

    phases: (K, 2) float64, texels
    octaves: (K, 5) float64: wavelength (m), amplitude, cosine and sine of its turn, texels per meter
    """
    red = green = blue = np.float32(1.0)
    one = np.float32(1.0)
    mask = np.uint64(tile.shape[0] - 1)
    scale, k = 1.0 / (_FINEST * foot), first
    while k < octaves.shape[0]:
        whole = octaves[k, 0] * scale - 1.0
        if whole <= 0 or octaves[k, 0] <= finest:
            break
        weight = np.float32(contrast * octaves[k, 1] * min(1.0, whole))
        x = (octaves[k, 2] * u - octaves[k, 3] * v) * octaves[k, 4] + phases[k, 0]
        y = (octaves[k, 3] * u + octaves[k, 2] * v) * octaves[k, 4] + phases[k, 1]
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


@njit(cache=True, nogil=True, error_model="numpy")
def _meet(
    center: np.ndarray, turn: np.ndarray, ray: np.ndarray, frame: np.ndarray
) -> tuple[float, float, float, float, float, float]:
    """Where a ray meets a plane: u, v, depth; how long its footprint is to its width; and its direction along u, v."""
    x = turn[0, 0] * ray[0] + turn[0, 1] * ray[1] + turn[0, 2] * ray[2]
    y = turn[1, 0] * ray[0] + turn[1, 1] * ray[1] + turn[1, 2] * ray[2]
    z = turn[2, 0] * ray[0] + turn[2, 1] * ray[1] + turn[2, 2] * ray[2]
    dx, dy, dz = center[0] - frame[0, 0], center[1] - frame[0, 1], center[2] - frame[0, 2]
    ray_u = x * frame[1, 0] + y * frame[1, 1] + z * frame[1, 2]
    ray_v = x * frame[2, 0] + y * frame[2, 1] + z * frame[2, 2]
    slope = abs(x * frame[3, 0] + y * frame[3, 1] + z * frame[3, 2]) + 1e-9
    depth = abs(dx * frame[3, 0] + dy * frame[3, 1] + dz * frame[3, 2]) / slope
    across = np.sqrt(ray_u * ray_u + ray_v * ray_v)
    u = dx * frame[1, 0] + dy * frame[1, 1] + dz * frame[1, 2] + depth * ray_u
    v = dx * frame[2, 0] + dy * frame[2, 1] + dz * frame[2, 2] + depth * ray_v
    stretch = min(np.sqrt(slope * slope + across * across) / slope, 50.0)
    return u, v, depth, stretch, ray_u / (across + 1e-12), ray_v / (across + 1e-12)


@njit(cache=True, nogil=True, error_model="numpy")
def _footprint(
    met: tuple[float, float, float, float, float, float],
    width: float,
    quad: int,
    coarse: tuple[np.floating, np.floating, np.floating, int],
    style: np.ndarray,
    phases: np.ndarray,
    octaves: np.ndarray,
    tile: np.ndarray,
) -> tuple[float, float, float]:
    """The mean radiance over a footprint of `width` (m), long as its slant makes it: the mean of several squares."""
    u, v, _, stretch, along_u, along_v = met
    taps = min(_MAX_TAPS, int(np.ceil(stretch / _TAP)))
    step = width * stretch / taps
    foot = max(width, step)
    red = green = blue = 0.0
    for tap in range(taps):
        shift = (tap - 0.5 * (taps - 1)) * step
        at_u, at_v = u + shift * along_u, v + shift * along_v
        fine = octaves_product(at_u, at_v, foot, 0.0, coarse[3], style[3], phases, octaves, tile)
        covered, patch_red, patch_green, patch_blue = patch(at_u, at_v, foot, quad, style[4])
        flat = 1.0 - 0.8 * covered
        red += (1 + flat * (float(coarse[0] * fine[0]) - 1)) * (1 + covered * (patch_red - 1))
        green += (1 + flat * (float(coarse[1] * fine[1]) - 1)) * (1 + covered * (patch_green - 1))
        blue += (1 + flat * (float(coarse[2] * fine[2]) - 1)) * (1 + covered * (patch_blue - 1))
    return style[0] * red / taps, style[1] * green / taps, style[2] * blue / taps


@njit(cache=True, nogil=True, error_model="numpy")
def _pixel(
    center: np.ndarray,
    turn: np.ndarray,
    rays: np.ndarray,
    quads: np.ndarray,
    width: float,
    frames: np.ndarray,
    style: np.ndarray,
    phases: np.ndarray,
    octaves: np.ndarray,
    tile: np.ndarray,
    sky: np.ndarray,
    out: np.ndarray,
) -> None:
    """Writes the mean radiance of a pixel's four rays."""
    one = np.float32(1.0)
    coarse = (one, one, one, 0)
    first = quads[0]
    if first >= 0 and first == quads[1] and first == quads[2] and first == quads[3]:
        # one surface: what is smooth over the pixel is looked up at its middle
        a, b = _meet(center, turn, rays[0], frames[first]), _meet(center, turn, rays[3], frames[first])
        foot = 2 * width * 0.5 * (a[2] + b[2])
        coarse = octaves_product(
            0.5 * (a[0] + b[0]),
            0.5 * (a[1] + b[1]),
            1e-9,
            _SMOOTH * foot * a[3],
            0,
            style[first, 3],
            phases[first],
            octaves,
            tile,
        )
    red = green = blue = 0.0
    for sample in range(4):
        quad = quads[sample]
        if quad < 0:
            r, g, b_ = sky[0], sky[1], sky[2]
        else:
            met = _meet(center, turn, rays[sample], frames[quad])
            r, g, b_ = _footprint(met, width * met[2], quad, coarse, style[quad], phases[quad], octaves, tile)
        red, green, blue = red + r, green + g, blue + b_
    out[0], out[1], out[2] = 0.25 * red, 0.25 * green, 0.25 * blue


@njit(parallel=True, cache=True, nogil=True, error_model="numpy")
def render(
    center: np.ndarray,
    turn: np.ndarray,
    rays: np.ndarray,
    quads: np.ndarray,
    width: float,
    frames: np.ndarray,
    style: np.ndarray,
    phases: np.ndarray,
    octaves: np.ndarray,
    tile: np.ndarray,
    sky: np.ndarray,
) -> np.ndarray:
    """The image (H, W, 3) float32 of mean radiances over the four rays of each pixel.

    center: (3,) float64, m, and turn: (3, 3) float64: scene_from_camera
    rays: (H, W, 4, 3) float64, camera frame, z = 1; quads: (H, W, 4) int32, the rectangle each ray meets, -1 none
    width: what a ray stands for at depth 1, half a pixel
    frames: (Q, 4, 3) float64: origin, unit u, unit v, normal; style: (Q, 5) float64: color, contrast, patch density
    phases: (Q, K, 2), octaves: (K, 5), see `octaves_product`; tile: (2^n, 2^n, 4) float32, three of mean 0
    sky: (3,) float64, radiance where there is nothing
    """
    height, columns = quads.shape[0], quads.shape[1]
    image = np.empty((height, columns, 3), np.float32)
    for row in prange(height):
        for column in range(columns):
            _pixel(
                center,
                turn,
                rays[row, column],
                quads[row, column],
                width,
                frames,
                style,
                phases,
                octaves,
                tile,
                sky,
                image[row, column],
            )
    return image
