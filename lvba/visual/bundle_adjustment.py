"""One pyramid level of the visual bundle adjustment: photometric cost plus prior, by Levenberg-Marquardt."""

import logging
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components

from lvba.camera import Camera
from lvba.optim import levenberg_marquardt, linear_solver
from lvba.optim.levenberg_marquardt import Iteration, SolverConfig
from lvba.optim.normal_equations import NormalEquations
from lvba.visual import covariance, extrinsic_prior, noise, photometric, trajectory_sigmas
from lvba.visual import trajectory_prior as priors
from lvba.visual.covariance import Shares
from lvba.visual.noise import NoiseModel
from lvba.visual.photometric import Linearization, PhotometricState, Problem
from lvba.visual.scene_points import SCENE_POINTS, Observations, ScenePoints
from lvba.visual.states import Mount, VisualState
from lvba.visual.trajectory_prior import Prior, Source
from lvba.visual.variant import PRODUCT, Variant

logger = logging.getLogger(__name__)

_QUICK_DECREASE = 1e-3
"""Where weights are about to be estimated anew, a solve stops at this relative decrease."""


ROUNDS = 3
"""Solves per level, each with noise level and prior estimated anew from the last: a fourth changes neither."""
PLANE_FLOOR_M = 0.001
"""m: no plane is taken as better known than this; surfaces are not flatter."""
SOLVER = SolverConfig(max_iterations=12, relative_decrease=1e-5)
"""Of the last solve at the finest level."""


@dataclass(frozen=True)
class LevelSolution:
    """What one level ends with.

    linearization: of the photometric cost at the solution
    offset: (P,) m, how far each scene point's plane was moved along its normal
    shares: which pieces of wall its images see
    noise: what the problem's sigma come from
    """

    state: VisualState
    offset: np.ndarray
    problem: Problem
    shares: Shares
    noise: NoiseModel
    prior: Prior | None
    linearization: Linearization
    free: np.ndarray
    history: tuple[Iteration, ...]
    converged: bool


def solve(
    images: np.ndarray,
    camera: Camera,
    points: ScenePoints,
    observations: Observations,
    state: VisualState,
    prior: Prior | None,
    *,
    patch: int = SCENE_POINTS.size,
    rounds: int = ROUNDS,
    solver: SolverConfig = SOLVER,
    inflation: float = 10.0,
    variant: Variant = PRODUCT,
) -> LevelSolution:
    """The state of least cost at one level.

    images: (I, H, W, C) uint8, the level's; camera: undistorted, of the level
    prior: None for the paper's cost
    patch: side of a patch, px, odd; rounds: solves, each with noise level and prior estimated anew from the last
    inflation: first guess of how many times the pixels' information overstates itself
    """
    sigma = offset_sigma(points, PLANE_FLOOR_M) if variant.plane_offsets else None
    problem = photometric.prepare(
        images, camera, points, observations, patch,
        offset_sigma=sigma, inflation=inflation, reference_pixels=variant.reference_pixels,
    )  # fmt: skip
    free = _free(problem, prior is not None, variant.exposures == "joint")
    at = _State(PhotometricState(state.cameras, np.zeros(len(points))), state.mount)
    history: tuple[Iteration, ...] = ()
    quick = replace(solver, relative_decrease=max(solver.relative_decrease, _QUICK_DECREASE))
    sums = photometric.sums(problem, at.photometric)
    shares = covariance.shares_of(problem)
    for turn in range(rounds):
        last = turn == rounds - 1
        scatter = noise.estimate(sums, problem.samples)
        problem = replace(problem, sigma=scatter.sigma(noise.gradients(sums)))
        model = _Model(problem, prior)
        how = solver if last else quick
        solution = levenberg_marquardt.levenberg_marquardt(at, model.linearize, model.retract, how, free)
        at, history = solution.state, history + solution.history
        linearization = model.at(at)
        sums = linearization.sums
        if not last:
            problem, prior = _reweighted(problem, shares, prior, at, linearization, free)
    visual = VisualState(at.photometric.cameras, at.mount)
    return LevelSolution(
        visual,
        at.photometric.offset,
        problem,
        shares,
        scatter,
        prior,
        linearization,
        free,
        history,
        solution.converged,
    )


def offset_sigma(points: ScenePoints, floor_m: float) -> np.ndarray:
    """(P,) m: how far the plane at each point may be off, so that a plane's points together know what one does.

    The points of a plane share its error. Each has an offset of its own here, so each gets the variance times the
    number of points on the plane: then their sum carries the information of one measurement of the plane.
    """
    _, plane, count = np.unique(points.plane, return_inverse=True, return_counts=True)
    return np.asarray(np.maximum(points.sigma_plane, floor_m) * np.sqrt(count[plane]))


@dataclass(frozen=True)
class _State:
    photometric: PhotometricState
    mount: Mount

    @property
    def visual(self) -> VisualState:
        return VisualState(self.photometric.cameras, self.mount)


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

    def retract(self, state: _State, step: np.ndarray) -> _State:
        moved = photometric.retract(self._problem, state.photometric, self.at(state), step[:-1])
        return _State(moved, priors.retract(state.mount, step[-1]))


def joint(equations: NormalEquations, prior: Prior | None, state: VisualState) -> NormalEquations:
    """Photometric equations plus the prior's, over I + 1 blocks of 7; the last is mount and time offset."""
    photo = equations.padded(len(state.cameras) + 1)
    return photo if prior is None else photo + priors.linearize(prior, state)


def components(pair_reference: np.ndarray, pair_target: np.ndarray, images: int) -> np.ndarray:
    """The connected component (I,) of the co-visibility graph each image belongs to."""
    graph = coo_matrix((np.ones(len(pair_reference)), (pair_reference, pair_target)), shape=(images, images))
    return connected_components(graph, directed=False)[1]


def _free(problem: Problem, with_prior: bool, solve_exposures: bool) -> np.ndarray:
    """(I + 1, 7) bool: what may move. One exposure per component is held: its scale is free (A2, one gauge each)."""
    images, pairs = len(problem.images), problem.pairs
    free = np.ones((images + 1, 7), bool)
    seen = np.zeros(images, bool)
    seen[pairs.reference] = seen[pairs.target] = True
    _, first = np.unique(components(pairs.reference, pairs.target, images), return_index=True)
    free[:images, 6] = seen & solve_exposures
    free[first, 6] = False
    free[images] = with_prior
    if not with_prior:
        free[:images, :6] &= seen[:, None]
    return free


def _reweighted(
    problem: Problem,
    shares: Shares,
    prior: Prior | None,
    at: _State,
    linearization: Linearization,
    free: np.ndarray,
) -> tuple[Problem, Prior | None]:
    """Inflation, plane offsets' sigma and the prior's sigmas estimated anew (variance components)."""
    if problem.offset_sigma is not None:
        scale = covariance.offset_scale(problem, at.photometric.offset, linearization.offset_hessian)
        problem = replace(problem, offset_sigma=problem.offset_sigma * scale)
    clusters = covariance.cluster_gradients(problem, linearization, shares)
    ratio = covariance.inflation(linearization.equations, clusters)
    inflation = max(problem.inflation * ratio, 1.0)
    if prior is not None:
        total = joint(linearization.equations, prior, at.visual)
        own, with_mount = linear_solver.covariance_blocks(total, free)
        undecided = tuple(_undecided(prior, source, at.visual, own, with_mount) for source in prior.sources)
        clusters = covariance.bias_reduced_gradients(problem, linearization, at.photometric, shares, total)
        counts = _mount_information(prior, at, clusters, own[-1], with_mount, problem.inflation / inflation)
        prior = trajectory_sigmas.reestimated(replace(prior, mount_information=counts), at.visual, undecided)
    return replace(problem, inflation=inflation), prior


def _mount_information(
    prior: Prior,
    at: _State,
    clusters: csr_matrix,
    covariance_mount: np.ndarray,
    covariance_with_mount: np.ndarray,
    deflated: float,
) -> np.ndarray:
    """(7, 7): what the calibrated mount shall count, from what the images tell of it and how far they contradict it.

    clusters: (clusters, 7 I) gradients per piece of wall; covariance_mount: (7, 7); covariance_with_mount: (I + 1, 7, 7)
    deflated: by what factor the information of the images is about to change
    """
    every = np.linalg.inv(covariance_mount)
    now, _, _ = priors.linearize_mount(prior, at.mount)
    gradients = clusters @ covariance_with_mount[:-1].reshape(-1, len(every)) @ every
    return extrinsic_prior.weighed(
        deflated * (every - now),
        deflated**2 * (gradients.T @ gradients),
        priors.claimed_information(prior.config),
    )


def _undecided(
    prior: Prior, source: Source, state: VisualState, own: np.ndarray, with_mount: np.ndarray
) -> np.ndarray:
    """(I, 6): posterior variance of each frame's deviation from a source of the prior."""
    by_camera, by_mount = priors.jacobians(prior, source, state)
    cross = by_camera @ with_mount[:-1, :6] @ np.swapaxes(by_mount, 1, 2)
    total = by_camera @ own[:-1, :6, :6] @ np.swapaxes(by_camera, 1, 2) + cross + np.swapaxes(cross, 1, 2)
    total += by_mount @ own[-1] @ np.swapaxes(by_mount, 1, 2)
    return np.asarray(np.diagonal(total, axis1=1, axis2=2))


def covariance_of(solution: LevelSolution) -> np.ndarray:
    """(I + 1, 7, 7) covariance blocks of the images' unknowns, then of mount and time offset."""
    total = joint(solution.linearization.equations, solution.prior, solution.state)
    held = None if solution.prior is None else priors.spread(solution.prior, solution.state)
    at = PhotometricState(solution.state.cameras, solution.offset)
    clusters = covariance.bias_reduced_gradients(
        solution.problem, solution.linearization, at, solution.shares, total
    )
    return covariance.camera_covariance(total, clusters, held, solution.free)
