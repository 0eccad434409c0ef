"""How the calibration of a state moves patches in their target images: those that are solved with, and any others."""

import functools
from collections.abc import Callable

import numpy as np

from lvba.camera import Camera
from lvba.visual import camera_motion, self_calibration
from lvba.visual.fixed_calibration import CORRECTIONS
from lvba.visual.patch_shifts import Shifts
from lvba.visual.scene_points import Observations, ScenePoints
from lvba.visual.states import VisualState
from lvba.visual.trajectory_prior import Prior
from lvba.visual.visibility import PairShifts


def of_pairs(
    camera: Camera | None,
    pinhole: Camera,
    prior: Prior | None,
    state: VisualState,
    asked: bool,
) -> PairShifts | None:
    """How the calibration of a state moves any pairs of points and targets; None: not at all. Pairs that are far outside
    of their targets stay there: nothing is known of a lens so far off its axis. Arguments as of `of_observations`."""
    if camera is None or prior is None or not asked:
        return None
    reference = prior.calibration.reference
    if all(np.array_equal(getattr(state.calibration, n), getattr(reference, n)) for n in CORRECTIONS):
        return None

    def shifts(points: ScenePoints, point: np.ndarray, target: np.ndarray) -> np.ndarray:
        pairs = Observations(point, target, np.zeros(len(point), bool))
        near = self_calibration.near_target(points, pairs, pinhole, state.cameras.world_from_camera)
        pairs = Observations(point[near], target[near], pairs.is_global[near])
        at = np.zeros((len(point), 2))
        at[near] = _shifts(camera, pinhole, points, pairs, prior, state).at
        return at

    return shifts


def of_observations(
    camera: Camera | None,
    pinhole: Camera,
    points: ScenePoints,
    observations: Observations,
    prior: Prior | None,
    asked: bool,
) -> Callable[[VisualState], Shifts] | None:
    """How the calibration moves the patches of the finest level, about a state; None: it is not refined.

    camera: of the raw images, None: they have none; pinhole: of the undistorted ones; prior: of these images
    """
    if camera is None or prior is None or not asked:
        return None
    return functools.partial(_shifts, camera, pinhole, points, observations, prior)


def _shifts(
    camera: Camera,
    pinhole: Camera,
    points: ScenePoints,
    observations: Observations,
    prior: Prior,
    state: VisualState,
) -> Shifts:
    velocity_world, rate_scan = camera_motion.rates(prior, state)
    velocity = self_calibration.velocities(
        rate_scan,
        velocity_world,
        prior.sources[0].world_from_scan,
        state.calibration.scan_from_camera,
    )
    if state.motion is not None:
        velocity = velocity + state.motion
    poses = state.cameras.world_from_camera
    return self_calibration.shifts(camera, pinhole, points, observations, poses, velocity, state.calibration)
