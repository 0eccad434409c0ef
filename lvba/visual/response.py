"""The response curve of a camera, as far as ratios of exposures tell of it: all but one power.

Grey values of one surface at two exposures say how light grows with grey value. Light to any power explains all ratios
as well, with exposures to the same power: which one it is cannot be observed. So what is estimated is how the slope of
log light over log grey value changes from dark to bright, about a mean of 1; exposures are then those of the images,
the true ones to one unknown power. A camera whose grey values are a power of the light needs no correction.
"""

from dataclasses import dataclass

import numpy as np

from lvba.arrays import Images
from lvba.kernels import edge_sums
from lvba.visual.image import DARK, SATURATED

GREY_VALUES = (30.0, 60.0, 100.0, 140.0, 180.0, 215.0, 245.0)
KNOTS = np.log(GREY_VALUES)
"""Log grey values at which slopes are estimated: linear in between, constant beyond. Shoulders of curves are steep."""
SLOPES = len(KNOTS)
STEP_SIGMA = 0.5
"""Standard deviation about zero of the change of slope from knot to knot: a filmic curve's largest is 0.8, of sRGB 0.15.
Where nothing is seen, the slope stays as it is at the next knot that is."""
SIGNIFICANCE = 6.0
"""Standard deviations by which the slope must differ from 1 at a knot, as corrections of the calibration do."""
SMALLEST = 0.05
"""Least such difference: ratios of exposures off by a twentieth of their logarithm between dark and bright."""
STEEPEST = 10.0
"""Slope that no camera has, as has none a tenth."""


@dataclass(frozen=True)
class Response:
    """Of all images of a camera.

    slopes: of log light over log grey value at KNOTS, relative to their mean; empty: none was found
    sigma: standard deviation of the slope that is known best; inf: nothing was measured
    """

    slopes: tuple[float, ...] = ()
    sigma: float = float("inf")

    def __bool__(self) -> bool:
        return bool(self.slopes)

    @property
    def numbers(self) -> np.ndarray:
        """(SLOPES,) float64: slopes less 1; zeros without a curve."""
        return np.array(self.slopes) - 1.0 if self.slopes else np.zeros(SLOPES)

    @property
    def table(self) -> np.ndarray:
        """(2, SLOPES) float64: grey values and the slopes there."""
        return np.stack([np.array(GREY_VALUES), 1 + self.numbers])

    def log_light(self, log_grey: np.ndarray) -> np.ndarray:
        """(N,) float64: log of the light, that of a grey value of 255 as its own. log_grey: (N,) float64"""
        return np.asarray(
            log_grey + np.einsum("nk,k->n", integrals(log_grey) - integrals(_FULL), self.numbers)
        )

    def then(self, other: "Response") -> "Response":
        """This curve and another one of the light that it gives, as one; no steeper or flatter than cameras have them."""
        slopes = np.array(self.slopes or np.ones(SLOPES)) * other.slope(self.log_light(KNOTS))
        possible = np.clip(slopes, 1 / STEEPEST, STEEPEST)
        return Response(tuple(float(each) for each in possible), self.sigma)

    @property
    def light_of_grey(self) -> np.ndarray:
        """(256,) float32: the light of each grey value, 0 to 255."""
        light = np.exp(self.log_light(np.log(np.maximum(np.arange(256.0), 0.5))))
        light[0] = 0.0
        return np.asarray(light, np.float32)

    def grey(self, light: np.ndarray) -> np.ndarray:
        """Grey values of the light; the inverse of `light_of_grey`. light: (...) float32, 0 to 255"""
        return np.asarray(np.interp(light, self.light_of_grey, np.arange(256.0)), np.float32)

    def light(self, grey: np.ndarray) -> np.ndarray:
        """As `light_of_grey`, also of fractions. grey: (...) float32, 0 to 255"""
        return np.asarray(np.interp(grey, np.arange(256.0), self.light_of_grey), np.float32)

    def log_ratio(self, level: np.ndarray, value: np.ndarray) -> np.ndarray:
        """(N,) float64: log ratios of light, of log ratios of grey values about their means.

        level, value: (N,) float64, mean of two log grey values, and their difference
        """
        return (
            np.asarray(self.log_light(level + value / 2) - self.log_light(level - value / 2))
            if self
            else value
        )

    def slope(self, log_grey: np.ndarray) -> np.ndarray:
        """(N,) float64: of log light over log grey value. log_grey: (N,) float64"""
        return np.asarray(1 + np.interp(log_grey, KNOTS, self.numbers))


_FULL = np.log([255.0])
LINEAR = Response()
TAKEN_OUT = Response((1.0,) * SLOPES)
"""What is left of a curve in images that it was taken out of: nothing, but its slopes are uncertain."""


def integrals(log_grey: np.ndarray) -> np.ndarray:
    """(N, SLOPES) float64: integrals over log grey value, from the first knot, of slope 1 at one knot, 0 at the others.

    log_grey: (N,) float64
    """
    return edge_sums.hat_integrals(np.ascontiguousarray(log_grey), KNOTS)


def by_slopes(curve: Response, level: np.ndarray, light: np.ndarray) -> np.ndarray:
    """(N, SLOPES): derivative of log ratios of grey values by the slopes, to first order about a curve.

    It is taken at the ratio that is expected and at the mean of both images, whose errors are not those of the ratio:
    taken where both are measured, noise alone would flatten the curve.
    level: (N,) float64, mean of both log grey values; light: (N,) float64, expected log ratio of the light
    """
    half = 0.5 * light / np.clip(curve.slope(level), 1 / STEEPEST, STEEPEST)
    return np.asarray(integrals(level - half) - integrals(level + half))


def prior(information: np.ndarray) -> np.ndarray:
    """(SLOPES, SLOPES): information about neighboring slopes, and that their mean where patches tell of them is 1.

    information: (SLOPES, SLOPES) float64, of the patches
    """
    steps = np.diff(np.eye(SLOPES), axis=0)
    seen = np.diag(information) / max(float(np.trace(information)), 1e-300)
    return np.asarray(
        steps.T @ steps / STEP_SIGMA**2 + _MEAN_INFORMATION * np.outer(seen, seen) + 1e-9 * np.eye(SLOPES)
    )


_MEAN_INFORMATION = 1e8
"""Of the mean slope, which is 1 by convention."""


def judged(numbers: np.ndarray, sigma: np.ndarray) -> Response:
    """The response of estimated numbers; none where it is not significant, or no camera has such.

    numbers, sigma: (SLOPES,) float64, slopes less 1 and their standard deviations
    """
    slopes, best = 1 + numbers, float(sigma.min())
    significant = (np.abs(numbers) > np.maximum(SIGNIFICANCE * sigma, SMALLEST)).any()
    possible = slopes.min() > 1 / STEEPEST and slopes.max() < STEEPEST
    return of_numbers(numbers, best) if significant and possible else Response(sigma=best)


def of_numbers(numbers: np.ndarray | None, sigma: float = float("inf")) -> Response:
    """The response of slopes; LINEAR of None or zeros. numbers: (SLOPES,) float64, slopes less 1"""
    if numbers is None or not numbers.any():
        return Response(sigma=sigma)
    return Response(tuple(float(1 + each) for each in numbers), sigma)


def light_of(curve: Response, images: Images) -> np.ndarray:
    """(..., C) float32: light of the grey values of uint8 images; black and clipped ones stay what they are."""
    table = curve.light_of_grey
    table[: DARK + 1] = np.arange(DARK + 1)
    table[SATURATED:] = np.arange(SATURATED, 256)
    return np.asarray(table[images])
