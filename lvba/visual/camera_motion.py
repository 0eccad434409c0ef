"""How each camera moves while its image is taken: by scans and cameras around it, and by its own rows.

Where scans are far apart, the spline through them does not know the motion at an image: in rooms with a scan every 0.8 s
it is up to 20 degrees/s off, and 2 degrees/s half of the time. With a rolling shutter, rows above and below the middle of
an image then lie up to some pixels off, and its pose follows them. But they also tell that motion: each image gets a
twist of its own beyond that of the trajectory, as free rows tell it with the poses free beside it (as in bundle
adjustment with a motion for each image: Hedborg, Forssen, Felsberg, Ringaby, CVPR 2012), with a prior by how well the
trajectory predicts its own samples.
"""

from dataclasses import replace

import numpy as np

from lvba import geometry
from lvba.arrays import Indices, Times
from lvba.camera import Camera
from lvba.kernels import photometric_shared as kernels
from lvba.kernels.photometric import XR, XX, XY, YR, YY
from lvba.optim import linear_solver, normal_equations
from lvba.optim.normal_equations import Border, NormalEquations
from lvba.trajectory import Trajectory
from lvba.visual import photometric, trajectory_prior, trajectory_rates
from lvba.visual.photometric import PhotometricState, Problem
from lvba.visual.states import Calibration, VisualState
from lvba.visual.trajectory_prior import Prior

_READOUT = Calibration.layout()["readout"].start
"""Its column among the numbers of the calibration."""
_OPEN_S = 0.25
"""Scans no further apart than this tell the motion of a hand or a vehicle between them."""
_AWAY = 0.1
"""Part of a gap between scans that a camera is away from them to tell of the motion there: nearer, errors of poses would
be taken for speed."""


def rates(prior: Prior, state: VisualState) -> tuple[np.ndarray, np.ndarray]:
    """Velocity in the world (I, 3), m/s, and angular rate about the LiDAR's axes (I, 3), rad/s, at each image, by scans
    and by cameras between scans that are too far apart to tell them.

    In rooms with a scan every 0.8 s, rates by scans alone are 6 degrees/s off, which a rolling shutter of 30 ms shows as
    a pixel, and as a readout that seems shorter.
    state: of the images
    """
    moving, moments = _moving(prior, state)
    if moving is None or moving is prior.scans:
        return prior.velocity_world, prior.rate_scan
    return trajectory_rates.rates_of(moving, moments)


def turns(prior: Prior, state: VisualState, keyframes: Indices, times: Times) -> np.ndarray | None:
    """(I, 3) float64, rad, about each camera's own axes: how far it turns from the first row of its image to the last;
    None: all rows are read at once.

    prior, state: of the keyframes (K,); times: (I,) s, of all images
    """
    calibration, readout = state.calibration, state.calibration.readout
    moving, _ = _moving(prior, state)
    if not readout or moving is None:
        return None
    rate = trajectory_rates.rates_of(moving, calibration.moments(times, prior.epoch))[1]
    turn = readout * rate @ calibration.scan_from_camera[:3, :3]
    turn[keyframes] += readout * _motion(state)[:, :3]
    return np.asarray(turn)


def rate_sigmas(prior: Prior, state: VisualState) -> np.ndarray | None:
    """(I, 6): how far `rates` may be off in each component, rad/s and m/s; None: nothing tells."""
    moving, moments = _moving(prior, state)
    return None if moving is None else trajectory_rates.rate_sigmas_of(moving, moments)


def by_rows(
    problem: Problem, at: PhotometricState, sums: np.ndarray, prior: Prior, state: VisualState
) -> VisualState:
    """The state with `motion` and readout as the rows of all images tell them, poses as they are.

    One Gauss-Newton step with poses and all of the calibration free beside them: a readout that is held where half of the
    rates are wrong comes out too short, and rates too large, and either alone moves by a tenth of what is left in a step;
    and what rows of a camera that goes ahead shift looks much like another principal point. Unknown is by how much
    each camera moves on during its readout beyond the trajectory, so that the readout is told by how far rows shift where
    the trajectory says so. Rates beyond it would be smaller, and likelier, the longer the readout is taken to be: 36 ms
    instead of 30 where scans are half a second apart, and cameras 3 mm off.
    problem: with its shifts about this state; sums: (O, SUMS) float64, of `photometric.sums` there
    """
    sigma = rate_sigmas(prior, state)
    if sigma is None or problem.shifts is None or not state.calibration.readout:
        return replace(state, motion=None)
    before, motion = state.calibration.readout, _motion(state)
    step = linear_solver.solve_step(_all_terms(problem, at, sums, prior, state, sigma), 0.0)
    if step is None:
        return state
    readout = before + float(step.shared[_READOUT])
    if not readout * before > 0:
        return state
    motion = (before * motion + step.blocks[:, 6:]) / readout
    return replace(state, motion=motion, calibration=replace(state.calibration, readout=readout))


def readout_variance(
    problem: Problem, at: PhotometricState, sums: np.ndarray, prior: Prior, state: VisualState
) -> float:
    """s^2: how well the readout is known beside the motion of each image; 0 where that is not free.

    sums: (O, SUMS) float64, of `photometric.sums` at the state
    """
    sigma = rate_sigmas(prior, state)
    if sigma is None or problem.shifts is None or state.motion is None:
        return 0.0
    covariance = linear_solver.shared_covariance(_all_terms(problem, at, sums, prior, state, sigma))
    return float(covariance[_READOUT, _READOUT])


def _motion(state: VisualState) -> np.ndarray:
    """(I, 6), rad/s and m/s."""
    return np.zeros((len(state.cameras), 6)) if state.motion is None else state.motion


def _all_terms(
    problem: Problem,
    at: PhotometricState,
    sums: np.ndarray,
    prior: Prior,
    state: VisualState,
    sigma: np.ndarray,
) -> NormalEquations:
    """What rows, trajectory and calibration tell of poses, motions and calibration, as `equations` have them."""
    readout, motion = state.calibration.readout, _motion(state)
    return equations(problem, at, sums, motion) + _known(prior, state, readout * motion, readout * sigma)


def _known(prior: Prior, state: VisualState, now: np.ndarray, sigma: np.ndarray) -> NormalEquations:
    """What is known of poses, of what each camera moves on (I, 6), with these sigma, and of the readout beforehand, as
    `equations` have them."""
    held = trajectory_prior.linearize(prior, state)
    assert held.border is not None
    blocks = np.zeros((len(now), 12, 12))
    blocks[:, :6, :6] = held.diagonal_blocks()[:, :6, :6]
    blocks[:, np.arange(6, 12), np.arange(6, 12)] = 1 / sigma**2
    gradient = np.concatenate([held.gradient[:, :6], now / sigma**2], axis=1)
    coupling = np.zeros((len(now), 12, len(held.border.gradient)))
    coupling[:, :6] = held.border.coupling[:, :6]
    border = replace(held.border, coupling=coupling)
    index = np.arange(len(now))
    return normal_equations.from_blocks(index, index, blocks, gradient, 0.0, border)


def change_px(camera: Camera, before: VisualState, after: VisualState) -> float:
    """How far turns during the readout move the first and last rows otherwise after than before, px, root mean square
    over the images. camera: of the undistorted images"""
    turns = [state.calibration.readout * _motion(state)[:, :3] for state in (before, after)]
    return float(0.5 * camera.fx * np.sqrt(np.square(turns[1] - turns[0]).sum(axis=1).mean()))


def equations(
    problem: Problem, at: PhotometricState, sums: np.ndarray, motion: np.ndarray
) -> NormalEquations:
    """The photometric cost by the pose of each image and by what it moves on during the readout beyond the trajectory,
    12 unknowns, rad and m, bordered by the calibration, planes fixed.

    sums: (O, SUMS) float64, of `photometric.sums` at this state; motion: (I, 6) float64, of this state, rad/s and m/s
    """
    pairs = problem.pairs
    jacobian, shifts = _jacobian(problem, at, motion), problem.shifts
    assert shifts is not None
    count = jacobian.shape[2]
    weight, pull = (
        problem.information[:, None, None] * sums[:, each]
        for each in (np.array([[XX, XY], [XY, YY]]), np.array([[XR], [YR]]))
    )
    blocks, gradient = np.zeros((len(pairs.reference), count, count)), np.zeros((len(at.cameras), 12))
    coupling, shared = np.zeros((len(at.cameras), 12, count - 24)), np.zeros(count - 24)
    for pair, images in enumerate(zip(pairs.reference, pairs.target, strict=True)):
        mine = pairs.order[pairs.starts[pair] : pairs.starts[pair + 1]]
        # not by BLAS, which sums over observations in an order that depends on its threads
        weighted = np.einsum("oab,obj->oaj", weight[mine], jacobian[mine])
        blocks[pair] = np.einsum("oai,oaj->ij", jacobian[mine], weighted)
        pulled = np.einsum("oai,oa->i", jacobian[mine], pull[mine, :, 0])
        for image, part in zip(images, (slice(12), slice(12, 24)), strict=True):
            gradient[image] += pulled[part]
            coupling[image] += blocks[pair, part, 24:]
        shared += pulled[24:]
    rows = np.concatenate([pairs.reference, pairs.target, pairs.reference])
    columns = np.concatenate([pairs.reference, pairs.target, pairs.target])
    parts = np.concatenate([blocks[:, :12, :12], blocks[:, 12:24, 12:24], blocks[:, :12, 12:24]])
    border = shifts.spread_border(Border(coupling, blocks[:, 24:, 24:].sum(axis=0), shared))
    return normal_equations.from_blocks(rows, columns, parts, gradient, 0.0, border)


def _jacobian(problem: Problem, at: PhotometricState, motion: np.ndarray) -> np.ndarray:
    """(O, 2, 24 + m): target pixel of each patch by the 12 unknowns of its reference and of its target, and by the m
    parameters of the calibration that shift patches."""
    observations, shifts = problem.observations, problem.shifts
    assert shifts is not None
    patches = photometric.patches_at(problem, at)._replace(pixel=problem.points.pixel.astype(float))
    poses = np.ascontiguousarray(at.cameras.world_from_camera)
    by_poses = kernels.centers(observations.point, observations.target, poses, problem.intrinsics, patches)[2]
    by_ends = by_poses.reshape(len(observations), 2, 2, 6)
    by_motion = by_ends * shifts.rows[:, None, :, None]
    by_both = np.concatenate([by_ends, by_motion], axis=3).reshape(len(observations), 2, 24)
    ends = np.stack([problem.points.reference[observations.point], observations.target], axis=1)
    by_shared = shifts.by.copy()
    beyond = np.einsum("oaej,oej->oa", by_motion, motion[ends])
    by_shared[:, :, shifts.columns == _READOUT] -= beyond[:, :, None]
    return np.concatenate([by_both, by_shared], axis=2)


def _moving(prior: Prior, state: VisualState) -> tuple[Trajectory | None, np.ndarray]:
    """What tells how the LiDAR moves, scans and the cameras between them that help, and the images' moments (I,), s."""
    if prior.scans is None or prior.times is None:
        return None, np.zeros(len(prior))
    moments = state.calibration.moments(prior.times, prior.epoch)
    used = _between(prior.scans.times, moments)
    if not used.any():
        return prior.scans, moments
    carried = state.cameras.world_from_camera[used] @ geometry.inverse(state.calibration.scan_from_camera)
    every = np.concatenate([prior.scans.times, moments[used]])
    order = np.argsort(every, kind="stable")
    poses = np.concatenate([prior.scans.world_from_sensor, carried])[order]
    return Trajectory(every[order], poses), moments


def _between(samples: Times, moments: Times) -> np.ndarray:
    """(I,) bool: which of some moments (I,) lie in gaps of samples (S,) that leave the motion open, away from others."""
    used = np.zeros(len(moments), bool)
    taken = np.asarray(samples, float)
    for number in np.argsort(moments, kind="stable"):
        after = int(np.searchsorted(samples, moments[number]))
        if not 0 < after < len(samples):
            continue
        gap = float(samples[after] - samples[after - 1])
        if gap > _OPEN_S and np.abs(taken - moments[number]).min() >= _AWAY * gap:
            used[number], taken = True, np.append(taken, moments[number])
    return used
