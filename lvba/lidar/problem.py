"""The planes of one association, odometry and IMU as one least-squares problem over the poses of the scans."""

from dataclasses import dataclass

import numpy as np

from lvba import geometry
from lvba.arrays import Poses
from lvba.inertial.factor import InertialFactor
from lvba.lidar import plane_factor
from lvba.lidar.odometry_factor import OdometryPrior
from lvba.lidar.plane_feature import PlaneFeatures, PlaneFits, fit
from lvba.optim.levenberg_marquardt import SolverConfig, levenberg_marquardt
from lvba.optim.normal_equations import NormalEquations

_COST_NOISE = 10.0
"""A change of the cost that means nothing. Degenerate directions are held against what the planes' noise would have them
do, so the cost of the planes may rise by about as much."""
_REFUSALS = 8


@dataclass(frozen=True)
class Problem:
    """Planes, how sharply they are measured, and the prior.

    features: the plane observations
    sigma: m, standard deviation of a point's distance to its plane at weight 1
    """

    features: PlaneFeatures
    sigma: float
    prior: OdometryPrior | None
    projector: np.ndarray | None = None
    """(S, 6, 6), local tangent, keeps of a motion what the planes determine (see `degeneracy`); None: all of it."""
    inertial: InertialFactor | None = None
    """What an IMU felt between the scans; None: there is none, or it is not used."""

    def cost(self, world_from_scan: Poses, fits: PlaneFits | None = None) -> float:
        """Half the sum of squared normalized residuals at poses (S, 4, 4); fits: of the planes there, if at hand."""
        fits = fit(self.features, world_from_scan) if fits is None else fits
        planes = 0.5 * fits.cost / self.sigma**2
        others = self.prior.cost(world_from_scan) if self.prior else 0.0
        return planes + others + (self.inertial.cost(world_from_scan) if self.inertial else 0.0)

    def linearize(
        self, world_from_scan: Poses, exact: bool = True, fits: PlaneFits | None = None
    ) -> NormalEquations:
        """The normal equations at poses (S, 4, 4); exact: second derivatives, not Gauss-Newton's; fits: as in `cost`."""
        equations = plane_factor.linearize(self.features, world_from_scan, self.sigma, fits, exact)
        if self.projector is not None:
            equations = equations.projected(self.projector)
        others = self.linearize_others(world_from_scan)
        return equations if others is None else equations + others

    def linearize_others(self, world_from_scan: Poses) -> NormalEquations | None:
        """The normal equations at poses (S, 4, 4) of all but the planes: odometry and IMU; None: there is neither."""
        terms = [term.linearize(world_from_scan) for term in (self.prior, self.inertial) if term is not None]
        return sum(terms[1:], terms[0]) if terms else None


@dataclass(frozen=True)
class LidarSolution:
    """Poses (S, 4, 4), the cost before and after, and the accepted steps."""

    world_from_scan: np.ndarray
    cost_before: float
    cost_after: float
    steps: int


def solve(
    problem: Problem,
    world_from_scan: Poses,
    damping_metric: np.ndarray,
    *,
    steps: int = 10,
    exact: bool = True,
    tolerance: float = 1e-9,
) -> LidarSolution:
    """At most `steps` accepted steps, fewer where the cost stands still. The first pose stays.

    damping_metric: (6,) float64, information about each scan's motion that one unit of damping adds; see
    `levenberg_marquardt`
    exact: Newton steps, where the Hessian is positive; else Gauss-Newton's
    tolerance: decrease of the cost, as a part of it, that ends it
    """
    free = np.ones((len(world_from_scan), 6), bool)
    free[0] = False
    at = _Linearizer(problem)
    minimum = levenberg_marquardt(
        world_from_scan,
        lambda poses: at.linearize(poses, exact),
        lambda poses, step: geometry.retract(poses, step.blocks),
        SolverConfig(
            max_iterations=steps + _REFUSALS,
            initial_damping=0.0,
            relative_decrease=tolerance,
            refusals=_REFUSALS,
            step_tolerance=0.0,
        ),
        free,
        cost=at.cost,
        convex=(lambda poses: at.linearize(poses, False)) if exact else None,
        metric=damping_metric,
        cost_noise=0.0 if problem.projector is None else _COST_NOISE,
        most_accepted=steps,
    )
    accepted = sum(entry.accepted for entry in minimum.history)
    return LidarSolution(minimum.state, minimum.cost_initial, minimum.cost, accepted)


class _Linearizer:
    """Cost and equations of a problem; planes fitted for the one are not fitted again for the other."""

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._known: list[tuple[np.ndarray, PlaneFits]] = []

    def cost(self, poses: np.ndarray) -> float:
        return self._problem.cost(poses, self._fits(poses))

    def linearize(self, poses: np.ndarray, exact: bool) -> NormalEquations:
        return self._problem.linearize(poses, exact, self._fits(poses))

    def _fits(self, poses: np.ndarray) -> PlaneFits:
        for known, fits in self._known:
            if known is poses:
                return fits
        fits = fit(self._problem.features, poses)
        self._known = [*self._known[-1:], (poses, fits)]
        return fits
