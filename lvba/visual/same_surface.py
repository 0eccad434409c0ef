"""Images that show something else than the surfaces that scans measured, by what patches have in common with other views.

Two views of a surface vary alike over a patch: the covariance of what they show is that of its texture, and noise has
no part in it, for it differs from view to view. Brightness alone does not tell: a person who filled an image agreed with
all others that it was 10 % darker, as dark as the coat was.
"""

import numpy as np

from lvba.arrays import Indices, Vectors
from lvba.kernels.patches_mean import CONTRAST, SPREAD

_SURFACE_M = 1.0
"""Size of the pieces of surface whose texture is alike."""
_TEXTURED = 0.5
"""Variance by texture over that by noise, mean over the patches of an image, from which on it says what is shown."""
_NOTHING_IN_COMMON = 0.3
"""Of what views of these surfaces usually have in common; blur leaves more. Real recordings have 0.9 and more."""


def hidden(
    means: np.ndarray, position_world: Vectors, first: Indices, second: Indices, images: int
) -> np.ndarray:
    """(I,) bool: which images show something else. False where texture does not tell.

    means: (N, 4) float64, of the patches of each comparison, as of `patches_mean.measure_pairs`
    position_world: (N, 3) float64, m, of these; first, second: (N,), their images
    """
    if not len(means):
        return np.zeros(images, bool)
    spread, contrast = means[:, SPREAD] ** 2, means[:, CONTRAST] ** 2
    common = (contrast - spread) / 2
    noise = float(np.median(spread)) / 2
    usual = np.maximum(_median_by_surface(common, position_world), 0.0)

    def by_image(values: np.ndarray) -> np.ndarray:
        return np.bincount(first, values, images) + np.bincount(second, values, images)

    expected, count = by_image(usual), by_image(np.ones(len(usual)))
    return (expected > _TEXTURED * noise * count) & (by_image(common) < _NOTHING_IN_COMMON * expected)


def _median_by_surface(value: np.ndarray, position_world: Vectors) -> np.ndarray:
    """(N,) float64: the median of the values on each one's piece of surface; the lower of two."""
    cell = np.floor(position_world / _SURFACE_M).astype(np.int64)
    _, piece = np.unique(cell, axis=0, return_inverse=True)
    order = np.lexsort((value, piece.ravel()))
    _, first, count = np.unique(piece.ravel()[order], return_index=True, return_counts=True)
    return np.asarray(value[order][first + (count - 1) // 2][piece.ravel()])
