"""The visual stage: from rough camera poses and refined scans to refined cameras, coarse to fine over the pyramid."""

import logging
from dataclasses import dataclass, replace

import numpy as np

from lvba.errors import DegenerateProblemError
from lvba.progress import Progress, silent
from lvba.trajectory import Trajectory
from lvba.visual import (
    bundle_adjustment,
    calibration_prior,
    calibration_shifts,
    camera_motion,
    covariance,
    degeneracy,
    exposure,
    image_groups,
    radiometry,
    relocalization,
    scene_points,
    trajectory_prior,
    visibility,
    white_balance,
)
from lvba.visual import result as results
from lvba.visual.bundle_adjustment import ROUNDS, SOLVER, LevelConfig, LevelSolution
from lvba.visual.config import DEFAULTS, VisualConfig
from lvba.visual.degeneracy import DegenerateDirections
from lvba.visual.image import LevelImages
from lvba.visual.radiometry import Radiometry
from lvba.visual.result import LevelReport, VisualResult
from lvba.visual.scene import Inputs, Scene, scene_of
from lvba.visual.scene_points import PatchRules, ScenePoints
from lvba.visual.states import Calibration, CameraStates, VisualState
from lvba.visual.trajectory_prior import Prior
from lvba.visual.variant import PRODUCT, Variant
from lvba.visual.visibility import DepthBuffers

__all__ = [
    "Coarser",
    "Inputs",
    "LevelReport",
    "Scene",
    "VisualConfig",
    "VisualResult",
    "finest",
    "refine",
    "refine_finest",
    "refine_level",
    "scene_of",
]

logger = logging.getLogger(__name__)

_FIRST_VARIANCE_FACTOR = 10.0
_COARSE_DAMPING = 1e-4
"""First damping of a coarse level, which begins further off."""
_COARSE_ROUNDS = 2
"""Solves of a coarse level."""
_MOST_SOLVES = 3
"""At most so many more, at the finest level, with points found anew."""
_FAR_PX = 1.0
"""What cameras begin with in common is far off where it moves half of the scene points by more, at their level."""
_MOST_RESTARTS = 2
"""At most so many, at each coarse level."""
_BEYOND_CLAIM = 4.0
"""Variance of the extrinsic, as images see it, over that which its calibration claims, from which all levels are solved
anew: it was held at half of what it is off, or less."""
_ROWS_STAY_PX = 0.05
"""Change of the first and last rows, root mean square over the images, below which motions during images stand still."""
_COARSEST_EXPOSED = 5
"""Coarsest pyramid level that exposures are compared at."""


@dataclass(frozen=True)
class Coarser:
    """What the levels done so far leave to the next finer one.

    prior: with its sigmas as estimated last; variance_factor: actual over modeled variance of the pixels
    reports: from coarse to fine; levels: how many are done, those at which no point was seen twice among them
    """

    state: VisualState
    prior: Prior | None
    variance_factor: float
    reports: tuple[LevelReport, ...]
    levels: int = 0


def refine(
    given: Inputs,
    config: VisualConfig = DEFAULTS,
    progress: Progress = silent,
    variant: Variant = PRODUCT,
) -> VisualResult:
    """Refined poses and exposures of all images.

    Raises DegenerateProblemError where no scene point is seen twice.
    """
    coarser: Coarser | None = None
    for _ in range(len(given.pyramid) - 1):
        coarser = refine_level(given, coarser, config, progress, variant)
    return refine_finest(given, coarser, config, progress, variant)


def refine_level(
    given: Inputs,
    coarser: Coarser | None,
    config: VisualConfig = DEFAULTS,
    progress: Progress = silent,
    variant: Variant = PRODUCT,
) -> Coarser:
    """One level more than `coarser`; None: none yet. One at which no point is seen twice leaves all as it was."""
    scene = scene_of(given, config, variant)
    return _coarser(scene, coarser or _none_yet(scene), config, progress)


def _coarser(scene: Scene, coarser: Coarser, config: VisualConfig, progress: Progress) -> Coarser:
    """What the next level leaves; all as it was where no point is seen twice at it."""
    try:
        return _solved(scene, coarser, config, progress)[0]
    except DegenerateProblemError as error:
        logger.info("%s", error)
        return replace(coarser, levels=coarser.levels + 1)


def refine_finest(
    given: Inputs,
    coarser: Coarser | None,
    config: VisualConfig = DEFAULTS,
    progress: Progress = silent,
    variant: Variant = PRODUCT,
) -> VisualResult:
    """The result, from the finest level. Raises DegenerateProblemError as `refine` does."""
    return finest(given, coarser, config, progress, variant)[0]


def finest(
    given: Inputs,
    coarser: Coarser | None,
    config: VisualConfig = DEFAULTS,
    progress: Progress = silent,
    variant: Variant = PRODUCT,
) -> tuple[VisualResult, LevelSolution]:
    """The result, and the solution of the finest level by the images as they are. Raises DegenerateProblemError as
    `refine` does.

    Where the white balance changes, the result is by images without that: patches of several colors differ else.
    """
    scene = scene_of(given, config, variant)
    coarser = coarser or _none_yet(scene)
    solution, last, directions = _solved(scene, coarser, config, progress)
    known = last.prior
    if known is not None and calibration_prior.variance_over_claim(known.calibration) > _BEYOND_CLAIM:
        coarser = _coarse_anew(
            scene, known.calibration.good_for, solution.state.calibration, config, progress
        )
        solution, last, directions = _solved(scene, coarser, config, progress)
    state, sigma, plain = solution.state, np.zeros(len(scene.image_times)), last
    light, balance = radiometry.NONE, None
    if variant.exposures == "means":
        # exposures, and those by color, are solved at the same poses
        where = scene.pyramid, scene.cameras(state.cameras.world_from_camera), scene.surfaces
        depth, points = exposure.depth_of(*where), exposure.placed(*where)
        exposed = _exposed(scene, 0, state, depth, points)
        state, sigma, light = exposed.state, exposed.sigma, exposed.radiometry
        if variant.white_balance and given.colors is not None:
            seen = (scene.pyramid.camera, *where[1:], scene.seen, light, scene.camera, depth, points)
            balance = white_balance.solve(given.colors, *seen, given.smaller_colors)
    if balance is not None and given.colors is not None:
        pyramid = white_balance.taken_out_of(scene.pyramid, given.colors, balance, light.response)
        again = _from_there(coarser, last, state)
        solution, last, directions = _solved(replace(scene, pyramid=pyramid), again, config, progress)
        state = solution.state
    start, keyframes, times = scene.start.cameras.world_from_camera, given.keyframes, given.images.times
    result = results.collect(
        solution.reports, last, state, directions, sigma, start, scene.prior, keyframes, times
    )
    if balance is not None:
        result = results.with_white_balance(result, balance, times)
    spread = result.covariance + _of_map(given, result.world_from_camera)
    return replace(result, covariance=spread, radiometry=light), plain


def _coarse_anew(
    scene: Scene, good: np.ndarray, solved: Calibration, config: VisualConfig, progress: Progress
) -> Coarser:
    """What all levels but the finest leave with a calibration that counts for what it is `good` for (k, k).

    Cameras that see little were held where it has them, and contradicted the others at all levels. They begin where the
    extrinsic and the clock that were solved put them.
    """
    logger.info("the calibration of the extrinsic claims too much: all levels anew")
    prior = trajectory_prior.granting(scene.prior, good)
    calibration = Calibration(scan_from_camera=solved.scan_from_camera, time_offset=solved.time_offset)
    poses = trajectory_prior.predict(prior, prior.sources[0], calibration)[scene.keyframes]
    cameras = replace(scene.start.cameras, world_from_camera=poses)
    coarser = _none_yet(replace(scene, prior=prior, start=VisualState(cameras, calibration)))
    for _ in range(len(scene.pyramid) - 1):
        coarser = _coarser(scene, coarser, config, progress)
    return coarser


def _of_map(given: Inputs, world_from_camera: np.ndarray) -> np.ndarray:
    """(I, 6, 6): what the errors of the map about each camera add to its covariance."""
    if given.scan_covariance is None:
        return np.zeros((len(world_from_camera), 6, 6))
    scans = Trajectory(given.scans.times, given.refined_scans)
    known = given.scan_covariance.shared_factor * given.scan_covariance.marginal
    return covariance.of_map(world_from_camera, given.images.times, scans, known)


def _solved(
    scene: Scene, coarser: Coarser, config: VisualConfig, progress: Progress
) -> tuple[Coarser, LevelSolution, DegenerateDirections]:
    """The next level: what it leaves, its solution, and the directions that no image holds."""
    level = len(scene.pyramid) - 1 - coarser.levels
    solution = _solve_level(scene, level, coarser, config, progress)
    state, directions = _returned(scene, solution)
    if level == 1:
        joined = image_groups.rejoined(solution.problem, scene.pyramid, state)
        if joined is not state:
            # features put them to centimeters: once more, with pairs of the one group with the other
            solution = _solve_level(scene, level, _from_there(coarser, solution, joined), config, progress)
            state, directions = _returned(scene, solution)
        state = relocalization.relocalized(solution.problem, scene.pyramid, state)
    report = results.level_report(level, solution)
    logger.info("%s", report)
    reports = (*coarser.reports, report)
    left = Coarser(state, solution.prior, solution.problem.variance_factor, reports, coarser.levels + 1)
    return left, solution, directions


def _returned(scene: Scene, solution: LevelSolution) -> tuple[VisualState, DegenerateDirections]:
    """The solution's state with what no image holds as its prior has it, and these directions."""
    directions = degeneracy.find(solution.problem, solution.linearization, scene.surfaces.planes)
    if solution.prior is None:
        return solution.state, directions
    return degeneracy.return_to_prior(solution.state, solution.prior, directions), directions


def _none_yet(scene: Scene) -> Coarser:
    """What the coarsest level begins with."""
    held = trajectory_prior.take(scene.prior, scene.keyframes) if scene.variant.prior else None
    return Coarser(scene.start, held, _FIRST_VARIANCE_FACTOR, ())


@dataclass(frozen=True)
class _Exposed:
    """A state with exposures solved anew, their standard deviations (K,), and the radiometry that they suppose."""

    state: VisualState
    sigma: np.ndarray
    radiometry: Radiometry = radiometry.NONE


def _exposed(
    scene: Scene, level: int, state: VisualState, depth: DepthBuffers, points: ScenePoints | None = None
) -> _Exposed:
    """The state with exposures solved anew, at a level and its depth buffers, by patches placed at refined ones; None: by
    few, placed anew."""
    poses = state.cameras.world_from_camera
    if scene.variant.exposures == "none":
        return _Exposed(state, np.zeros(len(poses)))
    # coarse where the poses are still rough
    compared = max(min(level, _COARSEST_EXPOSED), exposure.LEVEL)
    raw = scene.camera if scene.vignetting and scene.variant.exposures == "means" else None
    where = scene.pyramid, scene.cameras(poses), scene.surfaces, scene.seen
    refined = points is not None
    solved = exposure.solve(*where, compared, depth, raw, points, exposure.FEW_CELLS, refined)
    state = replace(state, cameras=CameraStates(poses, solved.log_exposure))
    return _Exposed(state, solved.sigma, solved.radiometry)


def _solve_level(
    scene: Scene, level: int, coarser: Coarser, config: VisualConfig, progress: Progress
) -> LevelSolution:
    """One level's solution, once more with points found anew: at a coarse one if extrinsic or clock were far off, at the
    finest if that corrected camera or clock.

    With a camera that is pixels off in the corners, patches there match nothing: what is left are those that tell least.
    The same holds for rows that the camera moved otherwise at than was known, as often as that still changes.
    """
    solution = _solved_once(scene, level, coarser, config, progress)
    if level > 0:
        return _restarted(scene, level, coarser, solution, config, progress)
    if scene.variant.reference_pixels != "fixed" or not solution.corrected:
        return solution
    for _ in range(_MOST_SOLVES):
        again = _from_there(coarser, solution, solution.state)
        once_more = _solved_once(scene, level, again, config, progress)
        shown = camera_motion.change_px(scene.pyramid.camera, solution.state, once_more.state)
        solution = replace(once_more, history=solution.history + once_more.history)
        if shown < _ROWS_STAY_PX:
            break
    return solution


def _from_there(coarser: Coarser, solution: LevelSolution, state: VisualState) -> Coarser:
    """What a level begins with to be solved once more, from a state, with the sigmas that its solution has."""
    factor = solution.problem.variance_factor
    return replace(coarser, state=state, prior=solution.prior, variance_factor=factor)


def _restarted(
    scene: Scene,
    level: int,
    coarser: Coarser,
    solution: LevelSolution,
    config: VisualConfig,
    progress: Progress,
) -> LevelSolution:
    """A coarse level's solution; where extrinsic or clock were far off, that from where these put the cameras.

    All cameras begin with what is wrong of these, and most find the way by themselves. One that sees little does not: it
    holds on to what looks alike where it is, and what is common to all then draws on it in vain. From where the common
    part puts it, it sees what its neighbors see. Kept where more pairs of images look alike.
    """
    begun = coarser.state.calibration
    for _ in range(_MOST_RESTARTS):
        prior = solution.prior
        if prior is None or _common_shift_px(scene, level, solution, begun) < _FAR_PX:
            break
        begun = solution.state.calibration
        poses = trajectory_prior.predict(prior, prior.sources[0], begun)
        cameras = replace(solution.state.cameras, world_from_camera=poses)
        again = _from_there(coarser, solution, replace(solution.state, cameras=cameras))
        once_more = _solved_once(scene, level, again, config, progress)
        pairs = len(solution.problem.observations), len(once_more.problem.observations)
        logger.info("cameras begin anew from the calibration found: %d -> %d pairs look alike", *pairs)
        if pairs[1] <= pairs[0]:
            break
        solution = replace(once_more, history=solution.history + once_more.history)
    return solution


def _common_shift_px(scene: Scene, level: int, solution: LevelSolution, begun: Calibration) -> float:
    """How far the change of extrinsic and clock since the level was `begun` moves scene points in images: half of them
    by more, px of the level."""
    prior, points = solution.prior, solution.problem.points
    assert prior is not None
    pixels = []
    for calibration in (begun, solution.state.calibration):
        poses = trajectory_prior.predict(prior, prior.sources[0], calibration)[points.reference]
        ray = np.einsum("nji,nj->ni", poses[:, :3, :3], points.position_world - poses[:, :3, 3])
        pixels.append(ray[:, :2] / np.maximum(ray[:, 2:], 1e-6))
    focal = scene.pyramid.camera.at_level(level).fx
    return float(focal * np.median(np.linalg.norm(pixels[1] - pixels[0], axis=1)))


def _solved_once(
    scene: Scene, level: int, coarser: Coarser, config: VisualConfig, progress: Progress
) -> LevelSolution:
    """Scene points, visibility and exposures anew at the present poses and calibration, then the solve."""
    images, camera = scene.pyramid.levels[level], scene.pyramid.camera.at_level(level)
    noise = float(scene.pyramid.noise[level])
    poses = coarser.state.cameras.world_from_camera
    progress("exposures", 0, 3)
    depth = scene.depth_buffers(camera, poses, scene.points.time_window_s)
    exposed = _exposed(scene, level, coarser.state, depth)
    state, images = exposed.state, exposed.radiometry.taken_out_of(images, scene.camera, camera)
    moved = None
    if level == 0 and scene.variant.reference_pixels == "fixed":
        moved = calibration_shifts.of_pairs(scene.camera, camera, coarser.prior, state, config.calibrate)
    progress("scene points", 1, 3)
    shown, rules = LevelImages(images, camera, noise), PatchRules(size=config.patch)
    points = scene_points.select(shown, scene.cameras(poses), scene.surfaces, scene.points, rules)
    points, observations = visibility.find(
        shown, poses, points, scene.seen, config.visibility, depth,
        patch=config.patch, score=scene.variant.score, shifts=moved,
    )  # fmt: skip
    if level == 0:
        points, observations = relocalization.without_chance(points, observations, len(poses))
    if len(observations) == 0:
        size = "full size" if level == 0 else f"1/{2**level} of their size"
        raise DegenerateProblemError(
            f"no scene point looks alike in two images (compared at {size}): they overlap too little, are too plain, "
            "show too little of what the scans measured, or camera poses, extrinsic or stamps are far off"
        )
    progress("camera poses", 2, 3)
    shifts = None
    if level == 0 and scene.variant.reference_pixels == "fixed":
        shifts = calibration_shifts.of_observations(
            scene.camera, camera, points, observations, coarser.prior, config.calibrate
        )
    solver = SOLVER
    if level > 0:
        solver = replace(SOLVER, initial_damping=_COARSE_DAMPING)
    how = LevelConfig(
        patch=config.patch,
        rounds=ROUNDS if level == 0 else _COARSE_ROUNDS,
        solver=replace(solver, max_iterations=config.iterations),
        variance_factor=coarser.variance_factor,
        finest=level == 0,
    )
    solution = bundle_adjustment.solve(
        images, camera, points, observations, state, coarser.prior, how, variant=scene.variant, shifts=shifts
    )
    progress("camera poses", 3, 3)
    return solution
