"""What a solve found out about noise, for later solves of the same images that are to weigh them alike."""

from dataclasses import dataclass

import numpy as np

from lvba.visual.bundle_adjustment import LevelSolution
from lvba.visual.calibration_prior import Evidence
from lvba.visual.noise import NoiseModel


@dataclass(frozen=True)
class Tuning:
    """What the solve of one part found about noise, kept in the joint rounds.

    noise: of residuals; variance_factor: actual over modeled variance of the pixels
    offset_scale: how many times further than the LiDAR says planes are off
    sigma_rotation, sigma_position: (sources, k) of each source of the prior, rad and m
    correlation_inflation: (sources, 2), of rotation and position
    evidence: of the images about the calibration; None: there is no prior
    fixed: names of the parameters of the calibration that the images do not call to correct
    drifting: whether they call for a rate of the camera's clock
    motion: (k, 6), as of `states.VisualState`; None: all rows are read at once
    """

    noise: NoiseModel
    variance_factor: float
    offset_scale: float
    sigma_rotation: np.ndarray
    sigma_position: np.ndarray
    correlation_inflation: np.ndarray
    evidence: Evidence | None
    fixed: tuple[str, ...] = ()
    drifting: bool = False
    motion: np.ndarray | None = None


def tuning(solution: LevelSolution) -> Tuning:
    """The tuning that a level was solved with last."""
    problem, sources = solution.problem, () if solution.prior is None else solution.prior.sources
    return Tuning(
        noise=solution.noise,
        variance_factor=problem.variance_factor,
        offset_scale=problem.offset_scale,
        sigma_rotation=np.array([source.sigma_rotation for source in sources]),
        sigma_position=np.array([source.sigma_position for source in sources]),
        correlation_inflation=np.array([source.correlation_inflation for source in sources]),
        evidence=None if solution.prior is None else solution.prior.evidence,
        fixed=solution.fixed,
        drifting=solution.prior is not None and solution.prior.drifting,
        motion=solution.state.motion,
    )
