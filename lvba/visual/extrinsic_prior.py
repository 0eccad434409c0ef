"""What the calibrated mount of the camera, and clocks that agree, count beside the images.

All images tell of the one mount, so what they tell adds up; but so do errors that they share. A hundred images of a
Kinect claimed its mount to a millimeter and drew it 43 mm off. How far they can be believed shows in how far pieces of
wall contradict each other about it; where that is more than they claim, the calibration counts for more beside them.
"""

import numpy as np
from scipy.linalg import eigh
from scipy.spatial.transform import Rotation

from lvba import geometry
from lvba.visual.states import Mount

_TELLS_NOTHING = 1e-6
"""Part of the calibration's information that the images are taken to tell at least, in any direction."""


def claimed(rotation_deg: float, position_m: float, time_offset_s: float) -> np.ndarray:
    """(7, 7) information of `[rotation | translation | time offset]` with these standard deviations."""
    sigma = np.repeat([np.radians(rotation_deg), position_m, time_offset_s], [3, 3, 1])
    return np.diag(1 / sigma**2)


def deviation(calibrated: Mount, mount: Mount) -> np.ndarray:
    """(7,): how far a mount is off the calibrated one, in the latter's axes, rad, m and s."""
    back = calibrated.scan_from_camera[:3, :3].T
    rotation = Rotation.from_matrix(back @ mount.scan_from_camera[:3, :3]).as_rotvec()
    position = back @ (mount.scan_from_camera[:3, 3] - calibrated.scan_from_camera[:3, 3])
    return np.concatenate([rotation, position, [mount.time_offset - calibrated.time_offset]])


def jacobian(calibrated: Mount, mount: Mount) -> np.ndarray:
    """(7, 7): of the deviation by the step that `trajectory_prior.retract` takes."""
    found = np.eye(7)
    found[:3, :3] = geometry.inverse_right_jacobian(deviation(calibrated, mount)[:3])
    found[3:6, 3:6] = calibrated.scan_from_camera[:3, :3].T @ mount.scan_from_camera[:3, :3]
    return found


def linearize(
    calibrated: Mount, mount: Mount, information: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Hessian (7, 7), gradient (7,) and cost of a deviation from the calibrated mount."""
    off, by_step = deviation(calibrated, mount), jacobian(calibrated, mount)
    pull = information @ off
    return by_step.T @ information @ by_step, by_step.T @ pull, 0.5 * float(off @ pull)


def weighed(told: np.ndarray, spread: np.ndarray, claims: np.ndarray) -> np.ndarray:
    """(7, 7): what the calibration shall count beside images that claim `told`, never less than it claims itself.

    told: (7, 7) information of the images about the mount, with all cameras eliminated
    spread: (7, 7) variance of their gradient by the mount, summed over pieces of wall (see `visual.covariance`)
    claims: (7, 7) information of the calibration

    Where the spread is mu > 1 times what is told (generalized eigenvectors), the images are good for `told / mu`. What
    this and the calibration agree on is reached with all that is told, too, by a calibration that counts more: along the
    axes that they share by as much as the images overstate.
    """
    root = np.linalg.cholesky(claims)
    # in units of the calibration: its information is 1
    told, spread = _positive(_whitened(told, root)), _whitened(spread, root)
    overstated, axes = eigh(spread, told)
    back = told @ axes
    believed = (back / np.maximum(overstated, 1.0)) @ back.T
    good, shared = np.linalg.eigh(believed)
    counts = np.einsum("ik,ij,jk->k", shared, told, shared) / np.maximum(good, 1e-12)
    half = root @ shared
    return np.asarray((half * np.maximum(counts, 1.0)) @ half.T)


def _whitened(information: np.ndarray, root: np.ndarray) -> np.ndarray:
    left = np.linalg.solve(root, 0.5 * (information + information.T))
    return np.asarray(np.linalg.solve(root, left.T))


def _positive(information: np.ndarray) -> np.ndarray:
    values, axes = np.linalg.eigh(information)
    return np.asarray((axes * np.maximum(values, _TELLS_NOTHING)) @ axes.T)
