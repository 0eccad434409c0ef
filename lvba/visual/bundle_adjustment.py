"""One pyramid level of the visual bundle adjustment: photometric cost plus prior, by Levenberg-Marquardt."""

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_matrix

from lvba.camera import Camera
from lvba.optim import levenberg_marquardt, linear_solver
from lvba.optim.levenberg_marquardt import Iteration, SolverConfig
from lvba.optim.linear_solver import Covariance
from lvba.optim.normal_equations import NormalEquations, Step
from lvba.visual import (
    camera_motion,
    covariance,
    fixed_calibration,
    noise,
    photometric,
    planes_off,
    trajectory_prior,
    trajectory_sigmas,
)
from lvba.visual.calibration_prior import Evidence
from lvba.visual.covariance import WallClusters, WallGradients
from lvba.visual.exposure_graph import components
from lvba.visual.noise import NoiseModel
from lvba.visual.patch_shifts import Shifts
from lvba.visual.photometric import Linearization, PhotometricState, Problem
from lvba.visual.scene_points import SCENE_POINTS, Observations, ScenePoints
from lvba.visual.states import Calibration, VisualState
from lvba.visual.trajectory_prior import Prior, Source
from lvba.visual.variant import PRODUCT, Variant

logger = logging.getLogger(__name__)

_QUICK_DECREASE = 1e-3
"""Where weights are about to be estimated anew, a solve stops at this relative decrease."""

_OF_ALL_IMAGES = ("scan_from_camera", "time_offset")
"""What all images are off together by, for whoever compares them with the scans."""
ROUNDS = 3
"""Solves per level, each with noise level and prior estimated anew from the last: a fourth changes neither."""
PLANE_FLOOR_M = 0.001
"""m: no plane is taken as better known than this; surfaces are not flatter."""
SOLVER = SolverConfig(max_iterations=12, initial_damping=1e-6, relative_decrease=1e-4)
"""Of the last solve of a level. What lowers the cost by less moves each unknown, plane offsets among them, by a tenth of
its standard deviation: poses after eight more steps end 0.01 mm elsewhere. Damped by little: what turns all
cameras together and shifts the principal point (or changes the clock, or the readout) is known a million times less well
than each camera by itself."""


@dataclass(frozen=True)
class LevelSolution:
    """What one level ends with.

    linearization: of the photometric cost at the solution
    photometric: the same state as the photometric cost has it, with the offset of each scene point's plane
    wall_clusters: which pieces of wall its images see
    noise: what the problem's sigma come from
    prior: nothing of the calibration fixed, so that covariances have what it may be off; fixed: which parameters of
        the calibration that were, all the same
    """

    state: VisualState
    photometric: PhotometricState
    problem: Problem
    wall_clusters: WallClusters
    noise: NoiseModel
    prior: Prior | None
    fixed: tuple[str, ...]
    linearization: Linearization
    free: np.ndarray
    history: tuple[Iteration, ...]
    converged: bool

    @property
    def corrected(self) -> bool:
        """Whether the calibration is not as it was given, but for what is always refined."""
        if self.prior is None:
            return False
        camera = self.problem.shifts is not None and not set(fixed_calibration.CORRECTIONS) <= set(self.fixed)
        return camera or self.prior.drifting


@dataclass(frozen=True)
class LevelConfig:
    """How one level is solved.

    patch: side of a patch, px, odd; rounds: solves, each with noise level and prior estimated anew from the last
    variance_factor: first guess of actual over modeled variance of the pixels; finest: no other level follows
    """

    patch: int = SCENE_POINTS.size
    rounds: int = ROUNDS
    solver: SolverConfig = SOLVER
    variance_factor: float = 10.0
    finest: bool = True


def solve(
    images: np.ndarray,
    camera: Camera,
    points: ScenePoints,
    observations: Observations,
    state: VisualState,
    prior: Prior | None,
    config: LevelConfig = LevelConfig(),
    *,
    variant: Variant = PRODUCT,
    shifts: Callable[[VisualState], Shifts] | None = None,
) -> LevelSolution:
    """The state of least cost at one level.

    images: (I, H, W, C) uint8, the level's; camera: undistorted, of the level
    prior: None for the paper's cost
    shifts: how the calibration moves patches about a state, found anew for each round; None: it moves none
    """
    sigma = offset_sigma(points, PLANE_FLOOR_M) if variant.plane_offsets else None
    problem = photometric.prepare(
        images, camera, points, observations, config.patch,
        offset_sigma=sigma, variance_factor=config.variance_factor, reference_pixels=variant.reference_pixels,
    )  # fmt: skip
    free = _free(problem, prior is not None, variant.exposures == "joint")
    at = _State(PhotometricState(state.cameras, np.zeros(len(points))), state.calibration, state.motion)
    history: tuple[Iteration, ...] = ()
    solver = config.solver
    quick = replace(solver, relative_decrease=max(solver.relative_decrease, _QUICK_DECREASE))
    problem, at = _about(problem, at, shifts)
    sums = photometric.sums(problem, at.photometric)
    wall_clusters = covariance.find_wall_clusters(problem)
    chosen = variant.camera == "refined"
    fixed: tuple[str, ...] = () if chosen else fixed_calibration.CORRECTIONS
    for turn in range(config.rounds):
        last = turn == config.rounds - 1
        scatter = noise.estimate(sums, problem.samples)
        problem = replace(problem, sigma=scatter.sigma(noise.gradients(sums)))
        del sums  # as large as all images; so is what the next turn makes anew
        model = _Model(problem, prior if prior is None else trajectory_prior.with_fixed(prior, fixed))
        how = solver if last else quick
        solution = levenberg_marquardt.levenberg_marquardt(at, model.linearize, model.retract, how, free)
        at, history = solution.state, history + solution.history
        linearization = model.at(at)
        sums = linearization.sums
        if not last:
            one_left = turn == config.rounds - 2
            solved = _turn(problem, wall_clusters, at, linearization, free, prior)
            if shifts is not None and prior is not None and one_left and chosen:
                fixed = _fixed(solved, prior)
            if config.finest and prior is not None and one_left:
                prior, at = _with_clock(solved, prior)
            keep = config.finest and one_left
            problem, prior = _reweighted(replace(solved, at=at), prior, keep)
            # not by a readout that may be chance
            if shifts is not None and prior is not None and (one_left or state.calibration.readout):
                at = _with_motion(problem, prior, at, sums, fixed)
            problem, at = _about(problem, at, shifts)
            del linearization, solved, solution, model
    calibration = at.calibration
    if prior is not None:
        calibration = fixed_calibration.restored(calibration, prior.calibration.reference, fixed)
    return LevelSolution(
        state=VisualState(at.photometric.cameras, calibration, at.motion),
        photometric=at.photometric,
        problem=problem,
        wall_clusters=wall_clusters,
        noise=scatter,
        prior=prior,
        fixed=fixed,
        linearization=linearization,
        free=free,
        history=history,
        converged=solution.converged,
    )


def _about(
    problem: Problem, at: "_State", shifts: Callable[[VisualState], Shifts] | None
) -> tuple[Problem, "_State"]:
    """The problem with shifts about a state, and the state as it is counted from there."""
    if shifts is None:
        return problem, at
    now = shifts(at.visual)
    photometric = replace(at.photometric, shared=np.zeros(now.size))
    return replace(problem, shifts=now), replace(at, photometric=photometric)


def _with_motion(
    problem: Problem, prior: Prior, at: "_State", sums: np.ndarray, fixed: tuple[str, ...]
) -> "_State":
    """The state with the motion during each image as its rows tell it; without, where all are read at once."""
    if "readout" in fixed:
        return replace(at, motion=None)
    held = trajectory_prior.with_fixed(prior, fixed)
    state = camera_motion.by_rows(problem, at.photometric, sums, held, at.visual)
    return replace(at, calibration=state.calibration, motion=state.motion)


def offset_sigma(points: ScenePoints, floor_m: float, scale: float = 1.0) -> np.ndarray:
    """(P,) m: how far the plane at each point may be off, so that a plane's points together know what one does.

    The points of a plane share its error. Each has an offset of its own here, so each gets the variance times the
    number of points on the plane: then their sum carries the information of one measurement of the plane. What the
    surface is off its plane differs from point to point.
    scale: how many times further than the LiDAR says planes are off
    """
    _, plane, count = np.unique(points.plane, return_inverse=True, return_counts=True)
    shared = scale * np.maximum(points.sigma_plane, floor_m) * np.sqrt(count[plane])
    return np.asarray(np.hypot(shared, points.unevenness))


@dataclass(frozen=True)
class _State:
    photometric: PhotometricState
    calibration: Calibration
    motion: np.ndarray | None

    @property
    def visual(self) -> VisualState:
        return VisualState(self.photometric.cameras, self.calibration, self.motion)


@dataclass(frozen=True)
class _Turn:
    """What a solve ended with.

    free: (I, 7) bool; gradients: about what is known of the images with the prior, whatever that frees of what they
        share; None without one
    """

    problem: Problem
    wall_clusters: WallClusters
    at: _State
    linearization: Linearization
    free: np.ndarray
    gradients: WallGradients | None


def _turn(
    problem: Problem,
    wall_clusters: WallClusters,
    at: _State,
    linearization: Linearization,
    free: np.ndarray,
    prior: Prior | None,
) -> _Turn:
    gradients = None
    if prior is not None:
        total = joint(linearization.equations, prior, at.visual)
        gradients = covariance.wall_gradients(problem, linearization, at.photometric, wall_clusters, total)
    return _Turn(
        problem=problem, wall_clusters=wall_clusters, at=at, linearization=linearization, free=free, gradients=gradients,
    )  # fmt: skip


class _Model:
    """Linearizes and retracts for the solver; remembers the last two linearizations, which both steps need."""

    def __init__(self, problem: Problem, prior: Prior | None) -> None:
        self._problem, self._prior = problem, prior
        self._known: list[tuple[_State, Linearization]] = []

    def at(self, state: _State) -> Linearization:
        for known, linearization in self._known:
            if known is state:
                return linearization
        linearization = photometric.linearize(self._problem, state.photometric)
        self._known = [*self._known[-1:], (state, linearization)]
        return linearization

    def linearize(self, state: _State) -> NormalEquations:
        return joint(self.at(state).equations, self._prior, state.visual)

    def retract(self, state: _State, step: Step) -> _State:
        moved = photometric.retract(self._problem, state.photometric, self.at(state), step)
        return _State(moved, state.calibration.retract(step.shared), state.motion)


def joint(equations: NormalEquations, prior: Prior | None, state: VisualState) -> NormalEquations:
    """Photometric equations plus the prior's, over I blocks of 7, bordered by the calibration where there is a prior."""
    return equations if prior is None else equations + trajectory_prior.linearize(prior, state)


def _free(problem: Problem, with_prior: bool, solve_exposures: bool) -> np.ndarray:
    """(I, 7) bool: what may move. One exposure per component is held: its scale is free (A2, one gauge each)."""
    images, pairs = len(problem.images), problem.pairs
    free = np.ones((images, 7), bool)
    seen = np.zeros(images, bool)
    seen[pairs.reference] = seen[pairs.target] = True
    _, first = np.unique(components(pairs.reference, pairs.target, images), return_index=True)
    free[:, 6] = seen & solve_exposures
    free[first, 6] = False
    if not with_prior:
        free[:, :6] &= seen[:, None]
    return free


def _reweighted(solved: _Turn, prior: Prior | None, keep: bool) -> tuple[Problem, Prior | None]:
    """The variance factor, plane offsets' sigma and the prior's sigmas estimated anew (variance components)."""
    problem, at, linearization = solved.problem, solved.at, solved.linearization
    if problem.offset_sigma is not None:
        more = covariance.offset_scale(problem, at.photometric.offset, linearization.offset_hessian)
        scale = more * problem.offset_scale
        sigma = offset_sigma(problem.points, PLANE_FLOOR_M, scale)
        problem = replace(problem, offset_sigma=sigma, offset_scale=scale)
    clusters = covariance.cluster_gradients(problem, linearization, solved.wall_clusters)
    ratio = covariance.variance_factor(linearization.equations, clusters)
    variance_factor = max(problem.variance_factor * ratio, 1.0)
    if prior is not None:
        total = joint(linearization.equations, prior, at.visual)
        known = linear_solver.covariance(total, solved.free)
        undecided = tuple(_undecided(prior, source, at.visual, known) for source in prior.sources)
        assert solved.gradients is not None
        clusters = covariance.bias_reduced_gradients(solved.gradients, total.shared)
        said = _evidence(prior, at, clusters, known, problem.variance_factor / variance_factor)
        prior = trajectory_prior.weighed(prior, said, keep)
        prior = trajectory_prior.with_late(prior, at.calibration)
        prior = trajectory_sigmas.reestimated(prior, at.visual, undecided)
    return replace(problem, variance_factor=variance_factor), prior


def _evidence(prior: Prior, at: _State, clusters: csr_matrix, known: Covariance, deflated: float) -> Evidence:
    """What the images tell of the calibration, and how far they contradict themselves about it.

    clusters: (clusters, 7 I + k) gradients per piece of wall; deflated: by what factor the information of the images is
    about to change
    """
    every = np.linalg.inv(known.shared)
    now = prior.calibration.hessian(at.calibration)
    count = known.with_shared[..., 0].size
    # by the calibration, all cameras following: the columns of the inverse over its corner
    following = np.concatenate([known.with_shared.reshape(count, -1) @ every, np.eye(len(every))])
    gradients = clusters @ following
    pull = deflated * every @ at.calibration.deviation(prior.calibration.reference)
    return Evidence(deflated * (every - now), deflated**2 * (gradients.T @ gradients), pull)


def _undecided(prior: Prior, source: Source, state: VisualState, known: Covariance) -> np.ndarray:
    """(I, 6): posterior variance of each frame's deviation from a source of the prior."""
    by_camera, by_calibration = trajectory_prior.jacobians(prior, source, state)
    cross = by_camera @ known.with_shared[:, :6] @ np.swapaxes(by_calibration, 1, 2)
    total = by_camera @ known.blocks[:, :6, :6] @ np.swapaxes(by_camera, 1, 2)
    total += cross + np.swapaxes(cross, 1, 2)
    total += by_calibration @ known.shared @ np.swapaxes(by_calibration, 1, 2)
    return np.asarray(np.diagonal(total, axis1=1, axis2=2))


def covariance_of(solution: LevelSolution) -> tuple[Covariance, np.ndarray]:
    """Of the images' unknowns, (I, 7, 7) blocks, and of the calibration, which counts errors of each image as its own.

    And of the poses (I, 6, 6), were extrinsic and time offset known, whose errors all images share.
    """
    problem, prior, linearization = solution.problem, solution.prior, solution.linearization
    at = _State(solution.photometric, solution.state.calibration, solution.state.motion)
    total = joint(linearization.equations, prior, at.visual)
    gradients = covariance.wall_gradients(
        problem, linearization, at.photometric, solution.wall_clusters, total
    )
    clusters = covariance.balanced_gradients(gradients, total.shared)
    poses = linear_solver.sandwich(total, clusters, _gradient_variance(prior, at), solution.free)
    solved = _Turn(
        problem=problem, wall_clusters=solution.wall_clusters, at=at, linearization=linearization,
        free=solution.free, gradients=gradients,
    )  # fmt: skip
    own = _sandwich_of_calibration(solved, prior, total)
    known = with_held = replace(poses, shared=own)
    if prior is not None:
        # balanced gradients predict too small errors of the camera, which turns all images: on a road, 0.2 px for a
        # principal point that was 0.6 px off, where those of each image by itself say 0.8
        plain, camera = linear_solver.covariance(total, solution.free), fixed_calibration.indices()
        poses = linear_solver.with_errors_of_shared(poses, own - poses.shared, plain, camera)
        place = Calibration.layout()["readout"].start
        but_fixed = trajectory_prior.with_fixed(prior, solution.fixed)
        own[place, place] += camera_motion.readout_variance(
            problem, at.photometric, linearization.sums, but_fixed, at.visual
        )
        known = planes_off.with_planes_off(replace(poses, shared=own), plain, prior, at.calibration)
        with_held = _with_held(known, plain.shared, solved, total, solution.fixed)
    shared = fixed_calibration.indices(_OF_ALL_IMAGES) if prior is not None else np.zeros(0, np.int64)
    return with_held, (poses.given(shared) + with_held.blocks - known.blocks)[:, :6, :6]


def _with_held(
    known: Covariance, plain: np.ndarray, solved: _Turn, total: NormalEquations, fixed: tuple[str, ...]
) -> Covariance:
    """The covariance, with how far all would move were the parameters free that are held, where that is no chance."""
    step = linear_solver.solve_step(total, 0.0, solved.free) if fixed else None
    if step is None:
        return known
    fraction = fixed_calibration.significant_fraction(
        step.shared, _precision(known.shared, plain, solved), fixed
    )
    return linear_solver.with_errors(
        known, step.blocks[..., None], step.shared[:, None], np.array([[fraction]])
    )


def _precision(calibration: np.ndarray, plain: np.ndarray, solved: _Turn) -> fixed_calibration.Precision:
    """calibration: (k, k), its covariance; plain: (k, k), the same as the information has it"""
    per_pixel = noise.per_pixel(solved.problem.information, solved.linearization.sums)
    return fixed_calibration.Precision(covariance=calibration, plain=plain, per_pixel=per_pixel)


def _covariance_of_calibration(
    plain: np.ndarray, solved: _Turn, prior: Prior, total: NormalEquations
) -> np.ndarray:
    """(k, k), with errors of ranges that all planes have in common; plain: as of `_precision`; total: `joint`"""
    own = _sandwich_of_calibration(solved, prior, total)
    return np.asarray(own + planes_off.of_calibration(plain, prior, solved.at.calibration))


def _sandwich_of_calibration(solved: _Turn, prior: Prior | None, total: NormalEquations) -> np.ndarray:
    """(k, k), by what pieces of wall contradict each other; total: `joint`, at this state."""
    assert solved.gradients is not None
    clusters = covariance.bias_reduced_gradients(solved.gradients, total.shared)
    return linear_solver.shared_sandwich(total, clusters, _gradient_variance(prior, solved.at), solved.free)


def _gradient_variance(prior: Prior | None, at: _State) -> NormalEquations | None:
    return None if prior is None else trajectory_prior.gradient_variance(prior, at.visual)


def _fixed(solved: _Turn, prior: Prior) -> tuple[str, ...]:
    """The parameters of the calibration that the images do not call to correct."""
    linearization, calibration = solved.linearization, solved.at.calibration
    total = joint(linearization.equations, prior, solved.at.visual)
    plain = linear_solver.shared_covariance(total, solved.free)
    known = _precision(_covariance_of_calibration(plain, solved, prior, total), plain, solved)
    return fixed_calibration.insignificant(calibration.deviation(prior.calibration.reference), known)


def _with_clock(solved: _Turn, prior: Prior) -> tuple[Prior, _State]:
    """Prior and state with a rate of the camera's clock where images call for one: a step from here, were it free, must
    not be chance."""
    at, asked = solved.at, replace(prior, drifting=True)
    total = joint(solved.linearization.equations, asked, at.visual)
    step = linear_solver.solve_step(total, 0.0, solved.free)
    if step is None:
        return prior, at
    column = Calibration.layout()["clock_rate"].start
    plain = linear_solver.shared_covariance(total, solved.free)
    variance = _covariance_of_calibration(plain, solved, asked, total)[column, column]
    rate = at.calibration.clock_rate + step.shared[column]
    drifting = fixed_calibration.beyond_chance(rate, float(np.sqrt(variance)))
    if not drifting:
        at = replace(at, calibration=replace(at.calibration, clock_rate=0.0))
    return replace(prior, drifting=drifting), at
