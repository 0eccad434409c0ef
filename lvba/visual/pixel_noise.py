"""How far images contradict each other by the noise of their pixels alone.

Normal equations take the noise of all residuals for independent. But all pairs of a scene point share its reference
patch, and scene points beside each other share pixels: then their noise adds up in the gradients, the more the more
images see the same surface (most where the camera stands still). So the variance factor is above 1 also where
everything is modeled; only what exceeds this shows that a model is wrong.
"""

from dataclasses import replace

import numpy as np

from lvba.visual import covariance, photometric
from lvba.visual.covariance import WallClusters
from lvba.visual.image import DARK, SATURATED
from lvba.visual.photometric import Linearization, PhotometricState, Problem

_SEED = 0
_DRAWN = 1.0
"""Of 255, a standard deviation: more would change derivatives of images, too, which large residuals are multiplied by."""


def variance_factor(
    problem: Problem, state: PhotometricState, linearization: Linearization, walls: WallClusters
) -> float:
    """The variance factor (see `covariance.variance_factor`) that the noise of the pixels alone would give, at least 1.

    A little white noise is added to all images; how the gradients change, scaled to the noise of the residuals, shows
    how it adds up (a parametric bootstrap, Efron 1979).
    linearization: of the problem at the state
    """
    noise = _drawn(problem.images[0].size)
    noisy = replace(problem, images=_with(noise, problem.images))
    _, _, single, _ = photometric.assembled(noisy, state, photometric.sums(noisy, state))
    scale = float(np.median(problem.sigma)) / float(noise.std())
    change = replace(linearization, single=scale * (single - linearization.single))
    clusters = covariance.cluster_gradients(problem, change, walls)
    return max(problem.variance_factor * covariance.dispersion(linearization.equations, clusters), 1.0)


def _drawn(size: int) -> np.ndarray:
    """(2 size,) int16: for every image of so many pixels, another piece of it; drawing each costs as much as a step."""
    return np.rint(np.random.default_rng(_SEED).normal(0.0, _DRAWN, 2 * size)).astype(np.int16)


def _with(noise: np.ndarray, images: np.ndarray) -> np.ndarray:
    """(I, H, W, C) uint8: images with noise; valid pixels stay valid, and others as they are."""
    size = images[0].size
    noisy = np.empty_like(images)
    first = np.random.default_rng(_SEED + 1).integers(size, size=len(images))
    for image, into, start in zip(images, noisy, first, strict=True):
        changed = np.clip(image + noise[start : start + size].reshape(image.shape), DARK + 1, SATURATED - 1)
        valid = (image > DARK) & (image < SATURATED)
        into[...] = np.where(valid, changed, image)
    return noisy
