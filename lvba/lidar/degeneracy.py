"""Directions in which the planes do not hold a scan: found, held at the odometry, and reported.

One plane leaves a scan three free directions, a corridor one. The cost is not quite flat there: the noise of the fitted
normals makes up information, and following it lets a scan slide along its walls by much more than the odometry is off.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from lvba import geometry
from lvba.arrays import PoseBlocks, Poses, StepSigmas
from lvba.kernels import lidar as kernel
from lvba.lidar import panels
from lvba.lidar.plane_feature import PlaneFeatures, PlaneFits

TRUSTED_POINTS = 50.0
"""A normal is never trusted better than one of this many independent points: surfaces have edges and bumps."""
SIGNAL_TO_NOISE = 4.0
"""Information below this multiple of what noise alone makes up is not followed."""


@dataclass(frozen=True)
class DegenerateDirection:
    """A motion of the scans as a whole that the planes hardly determine.

    direction: (6,) unit after division by the prior's sigmas, world axes about the sensor, [rotation | translation]
    sigmas: (6,), these, rad and m
    ratio: information of the planes over that of noise and odometry
    """

    direction: np.ndarray
    sigmas: np.ndarray
    ratio: float


@dataclass(frozen=True)
class DegenerateDirections:
    """What the planes leave open.

    projector: (S, 6, 6), local tangent: keeps of a motion what the planes determine
    count: (S,) int64, degenerate directions of each scan
    common: those of all scans together
    """

    projector: np.ndarray
    count: np.ndarray
    common: tuple[DegenerateDirection, ...]


def find(
    features: PlaneFeatures,
    fits: PlaneFits,
    world_from_scan: Poses,
    sigma: float,
    prior_sigmas: StepSigmas,
) -> DegenerateDirections:
    """The degenerate directions at poses (S, 4, 4); prior_sigmas: (6,), rad and m, of the odometry from scan to scan."""
    known, noise = information(features, fits, world_from_scan)
    return judge(known / sigma**2, noise / sigma**2, world_from_scan, prior_sigmas)


def judge(
    information: PoseBlocks,
    noise_information: PoseBlocks,
    world_from_scan: Poses,
    prior_sigmas: StepSigmas,
) -> DegenerateDirections:
    """The degenerate directions of the planes' information about each scan (S, 6, 6).

    information, noise_information: as `information` finds them, over the variance of a point; world_from_scan: (S, 4, 4);
    prior_sigmas: as in `find`
    """
    scale = np.outer(prior_sigmas, prior_sigmas)
    signal, noise = information * scale, SIGNAL_TO_NOISE * noise_information * scale + np.eye(6)
    scans = len(signal)
    projector = np.broadcast_to(np.eye(6), (scans, 6, 6)).copy()
    count = np.zeros(scans, np.int64)
    for index in range(scans):
        values, vectors = scipy.linalg.eigh(signal[index], noise[index], check_finite=False)
        open_motions = vectors[:, values < 1.0]
        count[index] = open_motions.shape[1]
        if count[index]:
            basis = np.linalg.qr(open_motions)[0]
            inside = np.eye(6) - basis @ basis.T
            inside *= np.outer(prior_sigmas, 1.0 / prior_sigmas)
            projector[index] = geometry.turn_tangent(inside, world_from_scan[index, :3, :3].T)
    values, vectors = scipy.linalg.eigh(signal.mean(0), noise.mean(0), check_finite=False)
    common = tuple(
        DegenerateDirection(vector / np.linalg.norm(vector), np.asarray(prior_sigmas), float(value))
        for value, vector in zip(values, vectors.T, strict=True)
        if value < 1.0
    )
    return DegenerateDirections(projector, count, common)


def information(
    features: PlaneFeatures, fits: PlaneFits, world_from_scan: Poses
) -> tuple[np.ndarray, np.ndarray]:
    """The planes' information about each scan (S, 6, 6), and the part of it due to normal noise alone (S, 6, 6).

    Both times the variance of a point, in world axes about each sensor, in which scans can be compared; see
    `kernels.lidar.information`.
    """
    clusters = features.clusters.weighted(features.weight)
    return kernel.information(
        np.ascontiguousarray(world_from_scan),
        panels.by_scan(features, len(world_from_scan)),
        features.feature,
        clusters.arrays,
        fits.eigenvectors,
        normal_variance(fits),
    )


def normal_variance(fits: PlaneFits, trusted: float = TRUSTED_POINTS) -> np.ndarray:
    """Variance of each plane's normal towards its two tangents, (F, 2), rad^2: lam0 / (N (lam_k - lam0)), N at most
    `trusted`; 0 towards a tangent that is none."""
    smallest = np.maximum(fits.eigenvalues[:, :1], 0.0)
    gap = np.minimum(fits.total, trusted)[:, None] * (fits.eigenvalues[:, 1:] - fits.eigenvalues[:, :1])
    return np.asarray(np.divide(smallest, gap, out=np.zeros_like(gap), where=gap > 0.0))
