"""How far residuals scatter: by the sensor's noise, and where texture is strong by what interpolation and planes do.

A bilinear sample of a strong edge is wrong by more than a pixel's noise, and a patch that is off its plane by a part of
a pixel is wrong by that part times the image gradient. Both grow with the gradient. One standard deviation for all
patches would leave the word to the patches that deserve it least.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from lvba.visual.photometric import COUNT, SQUARE, WEIGHTS

_BINS = 12
_FEWEST = 20
"""Observations per bin."""


@dataclass(frozen=True)
class NoiseModel:
    """Variance of a residual: `pixel^2 + shift^2 * gradient`, the gradient as in `gradients`.

    pixel: grey values of 255; shift: px
    """

    pixel: float
    shift: float

    def sigma(self, gradient: np.ndarray) -> np.ndarray:
        """Standard deviation (O,) of the residuals of patches of mean squared gradient (O,), grey values.

        gradient: (O,) float64, (grey values / px)^2
        """
        return np.asarray(np.sqrt(self.pixel**2 + self.shift**2 * gradient))


def gradients(sums: np.ndarray) -> np.ndarray:
    """(O,) mean squared gradient of the residual by the patch's place, (grey values / px)^2; the median where unknown.

    sums: (O, SUMS) float64, see `lvba.kernels.photometric`
    """
    known = sums[:, WEIGHTS] > 0
    energy = (sums[:, 0] + sums[:, 2]) / np.where(known, sums[:, WEIGHTS], 1.0)
    return np.where(known, energy, np.median(energy[known]) if known.any() else 0.0)


def per_pixel(information: np.ndarray, sums: np.ndarray) -> float:
    """What all patches together tell of one shift along an axis that they share, 1/px^2.

    information: (O,) float64, of a squared residual; sums: (O, SUMS) float64, see `lvba.kernels.photometric`
    """
    return 0.5 * float(information @ (sums[:, 0] + sums[:, 2]))


def estimate(sums: np.ndarray, patch_samples: int, floor: float = 0.5) -> NoiseModel:
    """The model that fits the observations' mean square residuals, a median for each of some bins of gradient.

    The median resists the patches that do not lie on their plane; within a patch the plain mean square is the
    efficient estimate. Observations with fewer than half their samples do not vote.

    sums: (O, SUMS) float64, see `lvba.kernels.photometric`; floor: least `pixel`, grey values
    """
    votes = sums[sums[:, COUNT] >= 0.5 * patch_samples]
    if len(votes) == 0:
        return NoiseModel(floor, 0.0)
    square, gradient = votes[:, SQUARE] / votes[:, COUNT], gradients(votes)
    bins = np.array_split(np.argsort(gradient, kind="stable"), int(np.clip(len(votes) // _FEWEST, 1, _BINS)))
    y = np.array([np.median(square[b]) for b in bins])
    x = np.array([np.median(gradient[b]) for b in bins])
    if len(bins) < 3:
        return NoiseModel(max(float(np.sqrt(np.median(square))), floor), 0.0)
    y = np.maximum(y, floor**2)
    # the line of least relative error, neither number negative
    (pixel, shift), _ = nnls(np.column_stack([1 / y, x / y]), np.ones(len(y)))
    return NoiseModel(max(float(np.sqrt(pixel)), floor), float(np.sqrt(shift)))
