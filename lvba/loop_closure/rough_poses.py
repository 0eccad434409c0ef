"""Rough poses that are off by more than a bundle adjustment can start from: noticed, and replaced by what surfaces say.

Jumps of a meter, or an odometry that is decimeters off from scan to scan, leave the LiDAR bundle adjustment in a wrong
minimum. Where the scans contradict the odometry so far, each scan is registered to those before it, groups of successive
scans are solved, registered to each other wherever they see the same place, and laid out by a pose graph.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from lvba import geometry
from lvba.arrays import Indices, Poses, Vector
from lvba.errors import DegenerateProblemError
from lvba.lidar import bundle_adjustment
from lvba.lidar.config import LidarConfig
from lvba.lidar.odometry_factor import JUMP, OdometryPrior, odometry_prior, with_jumps, with_motions
from lvba.loop_closure import candidates, registration, rough_motions, scan_steps, submap
from lvba.loop_closure.candidates import CandidateConfig
from lvba.loop_closure.scan_steps import Step
from lvba.loop_closure.submap import Patch, Submap
from lvba.loop_closure.surfel_icp import Target
from lvba.optim import pose_graph
from lvba.optim.pose_graph import Edges
from lvba.parallel import in_order
from lvba.progress import Progress, silent

_log = logging.getLogger(__name__)

_POINTS = 15_000
"""Of a scan, to look at: surfaces do not need more."""
_PASSES = 2
"""Where the odometry is decimeters off everywhere, what is open is laid out again beside the poses that came of it,
unless surfaces of successive scans have nothing against these."""
_BEFORE = 8
"""Scans that another one is registered to."""
_KNOWN = 0.1
"""Of the odometry's standard deviation, the most that planes of the map leave of that of a motion that they know. Where
that was less, motions that had begun at an odometry that is decimeters off were right to 30 mm, jumps were not."""
_OUTLYING = 6.0
_LEAST_SIGMA = np.repeat([np.radians(0.2), 0.02], 3)
"""rad and m: surfaces do not tell better how good the odometry is."""
_PRECISE = 2.0
MEDIAN_OF_NORM = 1.54
"""Of a normal distribution in three dimensions, with unit variance along each."""
_GROUP = 12
"""Scans that are solved together: enough to see a place from all sides, too few to drift."""
_CANDIDATES = CandidateConfig(drift=0.03, drift_deg=2.0, least_m=0.8, least_deg=2.0, pairs_per_part=6)
"""Groups are registered where they may be off by more than an odometry would be: so is what is mended here."""


_STEPS = ("wrong_after", "open_after", "left_after", "by_images")


@dataclass(frozen=True)
class RoughError:
    """How far rough poses are off that a bundle adjustment could not start from, and what is left of it.

    step_m, step_deg: of the motion from a scan to the next, typically, along each axis
    wrong_after: (J,) int64, scans after which it is off by far more
    open_after: (K,) int64, of these, and of all where every motion is off by decimeters, where surfaces neither determine
        it in every direction nor confirm that of the result
    left_after: (L,) int64, scans after which the result contradicts what both scans see
    by_images: (M,) int64, scans after which the motion that the bundle adjustment begins with is that of the images
    """

    step_m: float
    step_deg: float
    wrong_after: np.ndarray
    open_after: np.ndarray
    left_after: np.ndarray
    by_images: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))

    @staticmethod
    def of_jumps(config: LidarConfig) -> "RoughError":
        """Of poses whose motions are as good as the settings let expect, but for jumps that are not known yet."""
        none = np.zeros(0, np.int64)
        return RoughError(
            step_m=config.prior_translation,
            step_deg=float(np.degrees(config.prior_rotation)),
            wrong_after=none,
            open_after=none,
            left_after=none,
        )

    def with_open(self, after: Indices) -> "RoughError":
        """The same with jumps after scans (J,) int64 that surfaces do not tell of, not yet."""
        return replace(
            self,
            wrong_after=np.union1d(self.wrong_after, after),
            open_after=np.union1d(self.open_after, after),
        )

    def numbered(self, scans: np.ndarray) -> "RoughError":
        """The same with numbers of the whole. scans: (n,) int64, number of each scan in the whole"""
        after = {name: scans[getattr(self, name)] for name in _STEPS}
        return replace(self, **after)


def of_all(errors: Sequence[RoughError]) -> RoughError | None:
    """Of a recording whose parts have these; None: they have none."""
    if not errors:
        return None
    together = {name: np.unique(np.concatenate([getattr(each, name) for each in errors])) for name in _STEPS}
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

    def judged(
        self,
        patches: Sequence[Patch | None],
        rough: Poses,
        refined: Poses,
        dependence: np.ndarray | None = None,
    ) -> RoughError:
        """The error, with what is left of it in refined poses.

        patches: of `surfels_of`; rough, refined: (S, 4, 4)
        dependence: (S - 1,) float64, of the result, as `covariance.Covariance.odometry_dependence`; None or (0,): not
            known
        A motion that the scan alone left open is not, where surfaces of scans on both sides confirm that of the result,
        or planes of the whole map know it far better than the odometry.
        """
        expected, is_open = geometry.steps(rough), self.error.open_after
        jumps = np.intersect1d(is_open, self.error.wrong_after)
        if dependence is not None and len(dependence):
            is_open = np.union1d(jumps, is_open[dependence[is_open] > _KNOWN])
        # a jump is as many scans on both sides have it: these are no second witness
        sure = rough_motions.confirmed(patches, refined, jumps, expected, rough_motions.BESIDE)
        others = rough_motions.confirmed(patches, refined, np.setdiff1d(is_open, jumps), expected)
        return replace(
            self.error,
            open_after=np.setdiff1d(is_open, np.concatenate([sure, others])),
            left_after=rough_motions.contradicted(patches, refined),
        )


def odometry_of(
    rough: Poses, error: RoughError | None, world_from_scan: Poses, config: LidarConfig
) -> OdometryPrior:
    """What rough poses (S, 4, 4) still say of the motions from scan to scan.

    error: None: as much as the settings let expect; else their steps are as good as they proved to be, and those that are
        wrong are as poses (S, 4, 4) have them that came of surfaces, and say next to nothing; those of images are as
        these poses have them, too, and as good as the settings let expect
    """
    if error is None:
        return odometry_prior(rough, config.prior_rotation, config.prior_translation)
    rotation = max(config.prior_rotation, float(np.radians(error.step_deg)))
    prior = odometry_prior(rough, rotation, max(config.prior_translation, error.step_m))
    prior = with_jumps(prior, error.wrong_after, world_from_scan)
    return with_motions(
        prior, error.by_images, world_from_scan, config.prior_rotation, config.prior_translation
    )


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

    def of_scan(number: int) -> Patch | None:
        return scan_steps.surfels(thinned(scans[number], number), sensor)

    # one scan is too little for kernels to divide among threads
    return list(in_order(of_scan, range(len(scans)), parallel_kernels=True))


def start_if_contradicted(
    scans: Sequence[np.ndarray],
    patches: Sequence[Patch | None],
    world_from_scan: Poses,
    *,
    sensor_position: Vector | None = None,
    config: LidarConfig | None = None,
    progress: Progress = silent,
) -> StartPoses | None:
    """As `start`; None: surfaces have nothing against the rough poses."""
    if not len(rough_motions.contradicted(patches, world_from_scan)):
        return None
    return start(
        scans, patches, world_from_scan, sensor_position=sensor_position, config=config, progress=progress
    )


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
        if error is not None and odometry.precise and not odometry.wrong.any():
            break
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

    def closed(self, patches: Sequence[Patch | None], k: int) -> "_Chain":
        """The chain with step k as the scans on both sides of it have it together, where these determine it in all
        directions: one scan may slide along the surfaces of those before it.

        Where only many do, they may be wrong: the step is as they have it, and counts as open.
        """
        motion, own = geometry.steps(self.world_from_scan[k : k + 2])[0], self.steps[k]
        for scans in (rough_motions.BESIDE, rough_motions.MANY):
            pair = rough_motions.beside(patches, self.world_from_scan, k, scans)
            if pair is None:
                continue
            step = scan_steps.register(Target.of(pair[0]), pair[1], motion)
            if own is not None and not own.open and not rough_motions.apart(motion, step.first_from_second):
                return self
            if step.aligned and not step.open:
                return self._with(k, step if scans == rough_motions.BESIDE else replace(step, open=1))
        return self

    def _with(self, k: int, step: Step) -> "_Chain":
        """The chain with another step k."""
        poses, steps, information = self.world_from_scan.copy(), list(self.steps), self.information.copy()
        poses[k + 1 :] = poses[k] @ step.first_from_second @ geometry.inverse(poses[k + 1]) @ poses[k + 1 :]
        steps[k], information[k] = step, JUMP + step.information
        return _Chain(poses, steps, information)


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
            steps.append(rough_motions.registered(patches, world_from_scan, k))
        off = np.array(
            [
                each.correction(motion) if each is not None else np.zeros(6)
                for each, motion in zip(steps, rough, strict=True)
            ]
        )
        size = np.linalg.norm(off.reshape(-1, 2, 3), axis=2)
        aligned = np.array([each is not None and each.aligned for each in steps])
        typical = np.median(size[aligned], axis=0) / MEDIAN_OF_NORM if aligned.any() else np.zeros(2)
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
        chain = _Chain(np.array(poses), steps, np.array(information).reshape(-1, 6, 6))
        for wrong in np.flatnonzero(self.wrong):
            chain = chain.closed(patches, int(wrong))
        return chain


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
