"""Scans and cameras on one path of somebody who walks and looks around, for tests of what they take from each other."""

from dataclasses import replace

import numpy as np

from lvba import geometry
from lvba.lidar.covariance import Covariance
from lvba.steps import pose_fusion
from lvba.trajectory import Trajectory

MOUNT = geometry.exp(np.array([0.4, -1.2, 0.3, 0.05, -0.08, 0.12]))
OFFSET = 0.007
SCAN_TIMES = np.arange(60) * 0.1
IMAGE_TIMES = np.arange(58) * 0.1 + 0.13
TIGHT = np.repeat([2e-4, 5e-4], 3)
"""rad and m, of a scan that planes hold and of a camera."""


def path(times):
    """world_from_scan (N, 4, 4) of somebody who walks and looks around."""
    t = np.asarray(times)
    turn = np.stack([0.1 * np.sin(0.9 * t), 0.08 * np.cos(0.7 * t), 0.5 * t], axis=1)
    place = np.stack([1.2 * t, 0.4 * np.sin(0.8 * t), 0.05 * np.cos(1.1 * t)], axis=1)
    rotation = geometry.exp(np.concatenate([turn, np.zeros_like(turn)], axis=1))[:, :3, :3]
    return geometry.from_rotation_translation(rotation, place)


def blocks(sigmas):
    """(N, 6, 6) from sigmas (N, 6)."""
    return np.square(sigmas)[:, :, None] * np.eye(6)


def scans(rng, loose=(), along=5, off=0.03):
    """Refined scans, their covariance, and the truth; those in `loose` are off along one of their own axes."""
    truth = path(SCAN_TIMES)
    sigma = np.tile(TIGHT, (len(SCAN_TIMES), 1))
    error = rng.normal(size=sigma.shape) * sigma
    for index in loose:
        sigma[index, along] = off
        error[index, along] = off * np.sign(error[index, along])
    found = geometry.retract(truth, error)
    return Trajectory(SCAN_TIMES, found), Covariance(*[blocks(sigma)] * 3), truth


def cameras(rng, sigma=TIGHT, extrinsic_sigma=None):
    truth = path(IMAGE_TIMES + OFFSET) @ MOUNT
    spread = np.tile(sigma, (len(IMAGE_TIMES), 1))
    poses = geometry.retract(truth, rng.normal(size=spread.shape) * spread)
    extrinsic_sigma = np.zeros(7) if extrinsic_sigma is None else extrinsic_sigma
    return pose_fusion.scan_poses_from_cameras(
        poses, IMAGE_TIMES + OFFSET, blocks(spread), MOUNT, extrinsic_sigma
    )


def lifted(given, which, by):
    """Some of the cameras higher by so many metres."""
    poses = given.world_from_scan.world_from_sensor.copy()
    poses[which, 2, 3] += by
    return replace(given, world_from_scan=replace(given.world_from_scan, world_from_sensor=poses))


def errors(poses, truth):
    return np.linalg.norm(geometry.log(geometry.inverse(truth) @ poses)[:, 3:], axis=1)
