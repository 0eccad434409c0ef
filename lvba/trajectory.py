"""Timed poses: looking them up between samples, interpolating corrections, aligning and comparing."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from lvba import geometry
from lvba.arrays import Pose, Poses, Times


@dataclass(frozen=True)
class Trajectory:
    """Poses of one sensor over time.

    times: (N,) float64, s, strictly ascending
    world_from_sensor: (N, 4, 4) float64
    """

    times: np.ndarray
    world_from_sensor: np.ndarray

    def __len__(self) -> int:
        return len(self.times)


def bracket(times: Times, queries: Times) -> tuple[np.ndarray, np.ndarray]:
    """For each query, the index (Q,) of the sample before it and its fraction (Q,) to the next; clamped at the ends."""
    if len(times) == 1:
        return np.zeros(len(queries), np.int64), np.zeros(len(queries))
    before = np.clip(np.searchsorted(times, queries, side="right") - 1, 0, len(times) - 2)
    fraction = (queries - times[before]) / (times[before + 1] - times[before])
    return before, np.clip(fraction, 0.0, 1.0)


def interpolate_corrections(rough: Trajectory, refined: Poses, times: Times) -> np.ndarray:
    """World corrections `refined @ rough^-1` at other times, (Q, 4, 4); constant beyond the ends.

    refined: (N, 4, 4), poses at rough.times. Source: Li et al., eq. (1), made continuous (the paper takes the
    closest frame, which jumps). Both trajectories are interpolated and then compared, so that a correction common to
    all frames comes back exactly, and the error of interpolating the motion cancels.
    """
    before, fraction = bracket(rough.times, times)
    after = np.minimum(before + 1, len(rough) - 1)
    rough_at = geometry.interpolate(rough.world_from_sensor[before], rough.world_from_sensor[after], fraction)
    refined_at = geometry.interpolate(refined[before], refined[after], fraction)
    return np.asarray(refined_at @ geometry.inverse(rough_at))


JUMP_M, JUMP_DEG = 0.25, 3.0
"""A rough motion from frame to frame that is wrong by more has jumped: what is between the two was before it or after."""


def motions_differ(one: Poses, other: Poses, meters: float, degrees: float) -> np.ndarray:
    """(N - 1,) bool: motions to the next frame in which poses (N, 4, 4) differ from others by more.

    meters: m; degrees: deg
    """
    return np.asarray((motion_differences(one, other) > [np.radians(degrees), meters]).any(axis=1))


_GAP = 3.0
"""Times the usual time between samples from which on what happened in between is known by itself alone."""


def gaps(times: Times) -> np.ndarray:
    """(N - 1,) bool: intervals between times (N,), s, ascending, that are much longer than usual (median)."""
    interval = np.diff(times)
    return np.asarray(interval > _GAP * np.median(interval)) if len(interval) else np.zeros(0, bool)


def motion_differences(one: Poses, other: Poses) -> np.ndarray:
    """(N - 1, 2) float64, rad and m: by how much motions to the next frame of poses (N, 4, 4) differ from others'."""
    steps = [geometry.steps(poses) for poses in (one, other)]
    off = geometry.log(geometry.inverse(steps[0]) @ steps[1])
    return np.asarray(np.linalg.norm(off.reshape(-1, 2, 3), axis=2))


def sample(trajectory: Trajectory, times: Times) -> np.ndarray:
    """Poses at other times, (Q, 4, 4): cubic spline in position, shortest arc in rotation; clamped at the ends."""
    before, fraction = bracket(trajectory.times, times)
    after = np.minimum(before + 1, len(trajectory) - 1)
    poses = geometry.interpolate(
        trajectory.world_from_sensor[before], trajectory.world_from_sensor[after], fraction
    )
    if len(trajectory) > 2:
        from scipy.interpolate import CubicSpline  # here: takes longer to import than all else of this module

        clamped = np.clip(times, trajectory.times[0], trajectory.times[-1])
        poses[..., :3, 3] = CubicSpline(trajectory.times, trajectory.world_from_sensor[:, :3, 3])(clamped)
    return poses


def align(estimate: Poses, reference: Poses, rounds: int = 5) -> np.ndarray:
    """`reference_from_estimate` (4, 4), the rigid motion that brings poses closest; no scale.

    estimate, reference: (N, 4, 4), same order. Positions and orientations both count, each by its own spread about the
    result. Positions alone (Umeyama) leave the roll of a straight path open: 1 mm of noise on a path 1 m wide
    turns all of it by 0.06 degrees.
    """
    p, q = estimate[:, :3, 3], reference[:, :3, 3]
    p_mean, q_mean = p.mean(0), q.mean(0)
    positions = (q - q_mean).T @ (p - p_mean)
    orientations = np.einsum("nij,nkj->ik", reference[:, :3, :3], estimate[:, :3, :3])
    lever = 1e-3 * max(float(np.sqrt(((p - p_mean) ** 2).sum(1).mean())), 1e-3)
    for _ in range(rounds):
        rotation = geometry.closest_rotation(positions + lever**2 * orientations)
        off = (q - q_mean) - (p - p_mean) @ rotation.T
        turned = np.einsum("nji,jk,nkl->nil", reference[:, :3, :3], rotation, estimate[:, :3, :3])
        angle = np.linalg.norm(Rotation.from_matrix(turned).as_rotvec(), axis=1)
        if (angle**2).mean() < _EXACT**2:
            break
        # |R_a - R_b|^2 is twice the squared angle: meters per radian at equal spread, over sqrt(2)
        lever = float(np.sqrt(max((off**2).sum(1).mean(), _EXACT**2) / (2 * (angle**2).mean())))
    return geometry.from_rotation_translation(rotation, q_mean - rotation @ p_mean)


@dataclass(frozen=True)
class Alignment:
    """The rigid motion (4, 4) that brings a trajectory closest to a reference, and what it was found from."""

    reference_from_estimate: np.ndarray
    by: Literal["positions", "positions and orientations"]


_LEVER_M = 1.0


def lever_for_errors(world_from_sensor: Poses) -> float:
    """m: errors are counted after the rigid motion that brings positions closest, and orientations, each angle by what it
    moves so far away; 0: positions alone.

    world_from_sensor: (N, 4, 4), of the path. Positions alone count, as is usual (Umeyama), where it extends by a meter
    (rms) across every axis: else they leave the roll of a straight path open, and all of the rotation of a sensor that
    turns on the spot.
    """
    place = world_from_sensor[:, :3, 3] - world_from_sensor[:, :3, 3].mean(axis=0)
    along = np.linalg.eigvalsh(place.T @ place / max(len(place), 1))
    return _LEVER_M if along[0] + along[1] < _LEVER_M**2 else 0.0


def align_for_errors(estimate: Poses, reference: Poses) -> Alignment:
    """The alignment that errors against a reference are counted after; no scale.

    estimate, reference: (N, 4, 4), same order. By positions alone, or orientations as well (`lever_for_errors`). Which of
    both does not depend on the estimate, so that all estimates are measured alike.
    """
    p, q = estimate[:, :3, 3], reference[:, :3, 3]
    p_mean, q_mean = p.mean(0), q.mean(0)
    cross = (q - q_mean).T @ (p - p_mean)
    by: Literal["positions", "positions and orientations"] = "positions"
    if lever := lever_for_errors(reference):
        by = "positions and orientations"
        # |R_a - R_b|^2 is twice the squared angle
        orientations = np.einsum("nij,nkj->ik", reference[:, :3, :3], estimate[:, :3, :3])
        cross = cross + lever**2 / 2 * orientations
    rotation = geometry.closest_rotation(cross)
    return Alignment(geometry.from_rotation_translation(rotation, q_mean - rotation @ p_mean), by)


_EXACT = 1e-12


@dataclass(frozen=True)
class PoseError:
    """How far an estimate is from a reference, after alignment unless said otherwise."""

    ate_m: float
    """Root mean square of the position error, m."""
    rotation_deg: float
    """Root mean square of the rotation error, degrees."""
    ate_median_m: float
    ate_p95_m: float
    """95 of 100 frames are off by less, m."""
    ate_max_m: float
    rotation_median_deg: float
    rotation_p95_deg: float
    rotation_max_deg: float
    rotation_alone_deg: float
    """Root mean square of the rotation error after the turn that brings orientations closest, whatever positions ask for.
    A satellite receiver that drifts by 20 cm along 90 m of street turned poses by 1.2 degrees that are .07 off."""
    rpe_m: float
    """Root mean square of the position error of the motion between neighbours, m."""
    rpe_deg: float
    frames: int


def pose_error(estimate: Poses, reference: Poses, *, aligned: Pose | None = None) -> PoseError:
    """Errors of (N, 4, 4) poses against (N, 4, 4) reference poses.

    aligned: the (4, 4) `reference_from_estimate` to use, for example that of the LiDAR map for cameras; None: found here.
    """
    reference_from_estimate = align(estimate, reference) if aligned is None else aligned
    error = geometry.inverse(reference) @ (reference_from_estimate @ estimate)
    position = np.linalg.norm((reference_from_estimate @ estimate)[:, :3, 3] - reference[:, :3, 3], axis=1)
    angle = geometry.rotation_angle_deg(error)
    turned = estimate[:, :3, :3] @ reference[:, :3, :3].transpose(0, 2, 1)
    alone = geometry.closest_rotation(turned.sum(axis=0)).T @ turned
    step = geometry.inverse(geometry.steps(reference)) @ geometry.steps(estimate)
    return PoseError(
        ate_m=_rms(position),
        rotation_deg=_rms(angle),
        ate_median_m=_quantile(position, 0.5),
        ate_p95_m=_quantile(position, 0.95),
        ate_max_m=float(position.max(initial=0)),
        rotation_median_deg=_quantile(angle, 0.5),
        rotation_p95_deg=_quantile(angle, 0.95),
        rotation_max_deg=float(angle.max(initial=0)),
        rotation_alone_deg=_rms(geometry.rotation_angle_deg(alone)),
        rpe_m=_rms(np.linalg.norm(step[:, :3, 3], axis=1)),
        rpe_deg=_rms(geometry.rotation_angle_deg(step)),
        frames=len(estimate),
    )


def nearest_in_time(times: Times, queries: Times) -> np.ndarray:
    """For each query the index (Q,) of the sample nearest in time, the earlier of two equally near. times: ascending."""
    after = np.clip(np.searchsorted(times, queries), 0, len(times) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(queries - times[before] <= times[after] - queries, before, after)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else 0.0


def _quantile(values: np.ndarray, part: float) -> float:
    return float(np.quantile(values, part)) if len(values) else 0.0
