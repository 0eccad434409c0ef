"""What each disturbance does to a simulated recording, where it is more than a number of a sensor."""

from dataclasses import dataclass, replace

import numpy as np

from lvba import geometry
from lvba.arrays import Poses, Times
from lvba.camera import Camera
from lvba.simulate import camera as cameras
from lvba.simulate import people
from lvba.simulate.disturbances import Disturbances
from lvba.simulate.lidar import Surroundings
from lvba.simulate.scenes import Scene
from lvba.simulate.trajectories import Motion
from lvba.simulate.view import Shine, View
from lvba.simulate.world import RayCaster

_RNG = 3
_SHINY, _LEAFY = 1 / 3, 1 / 2
_LIGHT = np.array([0.35, 0.2, 0.915])
_LOOK_EVERY = 16
"""An automatic exposure looks at one pixel in so many along each axis."""


@dataclass(frozen=True)
class Things:
    """What is in the scene beside its textured rectangles."""

    around: Surroundings
    shine: Shine | None


def things(scene: Scene, caster: RayCaster, disturb: Disturbances, seed: int) -> Things:
    """Of a scene, by the disturbances."""
    world, count = scene.world, len(scene.world)
    walking = None
    if disturb.people:
        walking = people.beside(scene.motion, caster, round(disturb.people), _rng(seed, 0))
    mirror = _rng(seed, 1).random(count) < disturb.mirrors if disturb.mirrors else None
    leafy = _rng(seed, 2).random(count) < _LEAFY if disturb.foliage else None
    shine = None
    if disturb.highlights:
        shiny = _rng(seed, 3).random(count) < _SHINY
        shine = Shine(disturb.highlights * shiny, world.normal, _LIGHT / np.linalg.norm(_LIGHT))
    return Things(Surroundings(world, caster, walking, mirror, leafy), shine)


def calibration(camera: Camera, disturb: Disturbances, seed: int) -> Camera:
    """What the recording says of a camera."""
    toward = _rng(seed, 4).uniform(0, 2 * np.pi)
    return replace(
        camera,
        fx=camera.fx * (1 + disturb.focal),
        fy=camera.fy * (1 + disturb.focal),
        cx=camera.cx + disturb.principal_point * float(np.cos(toward)),
        cy=camera.cy + disturb.principal_point * float(np.sin(toward)),
        distortion=(camera.distortion[0] + disturb.k1, *camera.distortion[1:]),
    )


def white_balances(count: int, disturb: Disturbances, seed: int) -> np.ndarray | None:
    """(count, 3) gains of the colors, or None: all the same."""
    if not disturb.white_balance:
        return None
    return cameras.white_balances(count, disturb.white_balance, _rng(seed, 5))


def exposures_of(view: View, scene_from_camera: Poses, disturb: Disturbances) -> np.ndarray:
    """(I,) exposures relative to the first, by what the camera sees at its poses (I, 4, 4)."""
    seen = np.array([view.brightness(pose, _LOOK_EVERY) for pose in scene_from_camera])
    return cameras.automatic_exposures(seen, disturb.auto_exposure)


def row_times(height: int, readout: float) -> np.ndarray:
    """(height,) s at which rows are seen in a `readout` (s), relative to the middle of the image."""
    return (np.arange(height) / height - 0.5) * readout


def deskewed(motion: Motion, stamp: float, times: Times, left: float) -> np.ndarray:
    """(N, 4, 4), body at the stamp from body: where deskewing puts points at (N,) s relative to the stamp.

    stamp: s since the start of the motion; left: part of the motion that deskewing does not know of
    """
    at_stamp = motion.poses(np.array([stamp]))
    return np.asarray(geometry.inverse(at_stamp) @ motion.poses(stamp + (1 - left) * times))


def _rng(seed: int, number: int) -> np.random.Generator:
    return np.random.default_rng([seed, _RNG, number])
