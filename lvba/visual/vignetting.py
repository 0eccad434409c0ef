"""How much less light arrives towards the corners of an image than in its middle, alike in all images of a camera.

What one surface looks like in two images, at different distances from the axis, says how the light falls off. Only
differences between patches of the same pair of images count: how much brighter one image is than the other is left
open, so that an exposure that drifts is not taken for vignetting, nor vignetting for that drift.
"""

from dataclasses import dataclass

import numpy as np

from lvba import lens
from lvba.camera import Camera

TERMS = 3
"""Even powers of the distance from the center in the logarithm of the light: 2, 4 and 6."""
NUMBERS = TERMS + 2
"""The coefficients of these, and where the center is."""
PRIOR_SIGMA = np.array([1.0, 1.0, 1.0, 0.02, 0.02])
"""Standard deviations about zero where patches say nothing. Of each coefficient: a loss of 60 % is a sum of 0.9; of the
center: lenses sit within some pixels of where they are calibrated."""
LEAST_LIGHT = 0.2
"""Light left at the corner below which the result is refused: lenses keep more."""
SMALLEST = 0.01
"""Loss at the corner below which there is taken to be none: gloss alone looks like that much."""
SIGNIFICANCE = 3.0
"""Standard deviations by which the loss must exceed its error somewhere in the image."""
RISE = 0.003
"""By how much light may seem to grow again farther out: an error of the fit, not of a lens."""
_FAR = 10.0
"""Half diagonals from the principal point that no pixel is beyond, but where a lens model has no meaning."""
_PLACES = np.linspace(0.0, 1.0, 41) ** 2
"""Squares of distances from the center at which a result is looked at."""


@dataclass(frozen=True)
class Vignetting:
    """The light at a distance rho from the center, over that in the middle: exp(sum of a_k rho^2k).

    Places and distances are those in the raw image from its principal point, over half its diagonal.
    coefficients: a_1 to a_3; all 0: none was found, or it was held at none
    center: where it is greatest
    loss_sigma: standard deviation of the part of the light that is missing at rho = 1; inf: nothing was measured
    """

    coefficients: tuple[float, float, float] = (0.0, 0.0, 0.0)
    center: tuple[float, float] = (0.0, 0.0)
    loss_sigma: float = float("inf")

    def __bool__(self) -> bool:
        return any(self.coefficients)

    @property
    def numbers(self) -> np.ndarray:
        """(5,) float64: coefficients and center."""
        return np.array([*self.coefficients, *self.center])

    @property
    def corner_loss(self) -> float:
        """The part of the light that is missing at rho = 1."""
        return 1.0 - float(np.exp(sum(self.coefficients)))

    def log_light(self, places: np.ndarray) -> np.ndarray:
        """(N,) float64 at places (N, 2) float64; beyond rho = 1 as there."""
        return np.asarray(np.einsum("nk,k->n", _powers(_squares(self, places)), self.coefficients))


NONE = Vignetting()


def of_numbers(numbers: np.ndarray | None, loss_sigma: float = float("inf")) -> Vignetting:
    """The vignetting of some numbers; NONE of None. numbers: (5,) float64, coefficients and center"""
    if numbers is None:
        return NONE
    a, b, c, right, down = (float(value) for value in numbers)
    return Vignetting((a, b, c), (right, down), loss_sigma)


@dataclass(frozen=True)
class FalloffSums:
    """Normal equations of the numbers of a vignetting, by block of the surface.

    information: (B, 5, 5) float64; gradient: (B, 5) float64, so that one over the other is the numbers
    """

    information: np.ndarray
    gradient: np.ndarray


@dataclass(frozen=True)
class PairPlaces:
    """Where patches are in their reference and in their target image, each (N, 2) float64, as of `Vignetting`."""

    reference: np.ndarray
    target: np.ndarray

    def log_ratio(self, vignette: Vignetting) -> np.ndarray:
        """(N,) float64: log of the light in the target over that in the reference."""
        return np.asarray(vignette.log_light(self.target) - vignette.log_light(self.reference))

    def by_numbers(self, vignette: Vignetting) -> np.ndarray:
        """(N, 5) float64: derivative of `log_ratio` by the numbers."""
        return np.asarray(_by_numbers(vignette, self.target) - _by_numbers(vignette, self.reference))


def places(camera: Camera, pinhole: Camera, pixels: np.ndarray) -> np.ndarray:
    """(N, 2) float64: where pixels of an undistorted image are in the raw one, as of `Vignetting`.

    camera: of the raw images; pinhole: of the undistorted ones, at any size; pixels: (N, 2) float64, px
    """
    x, y = pinhole.normalized(pixels)
    with np.errstate(over="ignore", invalid="ignore"):
        u, v = lens.distort(camera.lens, camera.distortion, x, y)
        place = np.stack([camera.fx * u, camera.fy * v], axis=1) / (
            0.5 * np.hypot(camera.width, camera.height)
        )
    return np.asarray(np.clip(np.nan_to_num(place, nan=_FAR), -_FAR, _FAR))


def light_of_pixels(vignette: Vignetting, camera: Camera, pinhole: Camera) -> np.ndarray:
    """(H, W) float32: the light at each pixel of undistorted images. camera, pinhole: as of `places`"""
    column, row = np.meshgrid(np.arange(pinhole.width), np.arange(pinhole.height))
    pixels = np.stack([column.ravel(), row.ravel()], axis=1).astype(float)
    light = np.exp(vignette.log_light(places(camera, pinhole, pixels)))
    return np.asarray(light.reshape(pinhole.height, pinhole.width), np.float32)


def solve(known: FalloffSums) -> Vignetting:
    """The vignetting that the sums tell: none where it is not significant, or no lens has such.

    With fewer terms where all three give a light that grows again farther out.
    """
    information, gradient = known.information.sum(axis=0), known.gradient.sum(axis=0)
    if not information.any():
        return NONE
    covariance = _covariance(known)[:TERMS, :TERMS]
    sigma = np.sqrt(np.einsum("nk,kl,nl->n", _powers(_PLACES), covariance, _powers(_PLACES)))
    for terms in range(TERMS, 0, -1):
        numbers = _solved(information, gradient, terms)
        log_light = np.einsum("nk,k->n", _powers(_PLACES), numbers[:TERMS])
        light = np.exp(log_light)
        if (light <= np.minimum.accumulate(light) + RISE).all() and light[-1] >= LEAST_LIGHT:
            significant = (-log_light > SIGNIFICANCE * sigma)[1:].any() and 1 - light.min() >= SMALLEST
            return of_numbers(numbers if significant else NONE.numbers, float(light[-1] * sigma[-1]))
    return Vignetting(loss_sigma=float(sigma[-1]))


def _solved(information: np.ndarray, gradient: np.ndarray, terms: int) -> np.ndarray:
    """(5,): the numbers that fit best, the later coefficients 0; where nothing tells, the prior does."""
    free = np.r_[:terms, TERMS:NUMBERS]
    numbers = np.zeros(NUMBERS)
    numbers[free] = np.linalg.solve(_with_prior(information)[np.ix_(free, free)], gradient[free])
    return numbers


def _with_prior(information: np.ndarray) -> np.ndarray:
    return np.asarray(information + np.diag(1 / PRIOR_SIGMA**2))


def _covariance(known: FalloffSums) -> np.ndarray:
    """(5, 5): of the numbers, by leaving out one block of the surface in turn: patches on one surface err alike."""
    information, gradient = known.information.sum(axis=0), known.gradient.sum(axis=0)
    change = np.array(
        [
            _solved(information - own, gradient - its, TERMS) - _solved(information, gradient, TERMS)
            for own, its in zip(known.information, known.gradient, strict=True)
        ]
    )
    count = len(change)
    spread = (count - 1) / count * np.einsum("bk,bl->kl", change, change)
    return np.asarray(spread + np.linalg.inv(_with_prior(information)))


def _squares(vignette: Vignetting, places: np.ndarray) -> np.ndarray:
    """(N,): of rho, at most 1."""
    right, down = (places[:, axis] - vignette.center[axis] for axis in range(2))
    return np.asarray(np.minimum(right * right + down * down, 1.0))


def _by_numbers(vignette: Vignetting, places: np.ndarray) -> np.ndarray:
    """(N, 5): derivative of the log of the light by the numbers."""
    square = _squares(vignette, places)
    a, b, c = vignette.coefficients
    slope = a + square * (2 * b + square * 3 * c)
    by_center = -2 * slope[:, None] * (places - np.array(vignette.center))
    return np.concatenate([_powers(square), np.where(square[:, None] < 1, by_center, 0.0)], axis=1)


def _powers(square: np.ndarray) -> np.ndarray:
    """(..., 3): the square, its square and its cube."""
    return np.stack([square, square * square, square * square * square], axis=-1)
