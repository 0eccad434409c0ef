"""Which comparisons of patches show one surface, where something else hides most of an image.

Two views of a surface vary alike over a patch: the covariance of what they show is that of its texture, and noise has
no part in it, for it differs from view to view. Brightness alone does not tell: a person who filled an image agreed with
all others that it was 10 % darker, as dark as the coat was.
"""

import numpy as np

from lvba import distinct_rows
from lvba.arrays import Indices, Vectors
from lvba.kernels.patches_mean import CONTRAST, SPREAD

_SURFACE_M = 1.0
"""Size of the pieces of surface whose texture is alike."""
_TEXTURED = 0.5
"""Variance by texture over that by noise from which on it says what is shown."""
_HIDDEN = 0.3
"""Of what views of the surfaces of an image usually have in common, below which most of it shows something else. Images
of real recordings have 0.9 and more."""
_ALIKE = 0.5
"""The same of a patch, above which it shows its surface."""


def shown(
    means: np.ndarray, position_world: Vectors, first: Indices, second: Indices, images: int
) -> np.ndarray:
    """(N,) bool: which comparisons count. Of images that show something else for the most part, as far as texture tells,
    those of patches that vary as their surfaces do.

    means: (N, 4) float64, of the patches of each comparison, as of `patches_mean.measure_pairs`
    position_world: (N, 3) float64, m, of these; first, second: (N,), their images
    """
    if not len(means):
        return np.ones(0, bool)
    spread, contrast = means[:, SPREAD] ** 2, means[:, CONTRAST] ** 2
    common = (contrast - spread) / 2
    noise = float(np.median(spread)) / 2
    usual = np.maximum(_median_by_surface(common, position_world), 0.0)

    def by_image(values: np.ndarray) -> np.ndarray:
        return np.bincount(first, values, images) + np.bincount(second, values, images)

    expected, count = by_image(usual), by_image(np.ones(len(usual)))
    hidden = (expected > _TEXTURED * noise * count) & (by_image(common) < _HIDDEN * expected)
    alike = (usual > _TEXTURED * noise) & (common > _ALIKE * usual)
    return np.asarray(alike | ~(hidden[first] | hidden[second]))


def _median_by_surface(value: np.ndarray, position_world: Vectors) -> np.ndarray:
    """(N,) float64: the median of the values on each one's piece of surface; the lower of two."""
    piece = distinct_rows.number(np.floor(position_world / _SURFACE_M).astype(np.int64))
    order = np.lexsort((value, piece))
    count = np.bincount(piece)
    first = np.cumsum(count) - count
    return np.asarray(value[order][first + (count - 1) // 2][piece])
