"""Covariances of a result, and whether they are honest: the error they predict, beside the error against a reference."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from lvba import geometry, trajectory
from lvba.arrays import LogExposures, Pose, PoseBlocks, Times
from lvba.products.reference import exposure_power, matched
from lvba.trajectory import Trajectory


@dataclass(frozen=True)
class Expected:
    """Covariances of the poses that are the result, local tangent `[rotation | translation]`, rad and m.

    scans: (S, 6, 6), cameras: (I, 6, 6) float64; NaN where nothing is known, None where nothing is known of any
    """

    scans: np.ndarray | None
    cameras: np.ndarray | None


def against(
    estimate: Trajectory,
    covariance: PoseBlocks,
    reference: Trajectory,
    reference_from_map: Pose | None = None,
) -> dict[str, float]:
    """Predicted root mean square errors and the normalized estimation error squared (1: honest).

    covariance: (N, 6, 6), local tangent `[rotation | translation]`; frames without one (all zero, or not finite) are
        left out
    reference_from_map: alignment to use; None: found here
    """
    pairs = matched(estimate.times, reference.times)
    known = is_known(covariance)
    pairs = pairs[known[pairs[:, 0]]]
    if len(pairs) < 2:
        return {}
    poses, truth = estimate.world_from_sensor[pairs[:, 0]], reference.world_from_sensor[pairs[:, 1]]
    spread = covariance[pairs[:, 0]]
    aligned = trajectory.align(poses, truth) if reference_from_map is None else reference_from_map
    error = geometry.log(geometry.inverse(aligned @ poses) @ truth)
    rotation, position = (np.trace(spread[:, s, s], axis1=1, axis2=2).mean() for s in (slice(3), slice(3, 6)))
    return {
        "predicted_ate_m": float(np.sqrt(position)),
        "predicted_rotation_deg": float(np.degrees(np.sqrt(rotation))),
        "nees": float(squared_distances(error, spread).mean()),
    }


def is_known(covariance: PoseBlocks) -> np.ndarray:
    """(N,) bool: which frames have a covariance (N, 6, 6), not one that is not finite, or all zero."""
    return np.asarray(np.isfinite(covariance).all((1, 2)) & (np.trace(covariance, axis1=1, axis2=2) > 0))


def squared_distances(errors: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(N,) float64: squared Mahalanobis distances over their degrees of freedom.

    errors: (N, D) float64; covariance: (N, D, D) float64
    """
    whitened = np.linalg.solve(covariance, errors[..., None])[..., 0]
    return np.asarray((errors * whitened).sum(axis=1) / errors.shape[1])


def of_exposures(
    times: Times, log_exposure: LogExposures, sigma: np.ndarray, true_times: Times, true: np.ndarray
) -> dict[str, Any]:
    """The same for log exposures (I,) with standard deviations (I,), after one common scale. true: (E,) float64 relative.

    sigma: (I,) float64, of the log exposures; predicted_frames: how many are known; after_power: after one power as
        well, which images leave open
    """
    pairs = matched(times, true_times)
    pairs = pairs[(np.isfinite(sigma) & (sigma > 0))[pairs[:, 0]]]
    if len(pairs) < 2:
        return {}
    estimate, truth = log_exposure[pairs[:, 0]], np.log(true[pairs[:, 1]])
    spread = sigma[pairs[:, 0]]
    facts = {
        "predicted_frames": len(pairs),
        "predicted_percent": float(100 * np.sqrt(np.mean(spread**2))),
        "nees": _squared_error(estimate - truth, spread),
    }
    power = exposure_power(estimate, truth)
    return (
        facts
        if power is None
        else facts
        | {
            "nees_after_power": _squared_error(estimate - power * truth, spread),
            "predicted_percent_after_power": facts["predicted_percent"] / power,
        }
    )


def _squared_error(error: np.ndarray, sigma: np.ndarray) -> float:
    """Of errors (P,) about their mean, in standard deviations (P,)."""
    return float(np.mean(((error - error.mean()) / sigma) ** 2))
