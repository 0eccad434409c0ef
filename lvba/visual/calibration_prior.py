"""The prior on the calibration (extrinsic, time offset), weighed against what the images say about it.

All images share one calibration, so their information about it adds up, and so do errors that they share. A hundred
images of a Kinect claimed the extrinsic to a millimeter and moved it by 43 mm. How far separate pieces of wall contradict
each other about the calibration shows how much of that information is real; where they contradict each other more than
they claim, the calibrated values get a larger weight. Where an estimate would be less certain than the calibration itself
all the same, the calibration stays.

The calibration may claim too high a certainty, too: one that was measured by hand is off by centimeters and degrees. How
far the extrinsic that the images see deviates from it, beyond what they contradict themselves, shows how much (a variance
component).
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag, eigh
from scipy.special import chdtrc, ndtri

from lvba.arrays import Pose
from lvba.optim.shared_parameters import SharedPrior, information
from lvba.visual.states import Calibration

_TELLS_NOTHING = 1e-6
"""Part of the calibration's information that the images are taken to tell at least, in any direction."""

_NO_BETTER = 1.01
"""Times the variance of the calibration that an estimate may have."""
_CLAIM_COUNTS = 1.0
"""So many numbers of an extrinsic as good as it claims to be are supposed beside those that the images see."""
_CERTAIN = 3.0
"""Images are far more certain of the extrinsic than its calibration where its claimed standard deviation is so many times
theirs."""
_KEPT = 1e6
"""Times over that a calibration counts in a direction that it keeps."""


@dataclass(frozen=True)
class Evidence:
    """What images say of the calibration. That of several parts of a recording adds up.

    information: (k, k) float64, with all cameras eliminated; spread: (k, k) float64, variance of their gradient by it,
        summed over pieces of wall (see `visual.covariance`)
    pull: (k,) float64, the information times the deviation from the calibrated values that the images see
    """

    information: np.ndarray
    spread: np.ndarray
    pull: np.ndarray

    def __add__(self, other: "Evidence") -> "Evidence":
        return Evidence(
            self.information + other.information, self.spread + other.spread, self.pull + other.pull
        )

    def by_range_errors(self, planes_off: np.ndarray) -> np.ndarray:
        """(k, k): variance of the gradient by errors of ranges that planes share.

        Planes that are off by so much, all in some way together, look to the images as a camera that sits elsewhere on
        the LiDAR. How far pieces of wall contradict each other shows nothing of it.
        planes_off: (6, 6) float64, second moments of that, in steps of the extrinsic
        """
        extrinsic = Calibration.layout()["scan_from_camera"]
        by_extrinsic = self.information[:, extrinsic]
        return np.asarray(by_extrinsic @ planes_off @ by_extrinsic.T)


@dataclass(frozen=True)
class ExtrinsicChange:
    """How the extrinsic found differs from the calibrated one.

    sigmas: as unlikely as so many standard deviations of one number, were the calibration as good as it claims
    certainty: how many times more certain than the calibration the images are of it, along the way it moved
    """

    sigmas: float = 0.0
    certainty: float = 1.0


NO_CHANGE = ExtrinsicChange()
_LEAST_CHANCE = 1e-300


def extrinsic_change(
    calibration: Calibration, prior: SharedPrior[Calibration], covariance: np.ndarray
) -> ExtrinsicChange:
    """What is to be thought of an extrinsic that moved: right ones are far more certain than the calibration they leave.

    covariance: (k, k) float64, of the calibration, as it was found
    """
    extrinsic = Calibration.layout()["scan_from_camera"]
    off = calibration.deviation(prior.reference)[extrinsic]
    by_claim = float(off @ prior.claimed[extrinsic, extrinsic] @ off)
    if by_claim == 0.0:
        return NO_CHANGE
    by_images = float(off @ np.linalg.solve(covariance[extrinsic, extrinsic], off))
    chance = max(float(chdtrc(len(off), by_claim)), _LEAST_CHANCE)
    return ExtrinsicChange(float(-ndtri(chance / 2)), float(np.sqrt(by_images / by_claim)))


def build(calibrated: Calibration, sigma: Mapping[str, float | np.ndarray]) -> SharedPrior[Calibration]:
    """The prior of calibrated values with these standard deviations, by parameter."""
    return SharedPrior(calibrated, information(calibrated.layout(), sigma))


def along_camera(moments: np.ndarray, camera_from_scan: Pose) -> np.ndarray:
    """(6, 6) float64: second moments of `[rotation | translation]` along the axes of the camera, rad and m.

    moments: (6, 6) float64, rad and m, along the axes of the scan
    """
    turn = block_diag(*(camera_from_scan[:3, :3],) * 2)
    return np.asarray(turn @ moments @ turn.T)


def granted(said: Evidence, spread: np.ndarray, claims: np.ndarray) -> np.ndarray:
    """(k, k): what the calibration is good for: the information that it claims, but for an extrinsic that images see
    further off than that, where they are far more certain.

    spread: (k, k) float64, as of the evidence, with all that images may be wrong by
    claims: (k, k) float64, information of the calibration

    Along the directions in which the images' own estimate has a small variance beside the calibration's, what it
    deviates beyond that gives the variance of the calibration.
    """
    root, extrinsic = np.linalg.cholesky(claims), Calibration.layout()["scan_from_camera"]
    information = _positive(_whitened(said.information, root))
    off = np.linalg.solve(information, np.linalg.solve(root, said.pull))[extrinsic]
    covariance = np.linalg.inv(_believed(information, _whitened(spread, root)))
    variance, axes = np.linalg.eigh(covariance[extrinsic, extrinsic])
    certain = variance < _CERTAIN**-2
    seen = np.square(axes.T @ off)[certain]
    factor = (seen - variance[certain]).sum() + _CLAIM_COUNTS
    factor /= certain.sum() + _CLAIM_COUNTS
    good = np.ones(len(claims))
    good[extrinsic] /= np.sqrt(max(factor, 1.0))
    return np.asarray(claims * np.outer(good, good))


def variance_over_claim(prior: SharedPrior[Calibration]) -> float:
    """How many times larger the variance of the extrinsic is than its calibration claims, as images have shown."""
    first = Calibration.layout()["scan_from_camera"].start
    return 1.0 if prior.granted is None else float(prior.claimed[first, first] / prior.granted[first, first])


def weighed(information: np.ndarray, spread: np.ndarray, claims: np.ndarray, keep: bool = True) -> np.ndarray:
    """(k, k): what the calibration shall count beside images of this `information`, never less than it claims itself.

    information: (k, k) float64, of the images about the calibration, with all cameras eliminated
    spread: (k, k) float64, variance of their gradient by it, summed over pieces of wall (see `visual.covariance`)
    claims: (k, k) float64, information of the calibration
    keep: no direction of the extrinsic less certain than calibrated; not before images and walls have come together, for
        walls that are not where the images see them contradict each other about everything

    Where the spread is mu > 1 times the information (generalized eigenvectors), the images are good for
    `information / mu`. What this and the calibration agree on is reached with all of it, too, by a calibration that
    counts more: along the axes that they share by the variance factor of the images.
    """
    root = np.linalg.cholesky(claims)
    # in units of the calibration: its information is 1
    information, spread = _positive(_whitened(information, root)), _whitened(spread, root)
    believed = _believed(information, spread)
    good, shared = np.linalg.eigh(believed)
    counts = np.einsum("ik,ij,jk->k", shared, information, shared) / np.maximum(good, 1e-12)
    counted = (shared * np.maximum(counts, 1.0)) @ shared.T
    if keep:
        counted = _kept_where_better(counted, information, spread)
    return np.asarray(root @ counted @ root.T)


def _believed(information: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """(k, k): the information that images are good for, whose gradient varies by the spread."""
    variance_factors, axes = eigh(spread, information)
    back = information @ axes
    return np.asarray((back / np.maximum(variance_factors, 1.0)) @ back.T)


def _kept_where_better(counted: np.ndarray, information: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """The calibration counting so much that no direction of the extrinsic is less certain than calibrated.

    All in units of the calibration. Axes of the variance factors and axes that calibration and images share are not the
    same, so along some directions the estimate may still follow what the images contradict themselves about.
    """
    extrinsic = Calibration.layout()["scan_from_camera"]
    counted = counted.copy()
    for _ in range(extrinsic.stop - extrinsic.start):
        inverse = np.linalg.inv(information + counted)
        variance, axes = np.linalg.eigh(
            (inverse @ (spread + counted @ counted) @ inverse)[extrinsic, extrinsic]
        )
        if variance[-1] <= _NO_BETTER:
            break
        counted[extrinsic, extrinsic] += _KEPT * np.outer(axes[:, -1], axes[:, -1])
    return counted


def _whitened(information: np.ndarray, root: np.ndarray) -> np.ndarray:
    left = np.linalg.solve(root, 0.5 * (information + information.T))
    return np.asarray(np.linalg.solve(root, left.T))


def _positive(information: np.ndarray) -> np.ndarray:
    values, axes = np.linalg.eigh(information)
    return np.asarray((axes * np.maximum(values, _TELLS_NOTHING)) @ axes.T)
