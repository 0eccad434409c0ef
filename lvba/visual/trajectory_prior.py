"""The prior that holds cameras where images do not: the LiDAR trajectory through one extrinsic and one time offset.

p enters the homography (Li et al., eq. 7) only through n^T p, so cameras can slide along directions in which no plane
faces them: three over one bare plane, one in a corridor. The paper has no term against that; without this prior
(`Variant.prior = False`) its form comes back.
"""

from collections.abc import Collection
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from lvba import geometry, spline, trajectory
from lvba.arrays import Indices, Pose, PoseBlocks, Poses, Times
from lvba.carried import carry
from lvba.optim import normal_equations
from lvba.optim.normal_equations import Border, NormalEquations
from lvba.optim.shared_parameters import SharedPrior
from lvba.trajectory import Trajectory
from lvba.visual import calibration_prior, fixed_calibration, trajectory_rates
from lvba.visual.calibration_prior import Evidence
from lvba.visual.prior_config import FLOOR_POSITION_M, FLOOR_ROTATION_DEG, PriorConfig
from lvba.visual.states import Calibration, VisualState

_DEFAULTS = PriorConfig()
_FRAME_HUBER = 2.5
_NOTHING = 1e3
"""A standard deviation that is so much larger makes an expectation count for nothing."""


SIGMA_POSITION_M, SIGMA_ROTATION_DEG = 0.02, 0.3
"""First guess of how far eq. (1) is off in a frame, m and degrees; estimated from the data afterwards."""
BETWEEN_SCANS = 0.3
"""First guess of the spline's error between scans, as a part of what leaving a scan out changes."""
OF_WRONG = 0.3
"""Error in each axis of eq. (1) between scans, as a part of how wrong the rough motion from one to the next is: that of
the middle of a random walk whose ends are known."""
AT_ENDS = 1.5
"""Error of the spline near its ends, as a part of the least it can be there: what three simulated walks show."""
CEILING_POSITION_M, CEILING_ROTATION_DEG = 0.02, 0.3
"""No estimate of a frame's own error rises above this. Images alone drift; a prior that followed would allow it."""


@dataclass(frozen=True)
class Source:
    """One way to tell from the LiDAR trajectory where each camera is.

    world_from_scan: (I, 4, 4) float64, the LiDAR at the images' stamps
    sigma_rotation, sigma_position: (I, 3) of what a frame deviates by itself, along the LiDAR's axes, rad and m
    scan_rotation, scan_position: (I, 3) of what does not depend on the frames' deviations, the error of the scans' poses,
        along the LiDAR's axes, rad and m
    correlation_inflation: by what the variances of the latter (rotation, position) grow as neighboring frames share them
    late: (I, 6) of how the sensor moved while the clocks were apart, `[rotation | position]`, rad and m; None: taken for
        known
    silent: (I, 2) bool, tells nothing of the image's rotation, position: standard deviations are huge, and stay so; None:
        of no image
    """

    world_from_scan: np.ndarray
    sigma_rotation: np.ndarray
    sigma_position: np.ndarray
    scan_rotation: np.ndarray
    scan_position: np.ndarray
    correlation_inflation: tuple[float, float] = (1.0, 1.0)
    late: np.ndarray | None = None
    silent: np.ndarray | None = None

    @property
    def spoken(self) -> np.ndarray:
        """(I, 2) bool: tells something of the image's rotation, position."""
        return np.ones((len(self.sigma_position), 2), bool) if self.silent is None else ~self.silent

    def and_late(self, sigma: np.ndarray) -> np.ndarray:
        """(I, 6): these standard deviations, and what is not known of the motion while the clocks were apart.

        sigma: (I, 6) float64, rad and m
        """
        return sigma if self.late is None else np.hypot(sigma, self.late)


@dataclass(frozen=True)
class Prior:
    """Where the LiDAR trajectory expects each camera.

    sources: each an expectation of its own, all through the same calibration
    velocity_world: (I, 3) float64, m/s; rate_scan: (I, 3) float64, rad/s, about the LiDAR's axes
    calibration: what is known of the calibration itself; it counts beside the images as `calibration_prior.weighed` has
        it; evidence: of the images, by which it was weighed last, None: it was not
    scans: as refined; times: (I,) s, of the images; None: not known
    epoch: s, the stamp that the rate of the camera's clock counts from; drifting: whether that rate is solved for
    planes_off: (6, 6) float64, second moments of how far planes are off the sensor, all together, by errors of ranges, in
        steps of the extrinsic
    """

    sources: tuple[Source, ...]
    velocity_world: np.ndarray
    rate_scan: np.ndarray
    calibration: SharedPrior[Calibration]
    evidence: Evidence | None = None
    scans: Trajectory | None = None
    times: np.ndarray | None = None
    epoch: float = 0.0
    drifting: bool = False
    planes_off: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))

    def __len__(self) -> int:
        return len(self.velocity_world)


def build(
    scans: Trajectory,
    refined: Poses,
    images: Trajectory,
    camera_from_scan: Pose,
    config: PriorConfig = _DEFAULTS,
    scan_covariance: PoseBlocks | None = None,
    planes_off: np.ndarray | None = None,
) -> Prior:
    """The prior of I images from the rough trajectories and the (S, 4, 4) refined scan poses.

    scan_covariance: (S, 6, 6), how far each refined pose may be off the map around it, tangent `[rotation |
        translation]`, rad and m; None: as far as a frame may be at most
    planes_off: (6, 6) float64, rad and m, as `RangeErrors.planes_off`; None: zero

    Two sources. The rough camera carried by the interpolated LiDAR correction (Li et al., eq. 1) follows every motion,
    but has the odometry's noise of each frame. A spline through the refined scans has none, but does not know what
    happened between them; how much that can be is read, scan by scan, off the error of predicting it from its
    neighbors. Which of the two is better depends on the motion, so both count, each by its own sigma.
    """
    scan_from_camera = geometry.inverse(camera_from_scan)
    carried = carry(scans, refined, images, scan_from_camera)
    usual = np.array([np.radians(SIGMA_ROTATION_DEG), SIGMA_POSITION_M])
    # what rough motions do not tell counts for nothing
    own = np.hypot(usual, OF_WRONG * carried.wrong) * np.where(carried.by_rough, 1.0, _NOTHING)
    scan_rotation, scan_position = _scan_sigmas(scans.times, scan_covariance, images.times)
    # not scaled by what frames deviate: these are nearly all between scans that are near
    drift_rotation, drift_position = carried.drift[:, :1], carried.drift[:, 1:]
    by_eq1 = Source(
        world_from_scan=carried.world_from_sensor @ camera_from_scan,
        sigma_rotation=np.repeat(own[:, :1], 3, axis=1),
        sigma_position=np.repeat(own[:, 1:], 3, axis=1),
        scan_rotation=np.hypot(scan_rotation, drift_rotation),
        scan_position=np.hypot(scan_position, drift_position),
        silent=~carried.by_rough,
    )
    moving = Trajectory(scans.times, refined)
    sources: tuple[Source, ...] = (by_eq1,)
    if len(scans) >= spline.FEWEST_SAMPLES:
        within, at_ends = _spline_sigmas(moving, images.times)
        by_spline = replace(
            by_eq1,
            world_from_scan=spline.through(moving, images.times),
            sigma_rotation=within[:, :3],
            sigma_position=within[:, 3:],
            scan_rotation=np.hypot(scan_rotation, at_ends[:, :3]),
            scan_position=np.hypot(scan_position, at_ends[:, 3:]),
            silent=np.repeat(spline.unknown(moving, images.times)[:, None], 2, axis=1),
        )
        sources = (by_eq1, by_spline)
    known = calibration_prior.build(Calibration(scan_from_camera), config.sigma)
    velocity_world, rate_scan = trajectory_rates.rates_of(moving, images.times)
    return Prior(
        sources=sources,
        velocity_world=velocity_world,
        rate_scan=rate_scan,
        calibration=known,
        scans=moving,
        times=images.times,
        epoch=float(images.times[0] + images.times[-1]) / 2,
        planes_off=calibration_prior.along_camera(
            np.zeros((6, 6)) if planes_off is None else planes_off, camera_from_scan
        ),
    )


def take(prior: Prior, index: np.ndarray) -> Prior:
    """The prior of some of the images.

    index: (N,) integers, or (I,) bool
    """
    sources = tuple(
        replace(
            s,
            world_from_scan=s.world_from_scan[index],
            sigma_rotation=s.sigma_rotation[index],
            sigma_position=s.sigma_position[index],
            scan_rotation=s.scan_rotation[index],
            scan_position=s.scan_position[index],
            late=None if s.late is None else s.late[index],
            silent=None if s.silent is None else s.silent[index],
        )
        for s in prior.sources
    )
    return replace(
        prior,
        sources=sources,
        velocity_world=prior.velocity_world[index],
        rate_scan=prior.rate_scan[index],
        times=None if prior.times is None else prior.times[index],
    )


def weighed(prior: Prior, said: Evidence, keep: bool = True) -> Prior:
    """The prior with a calibration that counts as it shall beside what images say of it.

    keep: as of `calibration_prior.weighed`; else what the calibration is good for stays as it was, too
    """
    spread, known = said.spread + said.by_range_errors(prior.planes_off), prior.calibration
    good = calibration_prior.granted(said, spread, known.claimed) if keep else known.good_for
    counted = calibration_prior.weighed(said.information, spread, good, keep)
    return replace(prior, calibration=replace(known, counted=counted, granted=good), evidence=said)


def granting(prior: Prior, good: np.ndarray) -> Prior:
    """The prior with a calibration that counts for what it is good for. good: (k, k) float64, information"""
    return replace(prior, calibration=replace(prior.calibration, counted=good, granted=good))


def with_fixed(prior: Prior, names: Collection[str]) -> Prior:
    """The prior with these parameters of the calibration fixed at their calibrated values."""
    if not names:
        return prior
    return replace(prior, calibration=fixed_calibration.with_fixed(prior.calibration, names))


def fill(
    prior: Prior, solved: Prior, state: VisualState, keyframes: Indices, times: Times
) -> tuple[np.ndarray, np.ndarray]:
    """Poses (I, 4, 4) of all images from those of the keyframes, and the covariance (I, 6, 6) that this adds.

    Between keyframes an image is where the best source puts it, moved by the deviations of the keyframes about it. Where
    the best tells nothing, another does.
    prior: of all I images; solved: of the K keyframes, with the sigmas found; times: (I,) s
    """
    poses, spread = _expected(prior, solved, state.calibration, keyframes)
    deviation = geometry.log(geometry.inverse(poses[keyframes]) @ state.cameras.world_from_camera)
    moved = np.stack([np.interp(times, times[keyframes], deviation[:, n]) for n in range(6)], axis=1)
    poses = geometry.retract(poses, moved)
    poses[keyframes] = state.cameras.world_from_camera
    spread[keyframes] = 0.0
    return poses, spread


def expected_spread(prior: Prior, solved: Prior, calibration: Calibration, keyframes: Indices) -> np.ndarray:
    """(I, 6, 6): covariance of images that only the trajectory tells of, where `fill` puts them; arguments as of it."""
    return _expected(prior, solved, calibration, keyframes)[1]


def _expected(
    prior: Prior, solved: Prior, calibration: Calibration, keyframes: Indices
) -> tuple[np.ndarray, np.ndarray]:
    """Poses (I, 4, 4) of all images by the source that is best for each, and their covariances (I, 6, 6)."""
    order = [float(np.median(s.sigma_rotation)) + float(np.median(s.sigma_position)) for s in solved.sources]
    by_order = np.argsort(order, kind="stable")
    predicted = np.stack([predict(prior, prior.sources[n], calibration) for n in by_order])
    # the sigmas were rescaled in the solve: so are those of the images between
    spread = np.stack([_rescaled(prior.sources[n], solved.sources[n], keyframes) for n in by_order])
    used = (
        np.where(prior.sources[by_order[0]].spoken.all(axis=1), 0, spread.sum(axis=2).argmin(axis=0)),
        np.arange(len(prior)),
    )
    camera_from_scan = prior.calibration.reference.scan_from_camera[:3, :3].T
    along = np.square(spread[used])[:, :, None] * np.eye(6)
    return predicted[used], geometry.turn_tangent(along, camera_from_scan)


def _rescaled(source: Source, solved: Source, keyframes: Indices) -> np.ndarray:
    """(I, 6), rad and m: sigmas of all images, as much larger as those of the keyframes (K,) were found to be."""
    heard = solved.spoken.all(axis=1)
    if not heard.any():
        return sigmas(source)
    scale = np.median((sigmas(solved) / sigmas(source)[keyframes])[heard], axis=0)
    return np.asarray(np.where(np.repeat(source.spoken, 3, axis=1), scale, 1.0) * sigmas(source))


def _scan_sigmas(
    scan_times: np.ndarray, covariance: np.ndarray | None, times: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(I, 3) rad and (I, 3) m: how far the less certain of the scans about each image may be off along each axis."""
    if covariance is None:
        return (
            np.full((len(times), 3), np.radians(CEILING_ROTATION_DEG)),
            np.full((len(times), 3), CEILING_POSITION_M),
        )
    before, _ = trajectory.bracket(scan_times, times)
    after = np.minimum(before + 1, len(scan_times) - 1)
    variance = np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0)
    sigma = np.sqrt(np.maximum(variance[before], variance[after]))
    return sigma[:, :3], sigma[:, 3:]


def _spline_sigmas(scans: Trajectory, times: Times) -> tuple[np.ndarray, np.ndarray]:
    """(I, 6), rad and m: what splines through the scans may miss at the images along the axes of the LiDAR, and what they
    miss more near their ends.

    The second is not scaled by what frames deviate: these are nearly all between scans on both sides.
    """
    left_out = spline.leave_one_out_error_by_axis(scans, times)
    within = BETWEEN_SCANS * left_out + np.repeat([np.radians(FLOOR_ROTATION_DEG), FLOOR_POSITION_M], 3)
    # beyond the scans, and far from them, there is nothing to interpolate: that counts for nothing
    within[spline.unknown(scans, times)] *= _NOTHING
    return within, AT_ENDS * spline.boundary_error(scans, times)[:, None] * left_out


def predict(prior: Prior, source: Source, calibration: Calibration) -> np.ndarray:
    """world_from_camera of all images if they sat on the trajectory exactly, (I, 4, 4)."""
    late = calibration.lateness(_since_epoch(prior))[:, None]
    turn = Rotation.from_rotvec(prior.rate_scan * late).as_matrix()
    shifted = source.world_from_scan.copy()
    shifted[:, :3, :3] = shifted[:, :3, :3] @ turn
    shifted[:, :3, 3] += prior.velocity_world * late
    return np.asarray(shifted @ calibration.scan_from_camera)


def _since_epoch(prior: Prior) -> np.ndarray:
    """(I,) s; zero where stamps are not known."""
    return np.zeros(len(prior)) if prior.times is None else prior.times - prior.epoch


def residuals(prior: Prior, source: Source, state: VisualState) -> np.ndarray:
    """(I, 6): deviation of each camera from its prediction, along the LiDAR's axes as calibrated, rad and m."""
    rotation, position = _in_camera(prior, source, state)
    return _turned(prior, np.concatenate([rotation, position], axis=1)[..., None])[..., 0]


def _in_camera(prior: Prior, source: Source, state: VisualState) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and position (I, 3) of each camera from its prediction, in the predicted camera's axes."""
    predicted, actual = predict(prior, source, state.calibration), state.cameras.world_from_camera
    back = np.swapaxes(predicted[:, :3, :3], 1, 2)
    rotation = Rotation.from_matrix(back @ actual[:, :3, :3]).as_rotvec()
    return rotation, (back @ (actual[:, :3, 3:] - predicted[:, :3, 3:]))[..., 0]


def _turned(prior: Prior, derivatives: np.ndarray) -> np.ndarray:
    """Rows `[rotation | position]` (I, 6, n) in the camera's axes, along the LiDAR's as calibrated."""
    turn = prior.calibration.reference.scan_from_camera[:3, :3]
    return np.concatenate([turn @ derivatives[:, :3], turn @ derivatives[:, 3:]], axis=1)


def jacobians(prior: Prior, source: Source, state: VisualState) -> tuple[np.ndarray, np.ndarray]:
    """Of the residuals `[rotation | position]`: (I, 6, 6) by the camera's pose, (I, 6, k) by the calibration."""
    rotation, position = _in_camera(prior, source, state)
    predicted, actual = predict(prior, source, state.calibration), state.cameras.world_from_camera
    back = np.swapaxes(predicted[:, :3, :3], 1, 2)
    by_camera = np.zeros((len(prior), 6, 6))
    by_camera[:, :3, :3] = geometry.inverse_right_jacobian(rotation)
    by_camera[:, 3:, 3:] = back @ actual[:, :3, :3]
    by_extrinsic = np.zeros((len(prior), 6, 6))
    by_extrinsic[:, :3, :3] = -geometry.inverse_right_jacobian(-rotation)
    by_extrinsic[:, 3:, :3] = geometry.hat(position)
    by_extrinsic[:, 3:, 3:] = -np.eye(3)
    extrinsic = state.calibration.scan_from_camera
    # turning the LiDAR about its own axes commutes with turning it about them by the offset so far
    rate_camera = prior.rate_scan @ extrinsic[:3, :3]
    lever = predicted[:, :3, :3] @ (
        extrinsic[:3, :3].T @ np.cross(prior.rate_scan, extrinsic[:3, 3])[..., None]
    )
    velocity = prior.velocity_world[..., None] + lever
    by_offset = np.zeros((len(prior), 6))
    by_offset[:, :3] = (by_extrinsic[:, :3, :3] @ rate_camera[..., None])[..., 0]
    by_offset[:, 3:] = np.cross(position, rate_camera) - (back @ velocity)[..., 0]
    layout = state.calibration.layout()
    by_calibration = np.zeros((len(prior), 6, layout.size))
    by_calibration[:, :, layout["scan_from_camera"]] = by_extrinsic
    by_calibration[:, :, layout["time_offset"]] = by_offset[..., None]
    if prior.drifting:
        by_calibration[:, :, layout["clock_rate"]] = (_since_epoch(prior)[:, None] * by_offset)[..., None]
    return _turned(prior, by_camera), _turned(prior, by_calibration)


def linearize(prior: Prior, state: VisualState) -> NormalEquations:
    """Normal equations over I blocks of 7, the images (their log exposures untouched), bordered by the calibration.

    A frame's deviation in rotation and in position each have a robust (Huber) weight: a few frames may be off.
    """
    total = prior.calibration.linearize(state.calibration, (len(prior), 7))
    for source in prior.sources:
        total = _linearize_source(prior, source, state) + total
    return total


def gradient_variance(prior: Prior, state: VisualState) -> NormalEquations:
    """What the prior's gradient varies by: its Hessian, but for a calibration that counts for more than is claimed.

    Blocks as in `linearize`; cost and gradient mean nothing.
    """
    equations = linearize(prior, state)
    assert equations.border is not None
    known = prior.calibration
    more = known.gradient_variance(state.calibration) - known.hessian(state.calibration)
    return replace(equations, border=replace(equations.border, hessian=equations.border.hessian + more))


def _linearize_source(prior: Prior, source: Source, state: VisualState) -> NormalEquations:
    count = len(prior)
    deviation = residuals(prior, source, state)
    by_camera, by_calibration = jacobians(prior, source, state)
    sigma = sigmas(source)
    weight, cost = _robust(deviation / sigma)
    scaled = weight / sigma**2
    camera = np.zeros((count, 6, 7))
    camera[:, :, :6] = by_camera
    pull = scaled * deviation
    weighted = camera * scaled[..., None]
    border = Border(
        np.einsum("nki,nkj->nij", weighted, by_calibration),
        np.einsum("nki,nkj->ij", by_calibration * scaled[..., None], by_calibration),
        np.einsum("nki,nk->i", by_calibration, pull),
    )
    index = np.arange(count)
    blocks, gradient = np.einsum("nki,nkj->nij", weighted, camera), np.einsum("nki,nk->ni", camera, pull)
    return normal_equations.from_blocks(index, index, blocks, gradient, cost, border)


def sigmas(source: Source) -> np.ndarray:
    """(I, 6), of residuals `[rotation | position]`: a frame's own deviation and the scans' errors together."""
    rotation = np.hypot(
        source.sigma_rotation, np.sqrt(source.correlation_inflation[0]) * source.scan_rotation
    )
    position = np.hypot(
        source.sigma_position, np.sqrt(source.correlation_inflation[1]) * source.scan_position
    )
    return source.and_late(np.concatenate([rotation, position], axis=1))


def with_late(prior: Prior, calibration: Calibration) -> Prior:
    """The prior with what is not known of the motion while the clocks were apart; as it is where nothing tells."""
    if prior.scans is None or prior.times is None:
        return prior
    sigma = trajectory_rates.rate_sigmas_of(prior.scans, prior.times)
    if sigma is None:
        return prior
    late = np.abs(calibration.lateness(_since_epoch(prior)))[:, None] * sigma
    return replace(prior, sources=tuple(replace(source, late=late) for source in prior.sources))


def _robust(normalized: np.ndarray) -> tuple[np.ndarray, float]:
    """Huber weights (I, 6), one per frame for its rotation and one for its position, and the cost."""
    size = np.linalg.norm(normalized.reshape(-1, 2, 3), axis=2)
    limit = _FRAME_HUBER * np.sqrt(3.0)
    clipped = np.minimum(size, limit)
    weight = limit / np.maximum(size, limit)
    return np.repeat(weight, 3, axis=1), float((clipped * (size - 0.5 * clipped)).sum())
