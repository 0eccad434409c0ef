"""How far a result is from a reference: truth of a simulation, or another solution."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from lvba.arrays import Times
from lvba.io.exposures import Exposures
from lvba.io.reference import Reference
from lvba.trajectory import Alignment, Trajectory, align_for_errors, nearest_in_time, pose_error

MAX_TIME_DIFFERENCE_S = 1e-3
"""Samples further apart in time than this are not of the same frame."""
MOST_SCALE = 0.05
"""Part by which ranges may be too long or short: laser scanners are a thousandth off, depth cameras some hundredths. A
factor further from 1 is none of ranges: of a path that hardly spreads, position errors make any, also a negative one."""
_ALIKE = 0.01
"""Standard deviation of log exposures below which no power can be read off them."""
_LEAST_POWER = 0.1
"""Cameras raise the light to a third or more."""


def compare(
    reference: Reference, scans: Trajectory, images: Trajectory, exposures: Exposures | None = None
) -> dict[str, Any]:
    """The `reference` part of report.json: errors of the scans, the cameras and the exposures.

    lidar: after alignment of the scans (`trajectory.align_for_errors`). camera: in the frame of the LiDAR map, that is
    with the alignment of the scans (or its own where there is no scan); camera_aligned: after their own alignment.
    aligned_by: what the alignment was found from. scale (of the scans): by what factor the result is smaller than the
    reference; scaled_ate_m: position errors after that factor, which only the range sensor itself tells, where it can be
    the sensor's (MOST_SCALE).
    exposure: after one common scale. Frames are matched by time; a part without two frames in common is left out.
    """
    facts: dict[str, Any] = {}
    scaled: _Scaled | None = None
    aligned = scan_alignment(reference, scans)
    scan_pairs = _pairs(scans, reference.scans)
    if aligned is not None and reference.scans is not None:
        estimate = scans.world_from_sensor[scan_pairs[:, 0]]
        truth = reference.scans.world_from_sensor[scan_pairs[:, 1]]
        facts["lidar"] = _error(estimate, truth, aligned, aligned.by)
        scaled = _Scaled.of(aligned.reference_from_estimate @ estimate, truth)
        facts["lidar"] |= {"scale": scaled.factor, "scaled_ate_m": scaled.error(estimate, truth, aligned)}
    image_pairs = _pairs(images, reference.images)
    if len(image_pairs) > 1 and reference.images is not None:
        estimate = images.world_from_sensor[image_pairs[:, 0]]
        truth = reference.images.world_from_sensor[image_pairs[:, 1]]
        alone = align_for_errors(estimate, truth)
        facts["camera_aligned"] = own = _error(estimate, truth, alone, alone.by)
        facts["camera"] = own if aligned is None else _error(estimate, truth, aligned, f"scans, {aligned.by}")
        if aligned is not None and scaled is not None:
            facts["camera"] |= {"scaled_ate_m": scaled.error(estimate, truth, aligned)}
    if exposures is not None and reference.exposures is not None:
        facts |= _exposure_facts(exposures, reference.exposures)
    return facts


def scan_alignment(reference: Reference, scans: Trajectory) -> Alignment | None:
    """What brings scans to the reference; None: fewer than two frames in common."""
    if reference.scans is None:
        return None
    pairs = matched(scans.times, reference.scans.times)
    if len(pairs) < 2:
        return None
    truth = reference.scans.world_from_sensor[pairs[:, 1]]
    return align_for_errors(scans.world_from_sensor[pairs[:, 0]], truth)


def _error(estimate: np.ndarray, truth: np.ndarray, aligned: Alignment, by: str) -> dict[str, Any]:
    error = asdict(pose_error(estimate, truth, aligned=aligned.reference_from_estimate))
    return {**error, "aligned_by": by}


@dataclass(frozen=True)
class _Scaled:
    """What brings aligned positions nearest to a reference: centers (3,) m of both, and a factor about them."""

    center: np.ndarray
    reference_center: np.ndarray
    factor: float

    @staticmethod
    def of(aligned: np.ndarray, truth: np.ndarray) -> "_Scaled":
        p, q = aligned[:, :3, 3], truth[:, :3, 3]
        center, reference_center = p.mean(axis=0), q.mean(axis=0)
        square = float(np.sum((p - center) ** 2))
        factor = float(np.sum((p - center) * (q - reference_center))) / square if square > 0 else 1.0
        return _Scaled(center, reference_center, factor)

    def error(self, estimate: np.ndarray, truth: np.ndarray, alignment: Alignment) -> float:
        """m, root mean square; without a factor where it is none of ranges."""
        aligned = (alignment.reference_from_estimate @ estimate)[:, :3, 3]
        if abs(self.factor - 1) > MOST_SCALE:
            return float(np.sqrt(np.mean(np.sum((aligned - truth[:, :3, 3]) ** 2, axis=1))))
        off = self.reference_center + self.factor * (aligned - self.center) - truth[:, :3, 3]
        return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


def _exposure_facts(estimate: Exposures, reference: Exposures) -> dict[str, Any]:
    pairs = matched(estimate.times, reference.times)
    if len(pairs) < 2:
        return {}
    difference = np.log(estimate.relative[pairs[:, 0]]) - np.log(reference.relative[pairs[:, 1]])
    error = np.expm1(difference - difference.mean())
    facts = {
        "rms_percent": 100 * float(np.sqrt((error**2).mean())),
        "max_percent": 100 * float(np.abs(error).max()),
    }
    facts |= _after_power(estimate.relative[pairs[:, 0]], reference.relative[pairs[:, 1]])
    return {"exposure": {**facts, "frames": len(pairs)}}


def exposure_power(estimate: np.ndarray, truth: np.ndarray) -> float | None:
    """Slope of estimated over true log exposures; None: the true ones are alike, or it is no power.

    estimate, truth: (P,) float64
    """
    spread = truth - truth.mean()
    if not (square := float((spread**2).sum())) > _ALIKE**2 * len(truth):
        return None
    power = float((spread * (estimate - estimate.mean())).sum()) / square
    return power if power > _LEAST_POWER else None


def _after_power(estimate: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """How far exposures are off after the one power of the light that images leave open (`visual.response`).

    estimate, truth: (P,) float64, relative exposures; nothing where the true ones are alike
    """
    power = exposure_power(np.log(estimate), np.log(truth))
    if power is None:
        return {}
    left = np.log(estimate) / power - np.log(truth)
    error = np.expm1(left - left.mean())
    return {"power": power, "rms_percent_after_power": 100 * float(np.sqrt((error**2).mean()))}


def matched(times: Times, others: Times) -> np.ndarray:
    """Index pairs (P, 2) int64 of samples at the same time, each used once. Both ascending."""
    if not len(times) or not len(others):
        return np.empty((0, 2), np.int64)
    nearest = nearest_in_time(others, times)
    close = np.abs(others[nearest] - times) <= MAX_TIME_DIFFERENCE_S
    return np.stack([np.flatnonzero(close), nearest[close]], axis=1)


def _pairs(estimate: Trajectory, truth: Trajectory | None) -> np.ndarray:
    """`matched` frames; none without a reference."""
    return matched(estimate.times, np.zeros(0) if truth is None else truth.times)
