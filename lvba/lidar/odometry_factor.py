"""The odometry prior: neighbouring scans stay about as far apart as the rough poses say.

It decides only what planes leave open. Where they determine a direction, they outweigh it by orders of magnitude.
"""

from dataclasses import dataclass, replace

import numpy as np

from lvba import geometry

_FEWEST_STEPS = 10
_FLOOR_ROTATION, _FLOOR_TRANSLATION = 2e-4, 1e-3
"""rad and m: no odometry is taken for better than this from scan to scan."""


@dataclass(frozen=True)
class OdometryPrior:
    """Relative poses of neighbouring scans, S - 1 factors.

    next_from_previous is measured as previous_from_next: (S - 1, 4, 4)
    information: (S - 1, 6, 6), of the local tangent [rotation | translation] at the later scan
    """

    previous_from_next: np.ndarray
    information: np.ndarray

    def cost(self, world_from_scan: np.ndarray) -> float:
        """Half the sum of squared normalized residuals."""
        error = self._error(world_from_scan)
        return 0.5 * float(np.einsum("ni,nij,nj->", error, self.information, error))

    def _error(self, world_from_scan: np.ndarray) -> np.ndarray:
        relative = geometry.inverse(world_from_scan[:-1]) @ world_from_scan[1:]
        return geometry.log(geometry.inverse(self.previous_from_next) @ relative)

    def linearize(self, world_from_scan: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Gradient (S, 6), diagonal blocks (S, 6, 6) and blocks (S - 1, 6, 6) of (scan, next scan) of the cost.

        Perturbation in world axes about each sensor, as in `kernels.lidar`; Gauss-Newton.
        """
        error = self._error(world_from_scan)
        scans = len(world_from_scan)
        turn = np.zeros((scans, 6, 6))
        turn[:, :3, :3] = turn[:, 3:, 3:] = np.swapaxes(world_from_scan[:, :3, :3], -1, -2)
        relative = geometry.inverse(world_from_scan[1:]) @ world_from_scan[:-1]
        later = turn[1:]
        earlier = -geometry.adjoint(relative) @ turn[:-1]
        gradient = np.zeros((scans, 6))
        diagonal = np.zeros((scans, 6, 6))
        pull = np.einsum("nij,nj->ni", self.information, error)
        gradient[1:] += np.einsum("nji,nj->ni", later, pull)
        gradient[:-1] += np.einsum("nji,nj->ni", earlier, pull)
        diagonal[1:] += np.swapaxes(later, -1, -2) @ self.information @ later
        diagonal[:-1] += np.swapaxes(earlier, -1, -2) @ self.information @ earlier
        return gradient, diagonal, np.swapaxes(earlier, -1, -2) @ self.information @ later


def odometry_prior(
    world_from_scan: np.ndarray, sigma_rotation: float, sigma_translation: float
) -> OdometryPrior:
    """The prior of rough poses (S, 4, 4) with standard deviations (rad, m) of one step."""
    information = np.diag([sigma_rotation**-2] * 3 + [sigma_translation**-2] * 3)
    steps = geometry.inverse(world_from_scan[:-1]) @ world_from_scan[1:]
    return OdometryPrior(steps, np.broadcast_to(information, (len(steps), 6, 6)).copy())


def reestimated(
    prior: OdometryPrior, world_from_scan: np.ndarray, held: np.ndarray, ceiling: np.ndarray
) -> OdometryPrior:
    """The prior with the standard deviations that its errors at refined poses (S, 4, 4) show; robust (median).

    held: (S,) bool, scans that planes hold in every direction: only steps between two of these tell how wrong the
        odometry is; where they are few the prior stays as it is
    ceiling: (6,), rad and m, [rotation | translation], no estimate is larger
    """
    error = np.abs(prior._error(world_from_scan))[held[1:] & held[:-1]]
    if len(error) < _FEWEST_STEPS:
        return prior
    rotation, translation = (1.4826 * float(np.median(error[:, part])) for part in (slice(3), slice(3, 6)))
    sigma = np.repeat([max(rotation, _FLOOR_ROTATION), max(translation, _FLOOR_TRANSLATION)], 3)
    information = np.diag(np.minimum(sigma, ceiling) ** -2)
    return replace(prior, information=np.broadcast_to(information, prior.information.shape).copy())
