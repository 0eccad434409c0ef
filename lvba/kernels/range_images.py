"""Range images of single scans, and which points of one scan others see through: what was there has moved.

An image is a cube about the sensor, of six faces with n x n cells of about equal angles: no direction is at a pole.
"""

import numpy as np
from numba import prange

from lvba.kernels.compiled import kernel, parallel_kernel

MARGIN_M, MARGIN_PART = 0.3, 0.03
"""Ranges that differ by less than the larger of this and this part of them may be of one surface."""
_NEAREST_M = 1.0
"""Nearer to a sensor a point is not asked for: many measure nothing there."""
_FEWEST_FILLED = 4
"""Of the nine cells about a point that show something, for the scan to say what is there."""
_CHUNK = 256


@kernel(inline=True)
def _bent(u: np.floating) -> np.floating:
    """4 / pi arctan(u) of -1 <= u <= 1, within 0.5 %: cells of about equal angles."""
    return u * (np.float32(1.0) + np.float32(0.3476) * (np.float32(1.0) - abs(u)))


@kernel
def cell_of(x: np.floating, y: np.floating, z: np.floating, n: int) -> tuple[int, int, int]:
    """Face, row and column of the cell of a direction (of any length)."""
    ax, ay, az = abs(x), abs(y), abs(z)
    if ax >= ay and ax >= az:
        face, u, v, w, sign = 0, y, z, ax, x
    elif ay >= az:
        face, u, v, w, sign = 2, x, z, ay, y
    else:
        face, u, v, w, sign = 4, x, y, az, z
    if sign < 0:
        face += 1
    half = np.float32(0.5) * np.float32(n)
    row = int((_bent(v / w) + np.float32(1.0)) * half)
    column = int((_bent(u / w) + np.float32(1.0)) * half)
    return face, min(max(row, 0), n - 1), min(max(column, 0), n - 1)


@kernel
def range_image(points: np.ndarray, n: int) -> np.ndarray:
    """The nearest range, m, in each cell, (6, n, n) float32, inf where there is nothing.

    points: (N, 3) float32, m, from the sensor
    """
    image = np.full((6, n, n), np.inf, np.float32)
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        distance = np.sqrt(x * x + y * y + z * z)
        if not 0 < distance < np.inf:
            continue
        face, row, column = cell_of(x, y, z, n)
        if distance < image[face, row, column]:
            image[face, row, column] = distance
    return image


@kernel
def _look(face: np.ndarray, row: int, column: int, distance: np.floating) -> int:
    """What a face of an image says of a point: 1 something is there, -1 it is seen through, 0 nothing.

    Through, only where cells on both sides of it, or its own, show something, and all that they show is behind it.
    """
    n = len(face)
    margin = max(np.float32(MARGIN_M), np.float32(MARGIN_PART) * distance)
    nearest, filled, shown = np.float32(np.inf), 0, 0
    for a in range(-1, 2):
        for b in range(-1, 2):
            r, c = row + a, column + b
            if r < 0 or r >= n or c < 0 or c >= n or face[r, c] == np.inf:
                continue
            if abs(face[r, c] - distance) < margin:
                return 1
            nearest = min(nearest, face[r, c])
            filled += 1
            shown |= 1 << (3 * (a + 1) + b + 1)
    if filled < _FEWEST_FILLED or nearest < distance:
        return 0
    around = (shown >> 4) & 1
    for k in range(4):
        around |= (shown >> k) & (shown >> (8 - k)) & 1
    return -around


@parallel_kernel
def seen_through(points: np.ndarray, images: np.ndarray, image_from_points: np.ndarray) -> np.ndarray:
    """Whether other scans see through points, (N,) bool: at least two do, and more than twice as many as have something
    there.

    points: (N, 3) float32, m; images: (L, 6, n, n) float32 m, of `range_image`
    image_from_points: (L, 3, 4) float32, into the frames of the images, whose origins are the sensors
    """
    through = np.zeros(len(points), np.bool_)
    looks, n = len(images), images.shape[2]
    for chunk in prange(-(-len(points) // _CHUNK)):
        at = np.empty(3, np.float32)
        for i in range(chunk * _CHUNK, min(len(points), (chunk + 1) * _CHUNK)):
            behind, there = 0, 0
            for k in range(looks):
                # what is left to say would not change it
                if behind + looks - k <= max(1, 2 * there):
                    break
                for a in range(3):
                    at[a] = image_from_points[k, a, 3]
                    for b in range(3):
                        at[a] += image_from_points[k, a, b] * points[i, b]
                distance = np.sqrt(at[0] * at[0] + at[1] * at[1] + at[2] * at[2])
                if not _NEAREST_M <= distance < np.inf:
                    continue
                face, row, column = cell_of(at[0], at[1], at[2], n)
                says = _look(images[k, face], row, column, distance)
                behind += says < 0
                there += says > 0
            through[i] = behind >= 2 and behind > 2 * there
    return through
