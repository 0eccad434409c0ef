"""Lens distortion: how far from the axis a ray is imaged, as in OpenCV and COLMAP.

Normalized coordinates are pixels with the principal point taken off, divided by the focal length. All after undistortion
(`lvba.visual.image`) is a pinhole.
"""

from enum import StrEnum

import numpy as np

_NEWTON_STEPS = 60
_CLOSE = 1e-13
_FARTHEST = 1e6
"""Normalized coordinates beyond which no ray of a pinhole is looked for."""
_ANGLES = 4000
"""In how many steps the monotone limit is looked for, up to 180 degrees."""


class Lens(StrEnum):
    """The model of a distortion, and its coefficients."""

    RADIAL_TANGENTIAL = "radial-tangential"
    """Brown-Conrady: k1 k2 p1 p2, with k3 also, or with k3 k4 k5 k6 (rational)."""
    EQUIDISTANT = "equidistant"
    """Kannala-Brandt: k1 k2 k3 k4 of the angle off the axis."""


def distort(
    lens: Lens, coefficients: tuple[float, ...], x: np.ndarray, y: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distorted normalized coordinates, float64 of the shape of x and y, of rays (x, y, 1) in the camera frame.

    Source: the OpenCV documentation, "Camera Calibration and 3D Reconstruction" and "Fisheye camera model".
    x, y: (...) float64, of one shape, x / z and y / z of rays
    """
    if lens is Lens.EQUIDISTANT:
        tangent = np.hypot(x, y)
        angle = np.arctan(tangent)
        with np.errstate(invalid="ignore", divide="ignore"):
            factor = np.where(tangent > 1e-12, _bent(coefficients, angle) / tangent, 1.0)
        return x * factor, y * factor
    k1, k2, p1, p2, k3, k4, k5, k6 = (*coefficients, *(0.0,) * (8 - len(coefficients)))
    square = x * x + y * y
    radial = 1 + square * (k1 + square * (k2 + square * k3))
    if k4 or k5 or k6:
        radial = radial / (1 + square * (k4 + square * (k5 + square * k6)))
    return (
        x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x),
        y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
    )


def undistort(
    lens: Lens, coefficients: tuple[float, ...], u: np.ndarray, v: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The (x, y), float64, of the rays (x, y, 1) that `distort` takes to (u, v), to 1e-12.

    Beyond the monotone limit of the lens there is none; what comes back there is at the limit or has no meaning.
    u, v: (...) float64, of one shape, distorted x / z and y / z
    """
    if lens is Lens.EQUIDISTANT:
        return _undistort_equidistant(coefficients, u, v)
    x, y = u, v
    for _ in range(_NEWTON_STEPS):
        again_u, again_v = distort(lens, coefficients, x, y)
        # beyond the monotone limit each step goes farther than the last
        x = np.clip(x + (u - again_u), -_FARTHEST, _FARTHEST)
        y = np.clip(y + (v - again_v), -_FARTHEST, _FARTHEST)
        if max(np.abs(u - again_u).max(initial=0), np.abs(v - again_v).max(initial=0)) < 1e-12:
            break
    return x, y


def widest_angle(lens: Lens, coefficients: tuple[float, ...]) -> float:
    """Radians off the axis up to which a larger angle is imaged farther out; pi / 2 at most, where a pinhole ends.

    Beyond, the polynomial folds back: a pixel there would be taken for another place.
    """
    angle = np.linspace(0, np.pi / 2, _ANGLES, endpoint=False)
    if lens is Lens.EQUIDISTANT:
        imaged = _bent(coefficients, angle)
    else:
        radial = (*coefficients[:2], 0.0, 0.0, *coefficients[4:])
        imaged, _ = distort(lens, radial, np.tan(angle), np.zeros_like(angle))
    back = np.flatnonzero(~(np.diff(imaged) > 0))
    return float(angle[back[0]]) if len(back) else np.pi / 2


def _bent(coefficients: tuple[float, ...], angle: np.ndarray) -> np.ndarray:
    """Distance from the axis at which an angle (rad) off it is imaged, normalized."""
    k1, k2, k3, k4 = coefficients
    square = angle * angle
    return np.asarray(angle * (1 + square * (k1 + square * (k2 + square * (k3 + square * k4)))))


def _slope(coefficients: tuple[float, ...], angle: np.ndarray) -> np.ndarray:
    k1, k2, k3, k4 = coefficients
    square = angle * angle
    return np.asarray(1 + square * (3 * k1 + square * (5 * k2 + square * (7 * k3 + square * 9 * k4))))


def _undistort_equidistant(
    coefficients: tuple[float, ...], u: np.ndarray, v: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    distance = np.hypot(u, v)
    largest = widest_angle(Lens.EQUIDISTANT, coefficients)
    angle = np.clip(distance, 0, largest)
    for _ in range(_NEWTON_STEPS):
        slope = np.maximum(_slope(coefficients, angle), 1e-3)
        step = (distance - _bent(coefficients, angle)) / slope
        angle = np.clip(angle + step, 0, largest)
        if np.abs(step).max(initial=0) < _CLOSE:
            break
    with np.errstate(invalid="ignore", divide="ignore"):
        factor = np.where(distance > 1e-12, np.tan(angle) / distance, 1.0)
    return u * factor, v * factor
