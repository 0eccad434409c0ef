"""How refined cameras and those carried along with the scans agree, and what that says of the latter."""

from dataclasses import dataclass

import numpy as np

from lvba import geometry
from lvba.arrays import PoseBlocks, Poses, Tangents
from lvba.steps.uncertainty import is_known, squared_distances


@dataclass(frozen=True)
class Apart:
    """How far refined cameras are from others, root mean squares over those whose covariance is known.

    sigmas: of the distances, by what refined ones are expected to be off, in standard deviations of one number
    """

    position_m: float
    rotation_deg: float
    sigmas: float


def apart(world_from_refined: Poses, covariance: PoseBlocks, world_from_camera: Poses) -> Apart | None:
    """How far refined cameras are from others; None: of none is known what it is off.

    world_from_refined, world_from_camera: (I, 4, 4) float64, m
    covariance: (I, 6, 6) float64, of the refined ones, local tangent `[rotation | translation]`, rad and m
    """
    known = is_known(covariance)
    if not known.any():
        return None
    off, spread = _differences(world_from_refined[known], covariance[known], world_from_camera[known])
    squares = squared_distances(off, spread)
    turn, shift = (np.sqrt(np.square(off[:, part]).sum(axis=1).mean()) for part in (slice(3), slice(3, 6)))
    return Apart(float(shift), float(np.degrees(turn)), float(np.sqrt(squares.mean())))


def expected_squares(
    world_from_refined: Poses, covariance: PoseBlocks, world_from_camera: Poses
) -> np.ndarray:
    """(I, 6, 6) float64: expected squares of the errors of cameras, as refined ones tell them, in the tangent of these.

    Errors of the refined ones, and what is between the two: E[(c - t) (c - t)^T] = P + (c - r) (c - r)^T for a camera c
    and a truth t about r with a covariance P. Arguments as of `apart`; NaN where nothing is known.
    """
    off, spread = _differences(world_from_refined, covariance, world_from_camera)
    return np.asarray(spread + off[:, :, None] * off[:, None, :])


def _differences(
    world_from_refined: Poses, covariance: PoseBlocks, world_from_camera: Poses
) -> tuple[Tangents, np.ndarray]:
    """Where refined cameras are, (n, 6), and their covariances, (n, 6, 6), both in the tangent of the others."""
    camera_from_refined = geometry.inverse(world_from_camera) @ world_from_refined
    carry = geometry.adjoint(camera_from_refined)
    return geometry.log(camera_from_refined), carry @ covariance @ np.swapaxes(carry, -1, -2)
