"""Scan poses that both sensors agree on: the LiDAR's planes and the refined cameras.

A narrow LiDAR before one wall leaves its scan half open: planes may hold it to centimetres only, while images hold the
cameras just before and after it to millimetres. So each scan becomes the mean of its own pose and of where a spline
through the refined cameras has it, through the extrinsic and the time offset found, each weighed by what is known of it.
What is common to all cameras (extrinsic, time offset) is found with the errors of the scans, and moves none of them.
Along motions that planes leave open for all scans (a corridor) each slides by itself to where the cameras have it.
Source: Barfoot and Furgale 2014, for fusing poses in the tangent space; Li et al. leave the scans as they are.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from lvba import geometry, spline, trajectory
from lvba.arrays import Indices, Pose, PoseBlocks, Poses, Times
from lvba.lidar.covariance import LEAST, Covariance, carry_to_next, local_covariance, positive
from lvba.lidar.degeneracy import DegenerateDirection
from lvba.settings import setting
from lvba.steps import error_chain
from lvba.steps.open_motions import Open, OpenMotions
from lvba.steps.uncertainty import is_known, squared_distances
from lvba.trajectory import Trajectory
from lvba.visual import image_groups

_MEDIAN = 5.348 / 6
"""Median of a chi-square of six degrees of freedom, over six."""
_MEDIAN_OF_ONE = 0.4549
"""Median of a chi-square of one degree of freedom."""
_LEAST_BETWEEN = 0.1
"""Of smooth motion, a cubic spline misses 0.08 of what leaving a sample out changes: less is chance."""
_FLOOR = np.repeat([np.radians(1e-3), 1e-4], 3)
"""rad and m: nothing is interpolated better than this."""
_RATE_STEP_S = 0.02

_PAST_ENDS = 1.0
"""Times the time from the first image to the second, or between the last two: so far past them the spline through the
cameras is followed."""

_NEARLY_ALL = 0.95
"""Part of the images."""

CONTRADICTION = 5.0
"""A scan and the cameras about it that are further apart than this many standard deviations contradict each other, and
the scan stays."""


@dataclass(frozen=True)
class FusionConfig:
    """How scan poses are refined with the cameras."""

    enabled: bool = setting(
        True,
        meaning="Refine scan poses with the refined cameras. false: scans keep the poses of the LiDAR bundle "
        "adjustment.",
        change_when="Only the LiDAR is to decide where scans are.",
    )


@dataclass(frozen=True)
class Cameras:
    """Refined cameras as they tell where the LiDAR is.

    world_from_scan: of the LiDAR at the moments of the images, on its clock
    covariance: (K, 6, 6), of these relative to the map around them, local tangent [rotation | translation], rad and m
    extrinsic_covariance: (6, 6), what all of them are off together because the extrinsic is, in the LiDAR's tangent
    offset_sigma: s, how far the clocks may be apart beyond the offset found
    group: (K,) int64, as `VisualResult.group`; empty: not known
    """

    world_from_scan: Trajectory
    covariance: np.ndarray
    extrinsic_covariance: np.ndarray
    offset_sigma: float
    group: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))


@dataclass(frozen=True)
class Fused:
    """Scans where both sensors have them.

    world_from_scan: (S, 4, 4) float64; covariance: (S, 6, 6), as `lidar.covariance.Covariance.marginal`
    moved_m: (S,) from where the LiDAR had them
    interpolation_error_scale: error of the spline between cameras over the leave-one-out error of the cameras, as
        the distances of the scans from the spline explain it; the median of the six axes
    variance_factor: actual over predicted variance of the differences between scans and cameras, at least 1
    contradicted: scans that stayed because the cameras contradict them
    slide_sigma_m: m, root mean square: what the cameras say of how far scans have slid along what planes leave open for
        all of them is uncertain by so much; 0: nothing is open
    open_motions: that these are; None: nothing is open
    open_by_images: whether the covariance counts on images along these; else on the odometry alone
    only_slid: whether scans went along these, and learned nothing else
    slid: what they are then; None: nothing is open, or this is that
    drawn: (S, 4, 4) float64, poses that are as likely as those of the LiDAR by what planes say: these are to make a map
        that is no sharper; (0, 4, 4): not known
    """

    world_from_scan: np.ndarray
    covariance: np.ndarray
    moved_m: np.ndarray
    interpolation_error_scale: float
    variance_factor: float
    contradicted: int
    slide_sigma_m: float = 0.0
    open_motions: OpenMotions | None = None
    open_by_images: bool = False
    only_slid: bool = False
    slid: "Fused | None" = None
    drawn: np.ndarray = field(default_factory=lambda: np.zeros((0, 4, 4)))


def scan_poses_from_cameras(
    world_from_camera: Poses,
    moments: Times,
    covariance: PoseBlocks,
    scan_from_camera: Pose,
    extrinsic_sigma: np.ndarray,
    group: Indices | None = None,
) -> Cameras:
    """Where cameras (K, 4, 4) have the LiDAR; those without a covariance are left out.

    moments: (K,) s, ascending, on the LiDAR's clock; covariance: (K, 6, 6), relative to the map, in the camera's tangent
    extrinsic_sigma: (7,) float64, as in `VisualResult`; group: (K,) int64, of each image; None: not known
    """
    known = is_known(covariance)
    carry = geometry.adjoint(scan_from_camera)
    return Cameras(
        Trajectory(moments[known], world_from_camera[known] @ geometry.inverse(scan_from_camera)),
        carry @ covariance[known] @ carry.T,
        carry @ np.diag(np.square(extrinsic_sigma[:6])) @ carry.T,
        float(extrinsic_sigma[6]),
        np.zeros(0, np.int64) if group is None else group[known],
    )


def fuse(
    scans: Trajectory,
    covariance: Covariance,
    cameras: Cameras,
    common: Sequence[DegenerateDirection] = (),
) -> Fused | None:
    """The scans refined with the cameras; None: too few cameras to tell.

    common: motions of all scans that the planes leave open. Along these each scan goes by itself: the planes do not mind,
        and no other motion of it has to do with that
    """
    if len(cameras.world_from_scan) < spline.FEWEST_SAMPLES:
        return None
    seen = _seen(cameras, scans)
    open_motions = OpenMotions.of(common)
    open_ = None if open_motions is None else open_motions.at(scans.world_from_sensor)
    # how far scans have slid, as the odometry has it, says nothing of how well both are known
    judged = seen.differences - open_.part(seen.differences) if open_ else seen.differences
    known = seen.alone + seen.shared @ np.swapaxes(seen.shared, -1, -2) + seen.at_ends
    own = local_covariance(covariance, scans.world_from_sensor)
    interpolation_error_scale = _interpolation_error_scale(
        judged[seen.inside], (own + known)[seen.inside], seen.leave_one_out_error[seen.inside]
    )
    interpolated = _interpolated(seen.leave_one_out_error, interpolation_error_scale)
    of_cameras = known + interpolated
    distance = squared_distances(judged, own + of_cameras)
    variance_factor = 1.0
    if seen.inside.any():
        variance_factor = max(variance_factor, float(np.median(distance[seen.inside])) / _MEDIAN)
    contradicted = seen.near & (distance > CONTRADICTION**2 * variance_factor)
    used = seen.near & ~contradicted
    # where motions are known, a group of scans may be off as far as it is uncertain within the trajectory: cameras far
    # apart in time see it beside others
    in_chain = covariance.in_map + LEAST * np.eye(6) if len(covariance.step) else own
    step, slide = _corrections(
        in_chain,
        covariance.step,
        scans.world_from_sensor,
        # what both do not predict is the cameras': the scans' own share in it is in what groups are off
        variance_factor * seen.alone + seen.at_ends + interpolated,
        used,
        seen,
        open_,
    )
    fused = Fused(
        world_from_scan=_moved(scans.world_from_sensor, step),
        covariance=_predicted(covariance, np.linalg.inv(of_cameras), used & seen.inside, variance_factor),
        moved_m=np.linalg.norm(step[:, 3:], axis=1),
        interpolation_error_scale=float(np.median(interpolation_error_scale)),
        variance_factor=variance_factor,
        contradicted=int(np.count_nonzero(contradicted)),
        drawn=_drawn(in_chain, covariance.step, scans.world_from_sensor, open_),
    )
    if open_motions is None:
        return fused
    tied = used & _of_one_group(cameras, scans.times)
    return _with_slides(
        fused, open_motions, scans.world_from_sensor, slide, covariance.marginal, of_cameras, used, tied
    )


def _drawn(own: np.ndarray, step: np.ndarray, world_from_scan: np.ndarray, open_: Open | None) -> np.ndarray:
    """Scan poses (S, 4, 4) as likely as those given, but for slides along open motions. Others as of `_corrections`"""
    noise = np.random.default_rng(0).standard_normal((len(own), 6))
    errors = error_chain.drawn(own, step, carry_to_next(world_from_scan), noise)
    return geometry.retract(world_from_scan, errors if open_ is None else errors - open_.part(errors))


def _with_slides(
    fused: Fused,
    open_motions: OpenMotions,
    world_from_scan: np.ndarray,
    slide: np.ndarray,
    own: np.ndarray,
    of_cameras: np.ndarray,
    used: np.ndarray,
    tied: np.ndarray,
) -> Fused:
    """The same with what is known of slides (S, 6) along open motions, and the scans that do nothing but slide.

    own, of_cameras: (S, 6, 6), covariances of scans and of what cameras say; used, tied: (S,) bool, where they say
    anything, and where the covariance counts on it
    """
    open_, wide = open_motions.at(world_from_scan), fused.variance_factor * of_cameras
    fused = replace(
        fused,
        covariance=open_.known_by(fused.covariance, wide, tied),
        slide_sigma_m=open_.shift_m(of_cameras, used),
        open_motions=open_motions,
        open_by_images=bool(tied.any()),
    )
    slid = replace(
        fused,
        world_from_scan=_moved(world_from_scan, slide),
        covariance=open_.known_by(own, wide, tied),
        moved_m=np.linalg.norm(slide[:, 3:], axis=1),
        only_slid=True,
    )
    return replace(fused, slid=slid)


def _moved(world_from_scan: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Poses (S, 4, 4) after steps (S, 6); those without one keep their bits."""
    still = np.all(step == 0.0, axis=1)
    moved = geometry.retract(world_from_scan, step)
    return np.where(still[:, None, None], world_from_scan, moved)


def _of_one_group(cameras: Cameras, times: np.ndarray) -> np.ndarray:
    """(S,) bool: scans at times (S,) whose images, those about them, are of the one group that nearly all are of.

    Groups that nothing ties may be meters apart, each of them certain to a millimeter.
    """
    if not len(cameras.group):
        return np.zeros(len(times), bool)
    largest = image_groups.in_largest(cameras.group)
    if np.count_nonzero(largest) < _NEARLY_ALL * len(largest):
        return np.zeros(len(times), bool)
    before, _ = trajectory.bracket(cameras.world_from_scan.times, times)
    return np.asarray(largest[before] & largest[np.minimum(before + 1, len(largest) - 1)])


@dataclass(frozen=True)
class _Seen:
    """Where a spline through the cameras has the scans.

    differences: (S, 6), from the scans there; leave_one_out_error: (S, 6), by axis
    inside: (S,) bool, of the times of images; near: (S,) bool, or just past their ends
    alone, at_ends: (S, 6, 6), covariances of the cameras about each, and of the spline near its ends
    shared: (S, 6, 7), what one standard deviation of each number that all cameras share does
    """

    differences: np.ndarray
    leave_one_out_error: np.ndarray
    inside: np.ndarray
    near: np.ndarray
    alone: np.ndarray
    at_ends: np.ndarray
    shared: np.ndarray


def _seen(cameras: Cameras, scans: Trajectory) -> _Seen:
    path = cameras.world_from_scan
    past = spline.past_ends(path, scans.times)
    by_cameras = spline.through(path, scans.times, beyond=_PAST_ENDS * float(np.diff(path.times).max()))
    leave_one_out_error = spline.leave_one_out_error_by_axis(path, scans.times)
    extrapolated = spline.extrapolation_error(np.minimum(past, _PAST_ENDS))
    least = np.maximum(spline.boundary_error(path, scans.times), extrapolated)
    return _Seen(
        differences=geometry.log(geometry.inverse(scans.world_from_sensor) @ by_cameras),
        leave_one_out_error=leave_one_out_error,
        inside=past == 0.0,
        near=past <= _PAST_ENDS,
        alone=_of_neighbors(cameras, scans.times),
        at_ends=_interpolated(leave_one_out_error, least[:, None]),
        shared=_shared(cameras, scans.times),
    )


def _predicted(
    covariance: Covariance, information: np.ndarray, used: np.ndarray, variance_factor: float
) -> np.ndarray:
    """(S, 6, 6) of scans with what cameras know (S, 6, 6), of those used (S,) bool.

    Only what each scan gains against the map around it: cameras that see no more than a group of scans does are off with
    it, and that they agree with it is no proof.
    """
    conditional = covariance.conditional + LEAST * np.eye(6)
    posterior = np.linalg.inv(np.linalg.inv(conditional) + information * used[:, None, None])
    posterior = np.where(used[:, None, None], posterior * variance_factor, posterior)
    return np.asarray(posterior + positive(covariance.marginal - covariance.conditional))


_OPEN = 20.0
"""Times the odometry's sigmas from scan to scan: so far a scan may be off along what planes leave open, for all that is
known without the cameras."""


def _corrections(
    own: np.ndarray,
    step: np.ndarray,
    world_from_scan: np.ndarray,
    of_cameras: np.ndarray,
    used: np.ndarray,
    seen: _Seen,
    open_: Open | None,
) -> tuple[np.ndarray, np.ndarray]:
    """The most likely errors (S, 6) of the scans, those along open directions by themselves, and these alone (S, 6).

    Planes know how scans lie to each other in all other ways far better than the covariances of neighbors say (one wall
    for all scans of a corridor); a slide of decimeters must not leak into these.
    of_cameras: (S, 6, 6), covariances of what cameras say; used: (S,) bool, where they say anything
    """
    carry = carry_to_next(world_from_scan)
    information = np.linalg.inv(of_cameras) * used[:, None, None]
    # past the ends of the images these say how far scans have slid, no more
    within = information * seen.inside[:, None, None]
    differences, shared = seen.differences, seen.shared
    if open_ is None:
        whole = error_chain.most_likely(own, step, carry, within, differences, shared)
        return whole, np.zeros_like(whole)
    fixed = error_chain.most_likely(own, step, carry, within, differences - open_.part(differences), shared)
    along = error_chain.most_likely(
        open_.covariance(own) + _OPEN**2 * np.eye(open_.count),
        open_.covariance(step),
        np.broadcast_to(np.eye(open_.count), (len(step), open_.count, open_.count)),
        # given the rest of a camera's pose, which scans know: cameras of one place are off together in all of it
        np.swapaxes(open_.motion, -1, -2) @ information @ open_.motion,
        open_.along(differences),
        open_.coefficient @ shared,
    )
    slide = (open_.motion @ along[..., None])[..., 0]
    return fixed - open_.part(fixed) + slide, slide


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
    """(6,): for each axis, the part of the leave-one-out error at which half of the scans are closer to the spline."""
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
