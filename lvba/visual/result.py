"""What the visual stage hands back: poses of all images, their errors, and an account of every level."""

from dataclasses import dataclass, field, replace

import numpy as np

from lvba.arrays import Indices, Poses, Times
from lvba.optim.levenberg_marquardt import Iteration
from lvba.optim.linear_solver import Covariance
from lvba.trajectory import nearest_in_time
from lvba.visual import (
    bundle_adjustment,
    calibration_prior,
    camera_motion,
    degeneracy,
    exposures_between,
    image_groups,
    photometric,
    pixel_noise,
    trajectory_prior,
)
from lvba.visual.bundle_adjustment import LevelSolution
from lvba.visual.calibration_prior import NO_CHANGE, ExtrinsicChange
from lvba.visual.degeneracy import DegenerateDirections
from lvba.visual.photometric import PhotometricState, Problem
from lvba.visual.radiometry import NONE, Radiometry
from lvba.visual.states import Calibration, CameraStates, VisualState
from lvba.visual.trajectory_prior import Prior
from lvba.visual.white_balance import WhiteBalance
from lvba.wording import first_of

_NAMED = 12
"""At most so many frames are named in a warning."""


@dataclass(frozen=True)
class LevelReport:
    """What happened at one pyramid level."""

    level: int
    scene_points: int
    global_points: int
    local_pairs: int
    global_pairs: int
    sigma: float
    """Standard deviation of the residuals of an observation, of 255: the median."""
    shift: float
    """How much of it grows with the image gradient, px."""
    rms: float
    """Root mean square of all valid residuals, of 255."""
    variance_factor: float
    """Actual over modeled variance of the pixels."""
    noise_variance_factor: float
    """The same, had the images nothing but noise of their pixels, which patches share."""
    prior_position_m: tuple[float, ...]
    """Spread of the cameras about the LiDAR trajectory: by eq. (1), and by splines; empty without prior."""
    prior_rotation_deg: tuple[float, ...]
    iterations: tuple[Iteration, ...]
    converged: bool
    compared: int = 0
    """In how many neighboring images a patch should be seen and was compared."""
    alike: int = 0
    """In how many of these it looks alike; of several parts, both in the part where the fewest do."""


@dataclass(frozen=True)
class VisualResult:
    """The refined cameras, with what is known about their errors.

    world_from_camera: (I, 4, 4) float64, all images; keyframes: (K,) indices of those that were solved
    log_exposure: (I,) float64, first image 0
    covariance: (I, 6, 6) float64, of `[rotation | translation]` in the camera's frame (rad, m)
    local_covariance: (I, 6, 6) float64, the same relative to the map about each camera, without that map's own errors
    own_covariance: (I, 6, 6) float64, the part of that which errors of extrinsic and clock, shared by all, do not explain
    log_exposure_sigma: (I,) float64
    calibration: as found; calibration_sigma: (k,) standard deviations of its numbers, in the order and units of
        `Calibration.layout()`
    degenerate: (I,) int32, number of common motions of an image and its scene that nothing it sees holds
    degenerate_common: (k, 6) float64, motions `[rotation | translation]` of all images about their scene's middle, world
        axes, that no image holds: there the result is the prior's
    cost_initial, cost_final: photometric cost of the finest level at the carried rough poses and at the result
    radiometry: that poses and exposures suppose
    extrinsic_change: of the extrinsic found from the calibrated one
    white_balance: (I, 3) float64, log of how much brighter red, green and blue of an image are than its exposure says,
        each 0 on average, and exposures are means over the colors; None: it does not change
    substituted: (r,) int64, images whose poses are their neighbors' (`lvba.steps.camera_outliers`)
    clock_epoch: s, the stamp that the rate of the camera's clock counts from
    turns: (I, 3) float64, rad, about each camera's own axes, from the first row of its image to the last; None: all rows
        are read at once
    group: (I,) int64, of keyframes: pairs of patches tie those of one group to each other (`image_groups.find`); -1 of
        other images; empty: not known
    """

    world_from_camera: np.ndarray
    log_exposure: np.ndarray
    covariance: np.ndarray
    local_covariance: np.ndarray
    own_covariance: np.ndarray
    log_exposure_sigma: np.ndarray
    keyframes: np.ndarray
    calibration: Calibration
    calibration_sigma: np.ndarray
    degenerate: np.ndarray
    degenerate_common: np.ndarray
    levels: tuple[LevelReport, ...]
    cost_initial: float
    cost_final: float
    converged: bool
    warnings: tuple[str, ...]
    radiometry: Radiometry = NONE
    extrinsic_change: ExtrinsicChange = NO_CHANGE
    white_balance: np.ndarray | None = None
    substituted: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    clock_epoch: float = 0.0
    turns: np.ndarray | None = None
    group: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))

    @property
    def scan_from_camera(self) -> np.ndarray:
        """(4, 4), the extrinsic found."""
        return self.calibration.scan_from_camera

    def moments(self, times: Times) -> Times:
        """(I,) s on the LiDAR's clock, at which images with these stamps (I,), s, were taken."""
        return self.calibration.moments(times, self.clock_epoch)

    @property
    def extrinsic_sigma(self) -> np.ndarray:
        """(7,): standard deviations of `[rotation | translation | time offset]`, rad, m and s."""
        sigma = Calibration.layout().named(self.calibration_sigma)
        return np.concatenate([sigma["scan_from_camera"], sigma["time_offset"]])


def level_report(level: int, solution: LevelSolution) -> LevelReport:
    """The account of one level."""
    observations, points = solution.problem.observations, solution.problem.points
    sums = solution.linearization.sums
    sources = () if solution.prior is None else solution.prior.sources
    count = max(float(sums[:, photometric.COUNT].sum()), 1.0)
    return LevelReport(
        level=level,
        scene_points=len(points),
        global_points=int(points.is_global.sum()),
        local_pairs=int((~observations.is_global).sum()),
        global_pairs=int(observations.is_global.sum()),
        sigma=float(np.median(solution.problem.sigma)),
        shift=solution.noise.shift,
        rms=float(np.sqrt(sums[:, photometric.SQUARE].sum() / count)),
        variance_factor=solution.problem.variance_factor,
        noise_variance_factor=pixel_noise.variance_factor(
            solution.problem, solution.photometric, solution.linearization, solution.wall_clusters
        ),
        prior_position_m=tuple(float(np.median(s.sigma_position)) for s in sources),
        prior_rotation_deg=tuple(float(np.degrees(np.median(s.sigma_rotation))) for s in sources),
        iterations=solution.history,
        converged=solution.converged,
        compared=observations.compared,
        alike=observations.alike,
    )


def collect(
    levels: tuple[LevelReport, ...],
    last: LevelSolution,
    state: VisualState,
    directions: DegenerateDirections,
    log_exposure_sigma: np.ndarray,
    start: Poses,
    prior: Prior,
    keyframes: Indices,
    times: Times,
) -> VisualResult:
    """The result from the account of the levels, coarse to fine, and the last level's solution.

    state: final, with its exposures and at the prior along the degenerate directions; log_exposure_sigma: (K,) float64
    start: (K, 4, 4), carried rough poses
    prior: of all I images, before the solve; keyframes: (K,); times: (I,) s of all images
    """
    known, own = bundle_adjustment.covariance_of(last)
    whole = known.blocks[:, :6, :6]
    if last.prior is not None:
        held = degeneracy.held_covariance(state, last.prior, directions)
        whole, own = whole + held, own + held
    solved = trajectory_prior.take(prior, keyframes) if last.prior is None else last.prior
    poses, between = trajectory_prior.fill(prior, solved, state, keyframes, times)
    nearest = nearest_in_time(times[keyframes], times)
    log_exposure, exposure_sigma = exposures_between.of_all(
        times, keyframes, state.cameras.log_exposure, log_exposure_sigma
    )
    local_covariance = whole[nearest] + between
    return VisualResult(
        world_from_camera=poses,
        log_exposure=log_exposure,
        covariance=local_covariance,
        local_covariance=local_covariance,
        own_covariance=own[nearest] + between,
        log_exposure_sigma=exposure_sigma,
        keyframes=keyframes,
        calibration=state.calibration,
        calibration_sigma=_calibration_sigma(known),
        degenerate=directions.count[nearest],
        degenerate_common=directions.common,
        levels=levels,
        cost_initial=_cost(last, start, state),
        cost_final=_cost(last, state.cameras.world_from_camera, state),
        converged=all(report.converged for report in levels),
        warnings=_warnings(last, levels, directions, whole, times[keyframes]),
        extrinsic_change=_extrinsic_change(state, last.prior, known),
        clock_epoch=prior.epoch,
        turns=camera_motion.turns(solved, state, keyframes, times),
        group=_groups(last.problem, keyframes, len(times)),
    )


def _groups(problem: Problem, keyframes: Indices, images: int) -> np.ndarray:
    """As `VisualResult.group`, of so many images. keyframes: (K,)"""
    group = np.full(images, -1)
    group[keyframes] = image_groups.find(problem.points, problem.observations, len(keyframes))
    return group


def with_white_balance(result: VisualResult, balance: WhiteBalance, times: Times) -> VisualResult:
    """The result with exposures that are means over the colors. times: (I,) s of all images; balance: of its keyframes

    Colors are compared with vignetting and response as grey values tell them, whose errors are in the deviations of these
    alone.
    """
    sampled = times[result.keyframes]
    sigma = np.maximum(balance.sigma, result.log_exposure_sigma[result.keyframes])
    log_exposure, sigma = exposures_between.of_all(times, result.keyframes, balance.log_exposure, sigma)
    gains = [np.interp(times, sampled, gain) for gain in balance.log_gain.T]
    return replace(
        result,
        log_exposure=log_exposure,
        log_exposure_sigma=sigma,
        white_balance=np.stack(gains, axis=1),
    )


def _extrinsic_change(state: VisualState, prior: Prior | None, known: Covariance) -> ExtrinsicChange:
    if prior is None:
        return NO_CHANGE
    return calibration_prior.extrinsic_change(state.calibration, prior.calibration, known.shared)


def _calibration_sigma(known: Covariance) -> np.ndarray:
    """(k,); zero where nothing was solved for."""
    sigma = np.zeros(Calibration.layout().size)
    sigma[: len(known.shared)] = np.sqrt(np.diagonal(known.shared))
    return sigma


def _cost(solution: LevelSolution, world_from_camera: np.ndarray, state: VisualState) -> float:
    """Photometric cost of the finest level over planes as the LiDAR found them."""
    cameras = CameraStates(world_from_camera, state.cameras.log_exposure)
    at = PhotometricState(cameras, np.zeros(len(solution.problem.points)), solution.photometric.shared)
    return photometric.cost(solution.problem, photometric.sums(solution.problem, at))


def _warnings(
    solution: LevelSolution,
    levels: tuple[LevelReport, ...],
    directions: DegenerateDirections,
    blocks: np.ndarray,
    times: np.ndarray,
) -> tuple[str, ...]:
    """What the user should know, one sentence each. times: (K,) s, stamps of the images that are solved for"""
    warnings = []
    open_levels = [str(report.level) for report in levels if not report.converged]
    if open_levels:
        warnings.append(
            f"the visual bundle adjustment had not converged at pyramid level {', '.join(open_levels)}; "
            "more solver iterations (visual.iterations) may help"
        )
    held = "the LiDAR trajectory" if solution.prior is not None else "nothing (the prior is off)"
    if len(directions.common):
        warnings.append(
            f"the images do not see planes that hold all cameras in {len(directions.common)} directions; "
            f"there {held} holds them"
        )
    pairs, count = solution.problem.pairs, len(solution.problem.images)
    unseen = np.setdiff1d(np.arange(count), np.concatenate([pairs.reference, pairs.target]))
    if len(unseen):
        warnings.append(f"{len(unseen)} images share no scene point with others: {_stamps(times[unseen])}")
    spread = np.sqrt(np.trace(blocks[:, 3:6, 3:6], axis1=1, axis2=2))
    uncertain = np.flatnonzero(spread > 3 * np.median(spread))
    if len(uncertain):
        warnings.append(
            f"{len(uncertain)} images have expected errors more than 3 times the median: {_stamps(times[uncertain])}"
        )
    return tuple(warnings)


def _stamps(times: np.ndarray) -> str:
    """Stamps (n,), s, as files of images and of poses have them: a part of a recording numbers its images anew."""
    return first_of([f"{time:.6f}" for time in times], _NAMED)
