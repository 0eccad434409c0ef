"""The odometry prior: neighbouring scans stay about as far apart as the rough poses say.

It decides only what planes leave open. Where they determine a direction, they outweigh it by orders of magnitude.
"""

from dataclasses import dataclass, replace

import numpy as np

from lvba import geometry
from lvba.arrays import Poses, StepSigmas
from lvba.optim import pose_graph
from lvba.optim.normal_equations import NormalEquations
from lvba.optim.pose_graph import Edges

_FEWEST_STEPS = 10
_FLOOR_ROTATION, _FLOOR_TRANSLATION = 2e-4, 1e-3
"""rad and m: no odometry is taken for better than this from scan to scan."""


@dataclass(frozen=True)
class OdometryPrior:
    """Relative poses of neighbouring scans, S - 1 factors: edges of a pose graph that is a chain.

    next_from_previous is measured as previous_from_next: (S - 1, 4, 4)
    information: (S - 1, 6, 6), of the local tangent [rotation | translation] at the later scan
    """

    previous_from_next: np.ndarray
    information: np.ndarray

    def cost(self, world_from_scan: Poses) -> float:
        """Half the sum of squared normalized residuals."""
        return pose_graph.cost(self.residuals(world_from_scan), self._edges())

    def residuals(self, world_from_scan: Poses) -> np.ndarray:
        """(S - 1, 6), rad and m, of poses (S, 4, 4); see `pose_graph.residuals`."""
        return pose_graph.residuals(world_from_scan, self._edges())

    def linearize(self, world_from_scan: Poses) -> NormalEquations:
        """The normal equations at poses (S, 4, 4); Gauss-Newton."""
        return pose_graph.linearize(world_from_scan, self._edges())

    def _edges(self) -> Edges:
        earlier = np.arange(len(self.information))
        return Edges(
            first=earlier,
            second=earlier + 1,
            first_from_second=self.previous_from_next,
            information=self.information,
            is_loop=np.zeros(len(earlier), bool),
        )


def odometry_prior(world_from_scan: Poses, sigma_rotation: float, sigma_translation: float) -> OdometryPrior:
    """The prior of rough poses (S, 4, 4) with standard deviations (rad, m) of one step."""
    information = np.diag([sigma_rotation**-2] * 3 + [sigma_translation**-2] * 3)
    steps = geometry.inverse(world_from_scan[:-1]) @ world_from_scan[1:]
    return OdometryPrior(steps, np.broadcast_to(information, (len(steps), 6, 6)).copy())


def reestimated(
    prior: OdometryPrior, world_from_scan: Poses, held: np.ndarray, ceiling: StepSigmas
) -> OdometryPrior:
    """The prior with the standard deviations that its errors at refined poses (S, 4, 4) show; robust (median).

    held: (S,) bool, scans that planes hold in every direction: only steps between two of these tell how wrong the
        odometry is; where they are few the prior stays as it is
    ceiling: (6,), rad and m, [rotation | translation], no estimate is larger
    """
    error = np.abs(prior.residuals(world_from_scan))[held[1:] & held[:-1]]
    if len(error) < _FEWEST_STEPS:
        return prior
    rotation, translation = (1.4826 * float(np.median(error[:, part])) for part in (slice(3), slice(3, 6)))
    sigma = np.repeat([max(rotation, _FLOOR_ROTATION), max(translation, _FLOOR_TRANSLATION)], 3)
    information = np.diag(np.minimum(sigma, ceiling) ** -2)
    return replace(prior, information=np.broadcast_to(information, prior.information.shape).copy())
