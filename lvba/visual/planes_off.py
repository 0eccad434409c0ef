"""What cameras and calibration are off by where errors of ranges take all planes off the sensor, alike in all scans.

Images do not see it: cameras move with the planes, and the extrinsic seems to be another one. In rooms, beams 0.1 degrees
too high lowered the floor by 6 mm about every scan, and all cameras with it.
"""

import numpy as np

from lvba.optim import linear_solver
from lvba.optim.linear_solver import Covariance
from lvba.visual.states import Calibration
from lvba.visual.trajectory_prior import Prior

_EXTRINSIC = Calibration.layout()["scan_from_camera"]


def with_planes_off(
    known: Covariance, plain: Covariance, prior: Prior, calibration: Calibration
) -> Covariance:
    """The covariance of images and calibration, with what planes that are off move of them.

    plain: inverse of all information

    Planes take cameras with them that are held by images, and what the calibration knows of the extrinsic keeps them
    where they were. Were it to count for nothing, all would move as the planes do, whatever they are held by.
    """
    blocks = np.eye(plain.blocks.shape[1], 6) - plain.with_shared @ _kept(prior, calibration)
    moved = _of_calibration(plain.shared, prior, calibration)
    return linear_solver.with_errors(known, blocks, moved, prior.planes_off)


def of_calibration(plain: np.ndarray, prior: Prior, calibration: Calibration) -> np.ndarray:
    """(k, k): what the covariance of the calibration has of it. plain: (k, k) float64, as of `with_planes_off`"""
    moved = _of_calibration(plain, prior, calibration)
    return np.asarray(moved @ prior.planes_off @ moved.T)


def _of_calibration(plain: np.ndarray, prior: Prior, calibration: Calibration) -> np.ndarray:
    """(k, 6): how far it moves by a unit of each number of the planes."""
    return np.asarray(np.eye(len(plain))[:, _EXTRINSIC] - plain @ _kept(prior, calibration))


def _kept(prior: Prior, calibration: Calibration) -> np.ndarray:
    """(k, 6): what the calibration itself says of the extrinsic, in its steps."""
    return prior.calibration.hessian(calibration)[:, _EXTRINSIC]
