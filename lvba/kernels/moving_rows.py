"""Where the rows of images are that are read one after another while the camera moves.

A camera that is `T` at its middle row is `T exp(s v)` at a row that is read a part s of the readout time later, v being
how far it moves during all of it. Vectors are turned by the series of Rodrigues' formula, without a matrix for each row.
"""

import math

import numpy as np
from numba import prange

from lvba.kernels.compiled import kernel, parallel_kernel
from lvba.kernels.scene import Intrinsics, PlanePatches

_CHUNK = 256
_ROW_STEPS = 3
"""Times that the row of a pixel is looked up where it has moved to: rows 20 px off are right to .01 px."""
_STEP = 8
"""px, between pixels whose way is found one by one."""
_SMALL_ANGLE = 1e-2
"""rad, below which the series take the place of differences of nearly equal numbers: their next term is 1e-14 there."""


@parallel_kernel
def onto_planes(
    point: np.ndarray,
    poses: np.ndarray,
    over: np.ndarray,
    part: np.ndarray,
    intrinsics: Intrinsics,
    patches: PlanePatches,
) -> np.ndarray:
    """(O, 3) float64, m, world: what the pixels of patches show on their planes, each row read where the camera was then.

    point: (O,) int32, patches; poses: (I, 4, 4) float64, world_from_camera at the middle rows
    over: (I, 6) float64 `[rotation | translation]`, rad and m, the motion of each camera during its readout
    part: (O,) float64, of the readout time, when the row of each is read after the middle one; patches: `pixel` float64
    """
    world = np.empty((len(point), 3))
    for chunk in prange(-(-len(point) // _CHUNK)):
        phi, shift, ray, along, origin = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
        for o in range(chunk * _CHUNK, min(len(point), (chunk + 1) * _CHUNK)):
            p = point[o]
            r = patches.reference[p]
            first, second = _motion(over[r], part[o], phi, shift)
            ray[0] = (patches.pixel[p, 0] - intrinsics.cx) / intrinsics.fx
            ray[1] = (patches.pixel[p, 1] - intrinsics.cy) / intrinsics.fy
            ray[2] = 1.0
            _with_crosses(phi, first, second, ray, along)
            above, slant = 0.0, 0.0
            pose = poses[r]
            for i in range(3):
                origin[i] = pose[i, 3] + pose[i, 0] * shift[0] + pose[i, 1] * shift[1] + pose[i, 2] * shift[2]
                ray[i] = pose[i, 0] * along[0] + pose[i, 1] * along[1] + pose[i, 2] * along[2]
                above += patches.normal[p, i] * (patches.position[p, i] - origin[i])
                slant += patches.normal[p, i] * ray[i]
            for i in range(3):
                world[o, i] = origin[i] + ray[i] * (above / slant)
    return world


@parallel_kernel
def into_images(
    world: np.ndarray,
    image: np.ndarray,
    poses: np.ndarray,
    over: np.ndarray,
    part: np.ndarray,
    intrinsics: Intrinsics,
) -> np.ndarray:
    """(O, 2) float64, px: where points are in images of which each row is read where the camera was then.

    world: (O, 3) float64, m; image: (O,) int32; poses, over, part: as in `onto_planes`, part of the row that shows it
    """
    place = np.empty((len(world), 2))
    for chunk in prange(-(-len(world) // _CHUNK)):
        phi, shift, away, local = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
        for o in range(chunk * _CHUNK, min(len(world), (chunk + 1) * _CHUNK)):
            pose = poses[image[o]]
            first, second = _motion(over[image[o]], part[o], phi, shift)
            for i in range(3):
                away[i] = -shift[i]
                for j in range(3):
                    away[i] += pose[j, i] * (world[o, j] - pose[j, 3])
            _with_crosses(phi, -first, second, away, local)
            place[o, 0] = local[0] / local[2] * intrinsics.fx + intrinsics.cx
            place[o, 1] = local[1] / local[2] * intrinsics.fy + intrinsics.cy
    return place


@kernel
def turned_back(
    across: np.ndarray,
    down: np.ndarray,
    intrinsics: Intrinsics,
    over: np.ndarray,
    height: int,
    turned_across: np.ndarray,
    turned_down: np.ndarray,
) -> None:
    """Fills where in a raw image that was read row by row the pixels of an undistorted one are that was taken at once.

    across, down: (H, W) float32, px: where in the raw image each pixel of the undistorted one is, if all rows are read at
    once. over: (3,) float64, rad, how far the camera turns about its own axes while all `height` rows are read
    turned_across, turned_down: (H, W) float32, px. Of rays alone: how far the camera moves during the readout is left in.
    By how much pixels move is found for one in `_STEP` each way, and is linear between these.
    """
    moved = np.empty(((down.shape[0] - 2) // _STEP + 2, (down.shape[1] - 2) // _STEP + 2, 2))
    phi, ray, local = np.empty(3), np.empty(3), np.empty(3)
    ray[2] = 1.0
    for j in range(moved.shape[0]):
        ray[1] = (j * _STEP - intrinsics.cy) / intrinsics.fy
        for i in range(moved.shape[1]):
            ray[0] = (i * _STEP - intrinsics.cx) / intrinsics.fx
            before_x, before_y = _at(across, i * _STEP, j * _STEP), _at(down, i * _STEP, j * _STEP)
            x, y = before_x, before_y
            for _ in range(_ROW_STEPS):
                part = y / height - 0.5
                square = 0.0
                for axis in range(3):
                    phi[axis] = part * over[axis]
                    square += phi[axis] ** 2
                # a turn of .1 rad is right to 1e-5 rad
                _with_crosses(phi, -(1 - square / 6), 0.5 - square / 24, ray, local)
                u = local[0] / local[2] * intrinsics.fx + intrinsics.cx
                v = local[1] / local[2] * intrinsics.fy + intrinsics.cy
                x, y = _at(across, u, v), _at(down, u, v)
            moved[j, i, 0], moved[j, i, 1] = x - before_x, y - before_y
    along = np.empty((moved.shape[1], 2), np.float32)
    for row in range(down.shape[0]):
        j = row // _STEP
        b = (row - j * _STEP) / _STEP
        for i in range(moved.shape[1]):
            for axis in range(2):
                along[i, axis] = (1 - b) * moved[j, i, axis] + b * moved[j + 1, i, axis]
        for i in range(moved.shape[1] - 1):
            x, y = along[i, 0], along[i, 1]
            per_x, per_y = (
                (along[i + 1, 0] - x) / np.float32(_STEP),
                (along[i + 1, 1] - y) / np.float32(_STEP),
            )
            first = i * _STEP
            for column in range(first, min(first + _STEP, down.shape[1])):
                turned_across[row, column] = across[row, column] + (x + np.float32(column - first) * per_x)
                turned_down[row, column] = down[row, column] + (y + np.float32(column - first) * per_y)


@kernel
def _at(values: np.ndarray, x: float, y: float) -> float:
    """Values (H, W) at a place, linear between pixels, and on beyond the rim."""
    column = min(max(math.floor(x), 0), values.shape[1] - 2)
    row = min(max(math.floor(y), 0), values.shape[0] - 2)
    a, b = x - column, y - row
    above = (1 - a) * values[row, column] + a * values[row, column + 1]
    below = (1 - a) * values[row + 1, column] + a * values[row + 1, column + 1]
    return (1 - b) * above + b * below


@kernel
def _motion(over: np.ndarray, part: float, phi: np.ndarray, shift: np.ndarray) -> tuple[float, float]:
    """Fills the rotation vector phi (3,), rad, and the translation (3,), m, of exp(part * over). Returns what
    `_with_crosses` turns vectors by phi with; the first one negative: back."""
    for i in range(3):
        phi[i] = part * over[i]
    square = phi[0] ** 2 + phi[1] ** 2 + phi[2] ** 2
    angle = math.sqrt(square)
    if angle < _SMALL_ANGLE:
        first = 1 - square / 6 + square**2 / 120
        second = 0.5 - square / 24 + square**2 / 720
        third = 1 / 6 - square / 120 + square**2 / 5040
    else:
        first = math.sin(angle) / angle
        second = 2 * (math.sin(angle / 2) / angle) ** 2
        third = (angle - math.sin(angle)) / (square * angle)
    _with_crosses(phi, second, third, over[3:], shift)
    for i in range(3):
        shift[i] *= part
    return first, second


@kernel
def _with_crosses(phi: np.ndarray, once: float, twice: float, vector: np.ndarray, out: np.ndarray) -> None:
    """Fills v + once * (phi x v) + twice * (phi x (phi x v)) (3,)."""
    x = phi[1] * vector[2] - phi[2] * vector[1]
    y = phi[2] * vector[0] - phi[0] * vector[2]
    z = phi[0] * vector[1] - phi[1] * vector[0]
    out[0] = vector[0] + once * x + twice * (phi[1] * z - phi[2] * y)
    out[1] = vector[1] + once * y + twice * (phi[2] * x - phi[0] * z)
    out[2] = vector[2] + once * z + twice * (phi[0] * y - phi[1] * x)
