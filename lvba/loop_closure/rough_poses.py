"""Rough poses that are off by more than a bundle adjustment can start from: noticed, and replaced by what surfaces say.

Jumps of a meter, or an odometry that is decimeters off from scan to scan, leave the LiDAR bundle adjustment in a wrong
minimum. Where the scans contradict the odometry so far, each scan is registered to those before it, groups of successive
scans are solved, registered to each other wherever they see the same place, and laid out by a pose graph.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from lvba import geometry
from lvba.arrays import Poses, Vector
from lvba.errors import DegenerateProblemError
from lvba.lidar import bundle_adjustment
from lvba.lidar.config import LidarConfig
from lvba.lidar.odometry_factor import JUMP, OdometryPrior, odometry_prior, with_jumps
from lvba.loop_closure import candidates, registration, scan_steps, submap
from lvba.loop_closure.candidates import CandidateConfig
from lvba.loop_closure.scan_steps import Step
from lvba.loop_closure.submap import Patch, Submap
from lvba.loop_closure.surfel_icp import Target
from lvba.optim import pose_graph
from lvba.optim.pose_graph import Edges
from lvba.progress import Progress, silent
from lvba.trajectory import JUMP_DEG, JUMP_M

_log = logging.getLogger(__name__)

_POINTS = 15_000
"""Of a scan, to look at: surfaces do not need more."""
_TESTED = 6
"""Steps that are tested, those by which surfaces agree least."""
_PASSES = 2
"""Where the odometry is decimeters off everywhere, what is open is laid out again beside the poses that came of it."""
_GAIN = 0.1
"""Part of a scan's surfels by which the agreement must grow: what overlaps little could be anything."""
_FAR_GAIN = 0.3
"""The same where neither scan sees through surfaces of the other: a narrow sensor that moves along a wall sees again only
part of what it saw, and the wall agrees with more of itself a meter further back."""
_IN_SIGHT = 0.05
"""Part of what two scans say that contradicts the odometry's motion, where they determine another one in all directions:
of motions that were right it was .01 at most, of jumps by a meter at which much still agrees .1 and more."""
_MORE = 0.1
"""Part of what scans on either side say by which more may contradict a motion that replaces the odometry's."""
_SAME_M, _SAME_DEG = 0.1, 1.0
"""Motions that differ by less are the same: two thin scans do not tell it better."""
_BESIDE = (1, 4)
"""Scans on either side of a motion whose surfaces are asked whether they confirm it."""
_BEFORE = 8
"""Scans that another one is registered to."""
_OUTLYING = 6.0
_LEAST_SIGMA = np.repeat([np.radians(0.2), 0.02], 3)
"""rad and m: surfaces do not tell better how good the odometry is."""
_PRECISE = 2.0
_MEDIAN_OF_NORM = 1.54
"""Of a normal distribution in three dimensions, with unit variance along each."""
_GROUP = 12
"""Scans that are solved together: enough to see a place from all sides, too few to drift."""
_CANDIDATES = CandidateConfig(drift=0.03, drift_deg=2.0, least_m=0.8, least_deg=2.0, pairs_per_part=6)
"""Groups are registered where they may be off by more than an odometry would be: so is what is mended here."""


@dataclass(frozen=True)
class RoughError:
    """How far rough poses are off that a bundle adjustment could not start from, and what is left of it.

    step_m, step_deg: of the motion from a scan to the next, typically, along each axis
    wrong_after: (J,) int64, scans after which it is off by far more
    open_after: (K,) int64, of these, and of all where every motion is off by decimeters, where surfaces do not determine
        it in every direction
    left_after: (L,) int64, scans after which the result contradicts what both scans see
    """

    step_m: float
    step_deg: float
    wrong_after: np.ndarray
    open_after: np.ndarray
    left_after: np.ndarray

    def numbered(self, scans: np.ndarray) -> "RoughError":
        """The same with numbers of the whole. scans: (n,) int64, number of each scan in the whole"""
        after = {name: scans[getattr(self, name)] for name in ("wrong_after", "open_after", "left_after")}
        return replace(self, **after)


def of_all(errors: Sequence[RoughError]) -> RoughError | None:
    """Of a recording whose parts have these; None: they have none."""
    if not errors:
        return None
    together = {
        name: np.unique(np.concatenate([getattr(each, name) for each in errors]))
        for name in ("wrong_after", "open_after", "left_after")
    }
    return RoughError(
        step_m=max(each.step_m for each in errors), step_deg=max(each.step_deg for each in errors), **together
    )


@dataclass(frozen=True)
class StartPoses:
    """Where the bundle adjustment begins instead of at the rough poses: (S, 4, 4) float64, the first unchanged.

    error: of the rough poses
    """

    world_from_scan: np.ndarray
    error: RoughError

    def judged(self, patches: Sequence[Patch | None], world_from_scan: Poses) -> RoughError:
        """The error, with what is left of it in refined poses (S, 4, 4). patches: of `surfels_of`"""
        return replace(self.error, left_after=contradicted(patches, world_from_scan))


def odometry_of(
    rough: Poses, error: RoughError | None, world_from_scan: Poses, config: LidarConfig
) -> OdometryPrior:
    """What rough poses (S, 4, 4) still say of the motions from scan to scan.

    error: None: as much as the settings let expect; else their steps are as good as they proved to be, and those that are
        wrong are as poses (S, 4, 4) have them that came of surfaces, and say next to nothing
    """
    if error is None:
        return odometry_prior(rough, config.prior_rotation, config.prior_translation)
    rotation = max(config.prior_rotation, float(np.radians(error.step_deg)))
    prior = odometry_prior(rough, rotation, max(config.prior_translation, error.step_m))
    return with_jumps(prior, error.wrong_after, world_from_scan)


def thinned(points: np.ndarray, number: int) -> np.ndarray:
    """At most so many points of scan `number` as are looked at, (M, 3) float32, m.

    points: (N, 3) float32, m
    """
    if len(points) <= _POINTS:
        return points
    return points[np.sort(np.random.default_rng(number).permutation(len(points))[:_POINTS])]


def surfels_of(scans: Sequence[np.ndarray], sensor_position: Vector | None = None) -> list[Patch | None]:
    """Surfels of each scan for `contradicted` and `start`; None of those that see too little.

    scans: S arrays (N, 3) float32, m, scan frame; sensor_position: (3,), m, scan frame
    """
    sensor = np.zeros(3) if sensor_position is None else np.asarray(sensor_position, float)
    return [scan_steps.surfels(thinned(points, number), sensor) for number, points in enumerate(scans)]


def contradicted(patches: Sequence[Patch | None], world_from_scan: Poses) -> np.ndarray:
    """(K,) int64, ascending: scans after which the step of poses (S, 4, 4) is decimeters off, of those that were tested.

    Tested are the steps by which surfaces agree least.
    """
    steps = geometry.steps(world_from_scan)
    agree = np.full(len(steps), np.inf)
    for k, (first, second) in enumerate(pairwise(patches)):
        if first is not None and second is not None:
            agree[k] = scan_steps.overlap(Target.of(first), second, steps[k])
    wrong = []
    for k in np.argsort(agree, kind="stable")[:_TESTED]:
        step = _registered(patches, world_from_scan, k)
        if step is not None and _far(step.correction(steps[k])) and step.overlap > agree[k] + _GAIN:
            wrong.append(int(k))
    return np.array(sorted(wrong), np.int64)


def confirmed(
    patches: Sequence[Patch | None], world_from_scan: Poses, after: np.ndarray, expected: Poses
) -> np.ndarray:
    """(K,) int64, ascending: of some scans, those whose motion to the next one surfaces confirm.

    patches: of `surfels_of`; world_from_scan: (S, 4, 4); after: (J,) int64, the scans
    expected: (S - 1, 4, 4), motions as those before and after let expect
    Surfaces confirm a motion if they determine it in all directions, agree with it, and do not agree as well with
    another one that is nearer to what is expected: those of both scans, or of some on both sides where these are few.
    """
    sure = []
    for k in np.unique(after):
        motion = geometry.inverse(world_from_scan[k]) @ world_from_scan[k + 1]
        for most in _BESIDE:
            pair = _beside(patches, world_from_scan, k, most)
            if pair is not None and _agreed(*pair, motion, expected[k]):
                sure.append(int(k))
                break
    return np.array(sure, np.int64)


def _agreed(first: Patch, second: Patch, motion: np.ndarray, expected: np.ndarray) -> bool:
    """Whether surfaces determine a motion (4, 4), agree with it, and with none near the expected one (4, 4) as well."""
    target = Target.of(first)
    step = scan_steps.register(target, second, motion)
    if not step.aligned or step.open or _apart(motion, step.first_from_second):
        return False
    rival = scan_steps.register(target, second, expected)
    same = not _apart(rival.first_from_second, step.first_from_second)
    return same or not rival.aligned or rival.overlap < step.overlap - _GAIN


def _registered(patches: Sequence[Patch | None], world_from_scan: np.ndarray, k: int) -> Step | None:
    """Scan k + 1 as `scan_steps.register` has it beside scan k; None: one of them sees too little. Nothing is known where
    that is far from what the odometry (S, 4, 4) has, without good reason.

    Scans that overlap little, as of a narrow sensor that turns, fit together in several ways: any wall fits any other
    one. Surfaces speak against an odometry if they contradict it in sight, or determine another motion in all directions,
    by which far more of them agree, and which those of the scans before and behind do not contradict any more than it.
    """
    first, second = patches[k], patches[k + 1]
    if first is None or second is None:
        return None
    rough, target = geometry.steps(world_from_scan[k : k + 2])[0], Target.of(first)
    step = scan_steps.register(target, second, rough)
    if not _far(step.correction(rough)):
        return step
    if step.open:
        if scan_steps.contradicts(target, second, rough):
            return step
    else:
        if scan_steps.contradicting(target, second, rough) > _IN_SIGHT:
            return step
        around = _beside(patches, world_from_scan, k, _BESIDE[-1])
        more = step.overlap > scan_steps.overlap(target, second, rough) + _FAR_GAIN
        if more and not (around and _more_against(*around, step.first_from_second, rough)):
            return step
    return replace(step, first_from_second=rough, information=np.zeros((6, 6)), open=6)


def _beside(
    patches: Sequence[Patch | None], world_from_scan: np.ndarray, k: int, most: int
) -> tuple[Patch, Patch] | None:
    """Surfels of scan k and so many before it, in its frame, and of those behind it in that of the first; None: none."""
    before, behind = slice(max(0, k + 1 - most), k + 1), slice(k + 1, k + 1 + most)
    first = scan_steps.together(patches[before], world_from_scan[before], -1)
    second = scan_steps.together(patches[behind], world_from_scan[behind], 0)
    return None if first is None or second is None else (first, second)


def _more_against(first: Patch, second: Patch, motion: np.ndarray, rough: np.ndarray) -> bool:
    """Whether surfaces contradict a motion (4, 4) by more than the odometry's (4, 4)."""
    target = Target.of(first)
    against, by_rough = (scan_steps.contradicting(target, second, each) for each in (motion, rough))
    return against > by_rough + _MORE


def _far(off: np.ndarray) -> bool:
    """Whether a motion that is off by so much, (6,) rad and m, is decimeters off."""
    return bool(np.linalg.norm(off[3:]) > JUMP_M or np.linalg.norm(off[:3]) > np.radians(JUMP_DEG))


def _apart(one: np.ndarray, other: np.ndarray) -> bool:
    off = geometry.log(geometry.inverse(one) @ other)
    return bool(np.linalg.norm(off[3:]) > _SAME_M or np.linalg.norm(off[:3]) > np.radians(_SAME_DEG))


def start(
    scans: Sequence[np.ndarray],
    patches: Sequence[Patch | None],
    world_from_scan: Poses,
    *,
    sensor_position: Vector | None = None,
    config: LidarConfig | None = None,
    progress: Progress = silent,
) -> StartPoses:
    """Poses that surfaces agree with, from rough ones (S, 4, 4) that they contradict.

    scans: S arrays (N, 3) float32, m, scan frame; patches: of `surfels_of`
    """
    config, poses = config or LidarConfig(), world_from_scan
    pieces = np.array_split(np.arange(len(poses)), max(1, round(len(poses) / _GROUP)))
    error: RoughError | None = None
    for _ in range(_PASSES):
        odometry = _Odometry.of(patches, poses, progress)
        chain = odometry.chained(patches, progress)
        prior = odometry_of(poses, odometry.error(chain), chain.world_from_scan, config)
        groups = []
        for number, members in enumerate(pieces):
            progress("solving groups of scans", number, len(pieces))
            groups.append(_Group.solved(scans, members, chain, prior, sensor_position, config))
        steps = _steps(groups, chain)
        begin = pose_graph.propagate(len(poses), steps, 0, world_from_scan[0])
        graph = pose_graph.solve(begin, pose_graph.concatenate([steps, _loops(groups, begin, progress)]))
        poses, error = graph.world_from_node, error or odometry.error(chain)
        _log.info("rough poses are off by %.3f m and %.2f degrees a step", error.step_m, error.step_deg)
        if odometry.precise:
            break
    assert error is not None
    return StartPoses(poses, error)


@dataclass(frozen=True)
class _Chain:
    """Poses (S, 4, 4), each step as surfaces have it, and the information of all steps (S - 1, 6, 6)."""

    world_from_scan: np.ndarray
    steps: list[Step | None]
    information: np.ndarray


@dataclass(frozen=True)
class _Odometry:
    """Rough steps (S - 1, 4, 4), what surfaces of the two scans say, sigma (6,), and which are wrong (S - 1,) bool."""

    rough: np.ndarray
    first: np.ndarray
    steps: list[Step | None]
    sigma: np.ndarray
    wrong: np.ndarray

    @staticmethod
    def of(patches: Sequence[Patch | None], world_from_scan: np.ndarray, progress: Progress) -> "_Odometry":
        rough = geometry.steps(world_from_scan)
        steps: list[Step | None] = []
        for k in range(len(rough)):
            progress("registering scans", k, 2 * len(rough))
            steps.append(_registered(patches, world_from_scan, k))
        off = np.array(
            [
                each.correction(motion) if each is not None else np.zeros(6)
                for each, motion in zip(steps, rough, strict=True)
            ]
        )
        size = np.linalg.norm(off.reshape(-1, 2, 3), axis=2)
        aligned = np.array([each is not None and each.aligned for each in steps])
        typical = np.median(size[aligned], axis=0) / _MEDIAN_OF_NORM if aligned.any() else np.zeros(2)
        sigma = np.maximum(np.repeat(typical, 3), _LEAST_SIGMA)
        wrong = (size > _OUTLYING * sigma[[0, 3]]).any(axis=1)
        return _Odometry(rough, world_from_scan[0], steps, sigma, wrong)

    @property
    def precise(self) -> bool:
        """Whether most steps are as good as an odometry's: what is open is well where it has it."""
        return bool((self.sigma <= _PRECISE * _LEAST_SIGMA).all())

    def error(self, chain: _Chain) -> RoughError:
        """Of the rough poses. chain: as surfaces have them"""
        wrong = np.flatnonzero(self.wrong)
        # where every step is decimeters off, none can do without surfaces
        suspects = wrong if self.precise else np.arange(len(self.rough))
        unknown = [k for k in suspects if (step := chain.steps[k]) is None or step.open]
        return RoughError(
            step_m=float(self.sigma[3]),
            step_deg=float(np.degrees(self.sigma[0])),
            wrong_after=wrong,
            open_after=np.array(unknown, np.int64),
            left_after=np.zeros(0, np.int64),
        )

    def prior(self, step: int) -> np.ndarray:
        """(6, 6), information of a rough step."""
        return JUMP if self.wrong[step] else np.diag(self.sigma**-2.0)

    def chained(self, patches: Sequence[Patch | None], progress: Progress) -> _Chain:
        """Each scan registered to those before it, one after another."""
        poses, steps, information = [self.first], [], []
        for k, motion in enumerate(self.rough):
            progress("registering scans", len(self.rough) + k, 2 * len(self.rough))
            prior, own = self.prior(k), self.steps[k]
            begin = motion if own is None else own.beside(motion, prior)
            near = slice(max(0, k + 1 - _BEFORE), k + 1)
            world = np.array(poses[near])
            around, second = scan_steps.together(patches[near], world, -1), patches[k + 1]
            step = None
            if around is not None and second is not None:
                step = scan_steps.refined(Target.of(around), second, begin, motion, prior)
            if step is not None and step.aligned:
                begin = step.beside(motion, prior)
            poses.append(poses[-1] @ begin)
            steps.append(step)
            information.append(prior + (step.information if step is not None else 0.0))
        return _Chain(np.array(poses), steps, np.array(information).reshape(-1, 6, 6))


@dataclass(frozen=True)
class _Group:
    """Successive scans that were solved together, in a frame of their own.

    members: (n,) int64, numbers; poses: (n, 4, 4); information: (n - 1, 6, 6) of their steps; surfaces: None where planes
    do not tie the scans
    """

    members: np.ndarray
    poses: np.ndarray
    information: np.ndarray
    surfaces: Submap | None

    @staticmethod
    def solved(
        scans: Sequence[np.ndarray],
        members: np.ndarray,
        chain: _Chain,
        prior: OdometryPrior,
        sensor_position: Vector | None,
        config: LidarConfig,
    ) -> "_Group":
        poses = chain.world_from_scan[members]
        try:
            result = bundle_adjustment.refine(
                [scans[k] for k in members],
                poses,
                odometry=prior.among(members),
                sensor_position=sensor_position,
                config=config,
            )
        except DegenerateProblemError:
            return _Group(members, poses, chain.information[members[:-1]], None)
        information = pose_graph.information_of(result.step_covariance)
        surfaces = submap.of_result(result, members, sensor_position)
        return _Group(members, result.world_from_scan, information, surfaces)


def _steps(groups: Sequence[_Group], chain: _Chain) -> Edges:
    """From each scan to the next: inside a group as it has them, from group to group as the chain has them."""
    measured = geometry.steps(chain.world_from_scan)
    information = chain.information.copy()
    for group in groups:
        inside = group.members[:-1]
        measured[inside] = geometry.steps(group.poses)
        information[inside] = group.information
    first = np.arange(len(measured))
    return Edges(first, first + 1, measured, information, np.zeros(len(first), bool))


def _loops(groups: Sequence[_Group], world_from_scan: np.ndarray, progress: Progress) -> Edges:
    """Groups that see the same place, looked for by poses (S, 4, 4)."""
    pairs = candidates.candidates(world_from_scan, tuple(group.members for group in groups), _CANDIDATES)
    closed = []
    for number, pair in enumerate(pairs):
        progress("registering groups of scans", number, len(pairs))
        first, second = groups[pair.first].surfaces, groups[pair.second].surfaces
        if first is not None and second is not None:
            loop = registration.register(first, second, pair)
            closed += [loop] if loop.accepted else []
    return registration.edges(closed)
