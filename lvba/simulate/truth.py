"""The rig, the true poses of a recording, and the rough ones beside them."""

from dataclasses import dataclass

import numpy as np

from lvba import geometry
from lvba.simulate import disturbed_times
from lvba.simulate import drift as drifts
from lvba.simulate.disturbances import NONE, Disturbances
from lvba.simulate.drift import Closing, Difficulty
from lvba.simulate.scenes import Scene
from lvba.trajectory import Trajectory

_START_S = 1_700_000_000
_MARGIN_S = 0.05
_EXTRINSIC_M_PER_DEG = 1 / 60
_AXES = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
"""Camera axes (x right, y down, z forward) of body axes (x forward, y left, z up)."""


@dataclass(frozen=True)
class Rig:
    """The extrinsics of the sensors: (4, 4) each."""

    body_from_lidar: np.ndarray
    camera_from_body: np.ndarray


@dataclass(frozen=True)
class Truth:
    """True and rough poses, world frame; times are stamps (s)."""

    scans: Trajectory
    images: Trajectory
    rough_scans: Trajectory
    rough_images: Trajectory
    rough_camera_from_body: np.ndarray
    """(4, 4), what the calibration says."""
    scene_from_body: np.ndarray
    """(S, 4, 4), true, of each scan."""
    scene_from_camera: np.ndarray
    """(I, 4, 4), true, of each image."""
    scan_moments: np.ndarray
    """(S,) s since the start of the motion."""
    image_moments: np.ndarray
    """(I,) s since the start of the motion."""
    time_offset: float
    """s: images were taken this much later than stamped."""


def random_rig(scene: str, rng: np.random.Generator) -> Rig:
    """The extrinsics: body and LiDAR frame are the same in rooms, as where the odometry calls the LiDAR its body."""
    lidar = np.concatenate([rng.normal(0, 0.03, 3), rng.uniform(-0.15, 0.15, 3)])
    turn = np.concatenate([rng.normal(0, 0.02, 3), np.zeros(3)])
    place = geometry.from_rotation_translation(_AXES, rng.uniform(-0.1, 0.1, 3))
    return Rig(np.eye(4) if scene == "rooms" else geometry.exp(lidar), place @ geometry.exp(turn))


def build(
    scene: Scene,
    rig: Rig,
    level: Difficulty,
    scan_count: int,
    image_count: int,
    rng: np.random.Generator,
    closing: Closing | None = None,
    disturb: Disturbances = NONE,
) -> Truth:
    """True poses at two clocks of their own, and rough ones as wrong as `level` says, in a world frame of their own.

    closing: drift that comes on top; disturb: of which clocks, gap and jumps count here
    """
    motion, duration = scene.motion, scene.motion.duration
    last = duration - _MARGIN_S
    scan_times = _clock(_MARGIN_S, last, scan_count, rng)
    if disturb.gap:
        scan_times = disturbed_times.with_gap(scan_times, min(disturb.gap, 0.5 * duration))
    inside = np.diff(scan_times).mean() * rng.uniform(0.2, 0.5, 2)
    image_times = _clock(_MARGIN_S + inside[0], last - inside[1], image_count, rng)
    time_offset = float(rng.choice([-1, 1]) * rng.uniform(0.6, 1.0)) * level.time_offset_s + 0.0
    world_from_scene = _random_world(rng)
    scene_from_body = motion.poses(scan_times)
    body_from_camera = geometry.inverse(rig.camera_from_body)
    scene_from_camera = motion.poses(image_times + time_offset) @ body_from_camera
    at_stamp = motion.poses(image_times) @ body_from_camera
    drift = drifts.Drift(duration, rng)
    true_scans = world_from_scene @ scene_from_body
    scan_level = drifts.drifting(level, disturb.rough_drift)
    rough_scans, scale = drifts.rough_scans(true_scans, scan_times, drift, scan_level, rng)
    error = drifts.camera_error(geometry.inverse(scene_from_camera) @ at_stamp, level, rng)
    carriers = world_from_scene @ motion.poses(image_times) @ geometry.exp(drift.at(image_times, scale))
    # draws of their own, so that what is not disturbed stays the same
    other, camera_rng = rng.spawn(2)
    rough_body_from_camera = body_from_camera @ geometry.exp(error.extrinsic) @ _turned(disturb, camera_rng)
    rough_images = carriers @ rough_body_from_camera @ geometry.exp(error.noise)
    time_offset += disturb.time_offset
    image_moments = image_times + time_offset - disturbed_times.stamp_errors(image_times, disturb, other)
    scene_from_camera = motion.poses(image_moments) @ body_from_camera
    if disturb.jumps:
        path = true_scans[:, :3, 3]
        scans_moved, images_moved = disturbed_times.jumps(scan_times, image_times, path, disturb, other)
        rough_scans, rough_images = scans_moved @ rough_scans, images_moved @ rough_images
    start = _START_S + float(rng.integers(0, 10_000_000))
    if closing is not None:
        missed, last = closing.motion(rng), true_scans[-1, :3, 3]
        rough_scans = drifts.leaving(missed, scan_times / scan_times[-1], last) @ rough_scans
        rough_images = drifts.leaving(missed, image_times / scan_times[-1], last) @ rough_images
    scan_stamps, image_stamps = np.round(start + scan_times, 6), np.round(start + image_times, 6)
    return Truth(
        scans=Trajectory(scan_stamps, true_scans),
        images=Trajectory(image_stamps, world_from_scene @ scene_from_camera),
        rough_scans=Trajectory(scan_stamps, rough_scans),
        rough_images=Trajectory(image_stamps, rough_images),
        rough_camera_from_body=geometry.inverse(rough_body_from_camera),
        scene_from_body=scene_from_body,
        scene_from_camera=scene_from_camera,
        scan_moments=scan_times,
        image_moments=image_moments,
        time_offset=time_offset,
    )


def _turned(disturb: Disturbances, rng: np.random.Generator) -> np.ndarray:
    """(4, 4): by which the extrinsic of the calibration is off beside what difficulty makes of it, in any direction."""
    turn, shift = (each / np.linalg.norm(each) for each in rng.normal(size=(2, 3)))
    tangent = np.concatenate(
        [np.radians(disturb.extrinsic) * turn, _EXTRINSIC_M_PER_DEG * disturb.extrinsic * shift]
    )
    return np.asarray(geometry.exp(tangent))


def _random_world(rng: np.random.Generator) -> np.ndarray:
    """world_from_scene, (4, 4): any heading, tens of meters away, z nearly up."""
    turn = np.array([*rng.normal(0, 0.015, 2), rng.uniform(-np.pi, np.pi), 0, 0, 0])
    return np.asarray(
        geometry.from_rotation_translation(np.eye(3), rng.uniform(-60, 60, 3)) @ geometry.exp(turn)
    )


def _clock(first: float, last: float, count: int, rng: np.random.Generator) -> np.ndarray:
    """(count,) s from first to last, evenly but for a small jitter, to the microsecond."""
    even = np.linspace(first, last, count)
    return np.round(even + rng.uniform(-0.02, 0.02, count) * (last - first) / count, 6)
