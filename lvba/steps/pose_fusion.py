"""Scan poses that both sensors agree on: the LiDAR's planes and the refined cameras.

A narrow LiDAR before one wall leaves its scan half open: planes may hold it to centimetres only, while images hold the
cameras just before and after it to millimetres. So each scan becomes the mean of its own pose and of where a spline
through the refined cameras has it, through the extrinsic and the time offset found, each weighed by what is known of it.
What is common to all cameras (extrinsic, time offset) is found with the errors of the scans, and moves none of them.
Source: Barfoot and Furgale 2014, for fusing poses in the tangent space; Li et al. leave the scans as they are.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lvba import geometry, spline, trajectory
from lvba.arrays import Pose, PoseBlocks, Poses, StepSigmas, Times
from lvba.lidar.covariance import LEAST, Covariance, local_covariance, positive
from lvba.lidar.degeneracy import DegenerateDirection
from lvba.optim import linear_solver, normal_equations
from lvba.optim.normal_equations import Border
from lvba.settings import setting
from lvba.trajectory import Trajectory

_MEDIAN = 5.348 / 6
"""Median of a chi-square of six degrees of freedom, over six."""
_MEDIAN_OF_ONE = 0.4549
"""Median of a chi-square of one degree of freedom."""
_LEAST_BETWEEN = 0.1
"""Of smooth motion, a cubic spline misses 0.08 of what leaving a sample out changes: less is chance."""
_FLOOR = np.repeat([np.radians(1e-3), 1e-4], 3)
"""rad and m: nothing is interpolated better than this."""
_RATE_STEP_S = 0.02

CONTRADICTION = 5.0
"""A scan and the cameras about it that are further apart than this many standard deviations contradict each other, and
the scan stays."""


@dataclass(frozen=True)
class FusionConfig:
    """How scan poses learn from the refined cameras."""

    enabled: bool = setting(
        True,
        meaning="Scan poses learn from the refined cameras. false: scans stay where the LiDAR bundle "
        "adjustment left them.",
        change_when="Only the LiDAR is to decide where scans are.",
    )


@dataclass(frozen=True)
class Cameras:
    """Refined cameras as they tell where the LiDAR is.

    world_from_scan: of the LiDAR at the moments of the images, on its clock
    covariance: (K, 6, 6), of these relative to the map around them, local tangent [rotation | translation], rad and m
    extrinsic_covariance: (6, 6), what all of them are off together because the extrinsic is, in the LiDAR's tangent
    offset_sigma: s, how far the clocks may be apart beyond the offset found
    """

    world_from_scan: Trajectory
    covariance: np.ndarray
    extrinsic_covariance: np.ndarray
    offset_sigma: float


@dataclass(frozen=True)
class Fused:
    """Scans where both sensors have them.

    world_from_scan: (S, 4, 4) float64; covariance: (S, 6, 6), as `lidar.covariance.Covariance.marginal`
    moved_m: (S,) from where the LiDAR had them
    interpolation_error_scale: error of the spline between cameras over the leave-one-out error of the cameras, as
        the distances of the scans from the spline explain it; the median of the six axes
    variance_factor: how many times scans and cameras are further apart (squared) than both promise, at least 1
    contradicted: scans that stayed because the cameras contradict them
    """

    world_from_scan: np.ndarray
    covariance: np.ndarray
    moved_m: np.ndarray
    interpolation_error_scale: float
    variance_factor: float
    contradicted: int


def scan_poses_from_cameras(
    world_from_camera: Poses,
    moments: Times,
    covariance: PoseBlocks,
    scan_from_camera: Pose,
    extrinsic_sigma: np.ndarray,
) -> Cameras:
    """Where cameras (K, 4, 4) have the LiDAR; those without a covariance are left out.

    moments: (K,) s, ascending, on the LiDAR's clock; covariance: (K, 6, 6), relative to the map, in the camera's tangent
    extrinsic_sigma: (7,) float64, as in `VisualResult`
    """
    known = np.isfinite(covariance).all((1, 2)) & (np.trace(covariance, axis1=1, axis2=2) > 0)
    carry = geometry.adjoint(scan_from_camera)
    return Cameras(
        Trajectory(moments[known], world_from_camera[known] @ geometry.inverse(scan_from_camera)),
        carry @ covariance[known] @ carry.T,
        carry @ np.diag(np.square(extrinsic_sigma[:6])) @ carry.T,
        float(extrinsic_sigma[6]),
    )


def fuse(
    scans: Trajectory,
    covariance: Covariance,
    cameras: Cameras,
    common: Sequence[DegenerateDirection] = (),
    prior_sigmas: StepSigmas | None = None,
) -> Fused | None:
    """The scans refined with the cameras; None: too few cameras to tell.

    common: motions of all scans together that the planes leave open, with the (6,) sigmas (rad, m) that they are scaled
        by: there scans and cameras both are where the odometry has them, and no mean of the two is any better
    """
    path = cameras.world_from_scan
    if len(path) < spline.FEWEST_SAMPLES:
        return None
    inside = ~spline.outside(path, scans.times)
    leave_one_out_error = spline.leave_one_out_error_by_axis(path, scans.times)
    differences = geometry.log(geometry.inverse(scans.world_from_sensor) @ spline.through(path, scans.times))
    differences = _without_common(differences, scans.world_from_sensor, common, prior_sigmas)
    shared = _shared(cameras, scans.times)
    alone = _of_neighbors(cameras, scans.times)
    known = alone + shared @ np.swapaxes(shared, -1, -2)
    known += _interpolated(leave_one_out_error, spline.boundary_error(path, scans.times)[:, None])
    own = local_covariance(covariance, scans.world_from_sensor)
    interpolation_error_scale = _interpolation_error_scale(
        differences[inside], (own + known)[inside], leave_one_out_error[inside]
    )
    interpolated = _interpolated(leave_one_out_error, interpolation_error_scale)
    of_cameras = known + interpolated
    distance = _distance(differences, own + of_cameras)
    variance_factor = max(1.0, float(np.median(distance[inside])) / _MEDIAN) if inside.any() else 1.0
    contradicted = inside & (distance > CONTRADICTION**2 * variance_factor)
    used = inside & ~contradicted
    camera_information = np.linalg.inv(of_cameras) * used[:, None, None]
    step = _chained(
        # where motions are known, a group of scans may be off as far as it is uncertain within the trajectory: cameras
        # far apart in time see it beside others
        covariance.in_map + LEAST * np.eye(6) if len(covariance.step) else own,
        covariance.step,
        scans.world_from_sensor,
        # what both do not promise is the cameras': the scans' own share in it is in what groups are off
        np.linalg.inv(variance_factor * alone + interpolated) * used[:, None, None],
        differences,
        shared,
    )
    # promised is only what each scan gains against the map around it: cameras that see no more than a group of scans does
    # are off with it, and that they agree with it is no proof
    conditional = covariance.conditional + LEAST * np.eye(6)
    posterior = np.linalg.inv(np.linalg.inv(conditional) + camera_information)
    posterior = np.where(used[:, None, None], posterior * variance_factor, posterior)
    moved = geometry.retract(scans.world_from_sensor, step)
    still = np.all(step == 0.0, axis=1)
    return Fused(
        world_from_scan=np.where(still[:, None, None], scans.world_from_sensor, moved),
        covariance=posterior + positive(covariance.marginal - covariance.conditional),
        moved_m=np.linalg.norm(step[:, 3:], axis=1),
        interpolation_error_scale=float(np.median(interpolation_error_scale)),
        variance_factor=variance_factor,
        contradicted=int(np.count_nonzero(contradicted)),
    )


def _chained(
    own: np.ndarray,
    step: np.ndarray,
    world_from_scan: np.ndarray,
    camera_information: np.ndarray,
    differences: np.ndarray,
    shared: np.ndarray,
) -> np.ndarray:
    """The most likely errors (S, 6) of the scans.

    own: (S, 6, 6), of the errors, none on average; step: (S - 1, 6, 6), of the motion from each to the next, empty:
        errors are independent; camera_information: (S, 6, 6), 0: none; differences: (S, 6), what they say
    shared: (S, 6, 7), what one standard deviation of each number that all cameras share does to the differences
    Errors of neighbors go together as far as the motion between them is more certain than they are: a group of scans
    moves as one. Beyond neighbors only through them: a Markov chain, whose information is block-tridiagonal.
    """
    if len(step):
        diagonal, upper = _chain(own, step, world_from_scan)
    else:
        diagonal, upper = np.linalg.inv(own), np.zeros((max(len(own) - 1, 0), 6, 6))
    weighed = camera_information @ shared
    border = Border(
        coupling=weighed,
        hessian=np.eye(shared.shape[-1]) + np.einsum("sia,sib->ab", shared, weighed),
        gradient=-np.einsum("sia,si->a", weighed, differences),
    )
    right = np.einsum("sij,sj->si", camera_information, differences)
    return _solve_chain(diagonal + camera_information, upper, right, border)


_MOST_COMMON = 0.999
"""Of the error of a scan, the part that it can have in common with the next one."""


def _chain(own: np.ndarray, step: np.ndarray, world_from_scan: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The information of the chain of errors: blocks on the diagonal (S, 6, 6) and (S - 1, 6, 6) beside it."""
    carry = geometry.adjoint(geometry.inverse(world_from_scan[1:]) @ world_from_scan[:-1])
    before = carry @ own[:-1] @ np.swapaxes(carry, -1, -2)
    common = 0.5 * (before + own[1:] - step)
    left, right = np.linalg.cholesky(before), np.linalg.cholesky(own[1:])
    correlation = np.linalg.solve(
        left, np.swapaxes(np.linalg.solve(right, np.swapaxes(common, -1, -2)), -1, -2)
    )
    values, axes = np.linalg.eigh(0.5 * (correlation + np.swapaxes(correlation, -1, -2)))
    values = np.clip(values, 0.0, _MOST_COMMON)
    # of unit covariance each, the later error is `correlation` (C) times the one before and noise of covariance 1 - C^2
    back = np.swapaxes(axes, -1, -2)
    next_, last = back @ np.linalg.inv(right), back @ np.linalg.solve(left, carry)
    noise = 1.0 / (1.0 - values**2)
    diagonal = np.zeros_like(own)
    diagonal[0] = np.linalg.inv(own[0])
    diagonal[1:] = np.swapaxes(next_, -1, -2) @ (noise[:, :, None] * next_)
    diagonal[:-1] += np.swapaxes(last, -1, -2) @ ((noise * values**2)[:, :, None] * last)
    return diagonal, -np.swapaxes(last, -1, -2) @ ((noise * values)[:, :, None] * next_)


def _solve_chain(
    diagonal: np.ndarray, upper: np.ndarray, right: np.ndarray, border: Border | None = None
) -> np.ndarray:
    """The solution (S, 6) of block-tridiagonal equations with positive blocks (S, 6, 6) and (S - 1, 6, 6).

    border: of numbers that all share, found beside
    """
    here = np.arange(len(diagonal))
    rows, columns = np.concatenate([here, here[:-1]]), np.concatenate([here, here[1:]])
    blocks = np.concatenate([diagonal, upper])
    equations = normal_equations.from_blocks(rows, columns, blocks, -right, 0.0, border)
    solution = linear_solver.solve_step(equations, 0.0)
    return np.zeros_like(right) if solution is None else solution.blocks


def _of_neighbors(cameras: Cameras, times: np.ndarray) -> np.ndarray:
    """(S, 6, 6): the covariance of the less certain of the cameras about each time."""
    before, _ = trajectory.bracket(cameras.world_from_scan.times, times)
    after = np.minimum(before + 1, len(cameras.covariance) - 1)
    size = np.linalg.eigvalsh(cameras.covariance[:, 3:, 3:])[:, -1]
    return np.asarray(cameras.covariance[np.where(size[before] > size[after], before, after)])


def _shared(cameras: Cameras, times: np.ndarray) -> np.ndarray:
    """(S, 6, 7): what one standard deviation of extrinsic and time offset, of all cameras alike, does at each time."""
    path = cameras.world_from_scan
    middle = np.clip(times, path.times[0] + _RATE_STEP_S, path.times[-1] - _RATE_STEP_S)
    ends = [trajectory.sample(path, middle + step) for step in (-_RATE_STEP_S, _RATE_STEP_S)]
    rate = geometry.log(geometry.inverse(ends[0]) @ ends[1]) / (2 * _RATE_STEP_S) * cameras.offset_sigma
    values, vectors = np.linalg.eigh(cameras.extrinsic_covariance)
    of_extrinsic = np.broadcast_to(vectors * np.sqrt(np.maximum(values, 0.0)), (len(times), 6, 6))
    return np.concatenate([of_extrinsic, rate[:, :, None]], axis=2)


def _interpolated(leave_one_out_error: np.ndarray, part: np.ndarray) -> np.ndarray:
    """(S, 6, 6): what a spline adds that is off by a part of what is missed of a sample that is left out, (S, 6); part:
    (6,) or (S, 1)"""
    variance = np.square(part * leave_one_out_error) + np.square(_FLOOR)
    return np.asarray(variance[:, :, None] * np.eye(6))


def _interpolation_error_scale(
    differences: np.ndarray, known: np.ndarray, leave_one_out_error: np.ndarray
) -> np.ndarray:
    """(6,): for each axis, the part of what is missed that makes half of the scans closer to the spline than promised."""
    low, high = np.full(6, np.log(_LEAST_BETWEEN)), np.zeros(6)
    if not len(differences):
        return np.exp(high)
    variance = np.diagonal(known, axis1=1, axis2=2)
    for _ in range(12):
        middle = 0.5 * (low + high)
        total = variance + np.square(np.exp(middle) * leave_one_out_error)
        short = np.median(np.square(differences) / total, axis=0) > _MEDIAN_OF_ONE
        low, high = np.where(short, middle, low), np.where(short, high, middle)
    return np.exp(high)


def _distance(differences: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(S,): squared Mahalanobis distances over their degrees of freedom."""
    return np.asarray(
        np.einsum("si,si->s", differences, np.linalg.solve(covariance, differences[..., None])[..., 0]) / 6
    )


def _without_common(
    differences: np.ndarray,
    world_from_scan: np.ndarray,
    common: Sequence[DegenerateDirection],
    prior_sigmas: np.ndarray | None,
) -> np.ndarray:
    """Differences (S, 6) without their part along degenerate directions of all scans together."""
    if not common or prior_sigmas is None:
        return differences
    turn = world_from_scan[:, :3, :3]
    scaled = np.einsum("sij,skj->ski", turn, differences.reshape(-1, 2, 3)).reshape(-1, 6) / prior_sigmas
    basis = np.linalg.qr(np.stack([each.direction for each in common], axis=1))[0]
    scaled = (scaled - scaled @ basis @ basis.T) * prior_sigmas
    return np.asarray(np.einsum("sji,skj->ski", turn, scaled.reshape(-1, 2, 3)).reshape(-1, 6))
