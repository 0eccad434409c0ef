"""How far cameras deviate from the LiDAR trajectory, estimated from the deviations themselves.

Two things make a camera deviate from where a scan pose puts it. One is its own: interpolation between scans, the noise
of the odometry in a frame, jitter of the clocks. It shows in the differences between neighboring frames. The other is
the error of the scans' poses, which neighbors have in common; how large that can be, the LiDAR bundle adjustment says. A
slow deviation larger than both contradicts a rigid extrinsic: images alone drift, and then the prior must not give way.
"""

from dataclasses import replace

import numpy as np

from lvba.visual.prior_config import FLOOR_POSITION_M, FLOOR_ROTATION_DEG
from lvba.visual.states import VisualState
from lvba.visual.trajectory_prior import (
    CEILING_POSITION_M,
    CEILING_ROTATION_DEG,
    Prior,
    Source,
    residuals,
    sigmas,
)

_ORDINARY = 4.0
"""Times the variance of the scans' error that deviations which neighbors have in common are nothing special: it is not
known to better."""
_MEDIAN_OF_THREE = 2.366
"""The median of the sum of squares of three standard normal variables."""


def reestimated(prior: Prior, state: VisualState, undecided: tuple[np.ndarray, ...]) -> Prior:
    """The prior with the sigmas of each source scaled to fit the frames' deviations (robust, within limits).

    undecided: per source (I, 6), how much of each deviation the data left undecided: the posterior variances of the
        deviations. A deviation that only the prior decides is zero by construction and must not count as agreement:
        each component's vote is weighed by the part of it that the images decided (variance components, Helmert).
    """
    return replace(
        prior,
        sources=tuple(
            _rescaled(source, residuals(prior, source, state), posterior)
            for source, posterior in zip(prior.sources, undecided, strict=True)
        ),
    )


def _rescaled(source: Source, deviation: np.ndarray, posterior: np.ndarray) -> Source:
    own = source.and_late(np.concatenate([source.sigma_rotation, source.sigma_position], axis=1))
    fraction = np.clip(1 - posterior / sigmas(source) ** 2, 0.0, 1.0)
    spoken = source.spoken
    each = np.repeat(spoken, 3, axis=1)
    # any deviation is small beside an expectation that tells nothing: that is no agreement
    fraction, deviation = np.where(each, fraction, 0.0), np.where(each, deviation, 0.0)
    rotation, position = (_own_scale(deviation, own, fraction, part) for part in (slice(3), slice(3, 6)))
    return replace(
        source,
        sigma_rotation=_within(
            rotation * source.sigma_rotation,
            source.sigma_rotation,
            np.radians([FLOOR_ROTATION_DEG, CEILING_ROTATION_DEG]),
            spoken[:, 0],
        ),
        sigma_position=_within(
            position * source.sigma_position,
            source.sigma_position,
            np.array([FLOOR_POSITION_M, CEILING_POSITION_M]),
            spoken[:, 1],
        ),
        correlation_inflation=(
            _correlation_inflation(deviation[:, :3], own[:, :3], source.scan_rotation, spoken[:, 0]),
            _correlation_inflation(deviation[:, 3:], own[:, 3:], source.scan_position, spoken[:, 1]),
        ),
    )


def _own_scale(deviation: np.ndarray, own: np.ndarray, fraction: np.ndarray, part: slice) -> float:
    """By what factor frames deviate more than their own sigmas (I, 6); shared deviations must not count as own.

    Both the deviations and the differences of neighbors have at least a frame's own spread: the smaller one tells more.
    """
    step = np.square(np.diff(deviation, axis=0)) / (own[1:] ** 2 + own[:-1] ** 2)
    by_steps = _scale(step[:, part], np.minimum(fraction[1:], fraction[:-1])[:, part])
    return min(by_steps, _scale(np.square(deviation / own)[:, part], fraction[:, part]))


def _within(sigma: np.ndarray, before: np.ndarray, limits: np.ndarray, spoken: np.ndarray) -> np.ndarray:
    """Estimates (I, 3) between floor and ceiling; one that began above the ceiling (far from any scan) may stay there,
    and one that tells nothing does."""
    return np.where(spoken[:, None], np.clip(sigma, limits[0], np.maximum(before, limits[1])), before)


def _correlation_inflation(
    deviation: np.ndarray, own: np.ndarray, of_scans: np.ndarray, spoken: np.ndarray
) -> float:
    """By what factor the variance of shared deviations grows, >= 1.

    N frames whose deviations have lag-one correlation r tell of their common part only what N (1 - r) / (1 + r)
    independent ones do. That holds for the error of the scans' poses. The further what most neighbors have in common is
    beyond that, the less of it the scans explain, and the less the factor grows: images that drift would weaken what
    holds them, and drift on.
    deviation: (I, 3); own, of_scans: (I, 3), its standard deviations, of each frame by itself and by the scans' error;
    spoken: (I,) bool, frames that deviate from something
    """
    clipped, both = np.clip(deviation / own, -3, 3), spoken[1:] & spoken[:-1]
    total = float(np.square(clipped[spoken]).mean()) if spoken.any() else 0.0
    if both.sum() < 10 or total == 0:
        return 1.0
    correlation = min(max(float((clipped[1:] * clipped[:-1])[both].mean()) / total, 0.0), 0.95)
    relative = deviation / of_scans
    in_common = float(np.median((relative[1:] * relative[:-1])[both].sum(axis=1))) / _MEDIAN_OF_THREE
    explained = _ORDINARY / max(in_common, _ORDINARY)
    return 1 + explained * ((1 + correlation) / (1 - correlation) - 1)


def _scale(normalized: np.ndarray, fraction: np.ndarray) -> float:
    """By what factor deviations exceed their sigmas, robust (Huber's proposal 2); 1 where the images decided too few."""
    if fraction.sum() < 6:
        return 1.0
    scale = 1.0
    for _ in range(20):
        clip = (2.0 * scale) ** 2
        # 0.9205 is the mean of a chi-square of one degree of freedom clipped at 4
        new = float(np.sqrt(np.minimum(normalized, clip).sum() / (0.9205 * fraction.sum())))
        if abs(new - scale) < 1e-3 * scale:
            break
        scale = new
    return float(np.clip(scale, 0.1, 10.0))
