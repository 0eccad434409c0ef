"""A block of one large visual bundle adjustment: the scene points of some images, and all images that see them.

The photometric cost is a sum over scene points, and a scene point belongs to its reference image: the normal equations of
all blocks add up to those of the whole recording.
"""

from dataclasses import dataclass, replace

import numpy as np

from lvba.camera import Camera
from lvba.optim.normal_equations import NormalEquations, Step
from lvba.visual import (
    bundle_adjustment,
    calibration_shifts,
    exposure,
    photometric,
    relocalization,
    scene_points,
    visibility,
)
from lvba.visual import noise as noise_models
from lvba.visual.config import VisualConfig
from lvba.visual.exposure_graph import Edges
from lvba.visual.image import LevelImages
from lvba.visual.photometric import PhotometricState, Problem
from lvba.visual.radiometry import Radiometry
from lvba.visual.scene import Inputs, scene_of
from lvba.visual.scene_points import Observations, PatchRules, ScenePoints
from lvba.visual.states import VisualState
from lvba.visual.trajectory_prior import Prior
from lvba.visual.tuning import Tuning


@dataclass(frozen=True)
class CameraPoints:
    """The scene points of one block, fixed for all rounds.

    images: (n,) int64, keyframes of the whole; points and observations number their images as in `images`
    sigma: (O,) standard deviation of the residuals of each observation, of 255
    offset_sigma: (P,) m, how far the plane at each point may be off; None: planes are exact
    edges: brightness of pairs of images, numbered as in the whole; None where not asked for
    """

    images: np.ndarray
    points: ScenePoints
    observations: Observations
    sigma: np.ndarray
    offset_sigma: np.ndarray | None
    edges: Edges | None


@dataclass(frozen=True)
class CameraBlock:
    """What one block says about its images.

    images: (n,) int64, keyframes of the whole; equations: over these, 7 unknowns each
    points, observations: how many
    """

    images: np.ndarray
    equations: NormalEquations
    points: int
    observations: int


def select_scene_points(
    given: Inputs,
    state: VisualState,
    images: np.ndarray,
    core: np.ndarray,
    known: Tuning,
    prior: Prior | None,
    light: Radiometry,
    config: VisualConfig,
) -> CameraPoints:
    """The scene points whose reference is in the core, who sees them, and how bright they are, at the finest level.

    state, prior: of the keyframes of `given`; images: (k,) int64, their numbers in the whole; core: (k,) bool
    light: the radiometry of all parts
    """
    scene = scene_of(given, config)
    camera = scene.pyramid.camera
    full = light.taken_out_of(scene.pyramid.levels[0], given.camera, camera)
    level, poses = LevelImages(full, camera, float(scene.pyramid.noise[0])), state.cameras.world_from_camera
    cameras, rules = scene.cameras(poses), PatchRules(size=config.patch)
    points = scene_points.select(level, cameras, scene.surfaces, scene.points, rules)
    depth = scene.depth_buffers(camera, poses, scene.points.time_window_s)
    points, observations = visibility.find(
        level, poses, points, scene.seen, config.visibility, depth, patch=config.patch,
        shifts=calibration_shifts.of_pairs(given.camera, camera, prior, state, config.calibrate),
    )  # fmt: skip
    points, observations = relocalization.without_chance(points, observations, len(poses))
    mine = core[points.reference]
    off = bundle_adjustment.offset_sigma(points, bundle_adjustment.PLANE_FLOOR_M, known.offset_scale)[mine]
    points, observations = scene_points.take_observed(points, observations, mine)
    problem = photometric.prepare(full, camera, points, observations, config.patch)
    problem = _with_shifts(problem, given.camera, state, prior, config)
    sums = photometric.sums(problem, PhotometricState(state.cameras, np.zeros(len(points))))
    sigma = known.noise.sigma(noise_models.gradients(sums))
    raw = given.camera if config.vignetting else None
    ratios = exposure.ratios_at(
        scene.pyramid, cameras, scene.surfaces, scene.seen, depth=depth, raw=raw, curve=light.response
    )
    edges = exposure.edges_of(ratios.of_images(core), len(images))
    edges = replace(edges, first=images[edges.first], second=images[edges.second])
    return CameraPoints(
        images=images, points=points, observations=observations, sigma=sigma, offset_sigma=off, edges=edges
    )


def linearize(
    images: np.ndarray,
    camera: Camera,
    selected: CameraPoints,
    state: VisualState,
    known: Tuning,
    prior: Prior | None,
    raw: Camera,
    light: Radiometry,
    config: VisualConfig,
) -> CameraBlock:
    """The photometric normal equations of the selected points.

    images: (n, H, W, C) uint8, the block's keyframes at full size; camera: theirs; state, prior: of these keyframes
    raw: the camera of the images before they were undistorted; light: their radiometry
    """
    problem = photometric.prepare(
        light.taken_out_of(images, raw, camera), camera, selected.points, selected.observations, config.patch,
        offset_sigma=selected.offset_sigma, sigma=selected.sigma, variance_factor=known.variance_factor,
    )  # fmt: skip
    problem = _with_shifts(problem, raw, state, prior, config)
    at = PhotometricState(state.cameras, np.zeros(len(selected.points)))
    linearization = photometric.linearize(problem, at)
    if selected.offset_sigma is not None:
        # the planes' offsets at these poses first: the equations hold about them
        at = photometric.retract(problem, at, linearization, Step(np.zeros((len(images), 7)), np.zeros(0)))
        linearization = photometric.linearize(problem, at)
    return CameraBlock(
        selected.images, linearization.equations, len(selected.points), len(selected.observations)
    )


def _with_shifts(
    problem: Problem, camera: Camera | None, state: VisualState, prior: Prior | None, config: VisualConfig
) -> Problem:
    """The problem with the patches moved as the calibration has it. camera: of the raw images"""
    shifts = calibration_shifts.of_observations(
        camera, problem.camera, problem.points, problem.observations, prior, config.calibrate
    )
    return problem if shifts is None else replace(problem, shifts=shifts(state))
