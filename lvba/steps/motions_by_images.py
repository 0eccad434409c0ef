"""Scans that planes leave to the odometry, where features of images contradict it: laid out anew by these.

A narrow LiDAR or a depth camera that turns sees one wall, and then another one: only the odometry knows how the scans are
to each other. Where that is decimeters off, the bundle adjustment ends as far off, with planes that are put together
wrongly, which look certain. Images about these moments often show the same texture. Where they contradict the result,
motions of all successive images, as far as features tell them, and of the odometry become one trajectory (a pose graph),
and the bundle adjustment begins there once more.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lvba import geometry, trajectory
from lvba.arrays import Indices, Poses, Vector
from lvba.dataset import Dataset
from lvba.lidar.config import LidarConfig
from lvba.lidar.odometry_factor import OdometryPrior, with_motions
from lvba.loop_closure import rough_poses
from lvba.loop_closure.rough_poses import RoughError, StartPoses
from lvba.loop_closure.submap import Patch
from lvba.optim import pose_graph
from lvba.optim.pose_graph import Edges
from lvba.steps import features_on_scans
from lvba.trajectory import Trajectory
from lvba.visual import relocalization
from lvba.visual.relocalization import Matcher

_log = logging.getLogger(__name__)

_OPEN = 0.5
"""Of the odometry's standard deviation of a motion, what planes leave where they hardly tell of it."""
_SCANS = 2
"""The nearest in time, on whose surfels features of an image are."""
_FARTHEST_M = 1.0
"""The odometry is not off by more from one image to the next."""
_SAME_M, _SAME_DEG = 0.05, 1.0
"""Motions by places that either of two images sees agree if they differ by no more: each is right to 1 cm, mostly."""
_FEWEST = 12
"""Features of which each has that many: chance brings five."""
_ENOUGH_ALONE = 60
"""Features by which one of them is enough."""
_LEAST_M, _FAR_M = 0.1, 0.2
"""Two motions that go by so much elsewhere than images say contradict them, or one by so much. Turns do not: images are
taken between scans that may be a second apart, and of a sensor that begins to turn meanwhile, right poses seem to be
degrees off; of rooms with right poses, motions seemed to go 8 cm elsewhere at most."""
_SIGMA, _OF_PATH = np.repeat([np.radians(0.3), 0.02], 3), 0.03
"""rad and m, of a motion by features, and the part of its length that scans off their place make of it."""
_FIRM = float(np.radians(0.2)), 0.01
"""The same of a motion that planes determine, though not all of them are right."""
_BETWEEN = np.repeat([np.radians(1.0), 0.02], 3)
"""rad and m, of a pose in the middle between two scans."""
_NOTHING = 1e-4
"""rad and m: no motion is known better."""
_HALF = 0.5
_MOST = 4.0
"""Standard deviations at which a motion counts as far off as any that goes elsewhere by more."""


@dataclass(frozen=True)
class ImageMotions:
    """How the LiDAR moved from one image to a later one, by their features.

    first, second: (E,) int64, images; first_from_second: (E, 4, 4) float64
    """

    first: np.ndarray
    second: np.ndarray
    first_from_second: np.ndarray

    def __len__(self) -> int:
        return len(self.first)

    @staticmethod
    def together(parts: Sequence["ImageMotions"]) -> "ImageMotions":
        """Those of all."""
        names = ("first", "second", "first_from_second")
        return ImageMotions(*(np.concatenate([getattr(each, name) for each in parts]) for name in names))

    def off(self, dataset: Dataset, world_from_scan: Poses) -> np.ndarray:
        """(E, 6), rad and m: how far the motions of scans at poses (S, 4, 4) are from these."""
        path = Trajectory(dataset.scans.times, world_from_scan)
        at = [trajectory.sample(path, dataset.images.times[each]) for each in (self.first, self.second)]
        return np.asarray(
            geometry.log(geometry.inverse(self.first_from_second) @ geometry.inverse(at[0]) @ at[1])
        )

    def contradicting(self, dataset: Dataset, world_from_scan: Poses) -> int:
        """How many of these motions poses (S, 4, 4) are too far from for chance."""
        shift = np.linalg.norm(self.off(dataset, world_from_scan)[:, 3:], axis=1)
        return int(np.count_nonzero(shift > _LEAST_M))

    def cost(self, dataset: Dataset, world_from_scan: Poses) -> float:
        """How far from these motions of poses (S, 4, 4) go: squares over variances, bounded."""
        shift = np.linalg.norm(self.off(dataset, world_from_scan)[:, 3:], axis=1)
        sigma = np.hypot(_BETWEEN[3], 1.0 / np.sqrt(self.information[:, 3, 3]))
        return float(np.minimum((shift / sigma) ** 2, _MOST**2).sum())

    @property
    def information(self) -> np.ndarray:
        """(E, 6, 6) float64, of the local tangent at the second image."""
        length = np.linalg.norm(self.first_from_second[:, :3, 3], axis=1)
        sigma = np.hypot(_SIGMA, np.outer(_OF_PATH * length, np.repeat([0.0, 1.0], 3)))
        return np.asarray(np.eye(6) / sigma[:, None] ** 2)


@dataclass(frozen=True)
class LaidOut:
    """Where the bundle adjustment begins, and the motions of images that speak for it."""

    start: StartPoses
    motions: ImageMotions

    def fits_better(self, dataset: Dataset, one: Poses, other: Poses) -> bool:
        """Whether images contradict poses (S, 4, 4) less than others (S, 4, 4): fewer motions do, and all together less.

        A motion by false features contradicts both, and a layout by it may lead anywhere: where it did, planes ended 18
        and 183 mm off, and the cost of all motions differed by a twentieth.
        """
        fewer = self.motions.contradicting(dataset, one) < self.motions.contradicting(dataset, other)
        return fewer and self.motions.cost(dataset, one) < self.motions.cost(dataset, other)


def laid_out(
    dataset: Dataset,
    patches: Sequence[Patch | None],
    world_from_scan: Poses,
    dependence: Vector,
    begin: StartPoses | None,
    config: LidarConfig,
) -> LaidOut | None:
    """The scans by features of the images and the odometry; None: images have nothing against the result.

    dataset: of these scans; patches: surfels of each; world_from_scan: (S, 4, 4) float64, the result
    dependence: (S - 1,) float64, of it, as `covariance.Covariance.odometry_dependence`
    begin: where it began; None: at the rough poses
    Raises InputError: an image cannot be read.
    """
    left = np.flatnonzero(dependence > _OPEN)
    images = _images(dataset)
    if not len(left) or len(images) < 2:
        return None
    about = _about(dataset, images, left)
    features = _Features.of(dataset, patches, world_from_scan, images)
    seen = features.motions(np.flatnonzero(about))
    if not _contradicted(seen.off(dataset, world_from_scan)):
        return None
    motions = ImageMotions.together([seen, features.motions(np.flatnonzero(~about))])
    firm = np.setdiff1d(np.arange(len(dependence)), left)
    return LaidOut(_start(dataset, world_from_scan, firm, motions, begin, config), motions)


def _contradicted(off: np.ndarray) -> bool:
    """Whether motions that are off by (E, 6), rad and m, contradict the images."""
    shift = np.linalg.norm(off[:, 3:], axis=1)
    return bool(np.count_nonzero(shift > _LEAST_M) > 1 or (shift > _FAR_M).any())


def _images(dataset: Dataset) -> np.ndarray:
    """(I,) int64, ascending: about as many as there are scans, taken between the first and the last of these."""
    scans, times = dataset.scans.times, dataset.images.times
    inside = np.flatnonzero((times >= scans[0]) & (times <= scans[-1]))
    if not len(inside):
        return inside
    wanted = np.concatenate([scans, 0.5 * (scans[1:] + scans[:-1])])
    nearest = np.unique(trajectory.nearest_in_time(times[inside], wanted))
    return np.asarray(inside[nearest])


def _about(dataset: Dataset, images: Indices, steps: Indices) -> np.ndarray:
    """(I - 1,) bool: after which of images (I,) a pair begins that was taken about motions (n,) of scans to the next."""
    scans, times = dataset.scans.times, dataset.images.times[images]
    begin = np.searchsorted(times[1:], scans[steps], side="right")
    end = np.searchsorted(times[:-1], scans[steps + 1], side="left")
    return _inside(begin, end, len(images) - 1)


def _inside(begin: Indices, end: Indices, count: int) -> np.ndarray:
    """(count,) bool: which numbers are in one of the half-open ranges from begin (n,) to end (n,)."""
    marks = np.zeros(count + 1, np.int64)
    np.add.at(marks, begin, 1)
    np.add.at(marks, end, -1)
    return np.asarray(np.cumsum(marks)[:-1] > 0)


@dataclass(frozen=True)
class _Features:
    """Of successive images (I,) int64, with places on the scans about them; cameras: (I, 4, 4), by these scans."""

    images: np.ndarray
    cameras: np.ndarray
    camera_from_scan: np.ndarray
    matcher: Matcher

    @staticmethod
    def of(
        dataset: Dataset, patches: Sequence[Patch | None], world_from_scan: Poses, images: Indices
    ) -> "_Features":
        path = Trajectory(dataset.scans.times, world_from_scan)
        scan_from_camera = geometry.inverse(dataset.camera_from_scan)
        cameras = trajectory.sample(path, dataset.images.times[images]) @ scan_from_camera
        scans = np.arange(len(world_from_scan))

        def scans_of(index: int) -> np.ndarray:
            return features_on_scans.nearest_scans(dataset, int(images[index]), scans, _SCANS)

        matcher = features_on_scans.matcher(dataset, patches, world_from_scan, images, cameras, scans_of)
        return _Features(images, cameras, dataset.camera_from_scan, matcher)

    def motions(self, places: Indices) -> ImageMotions:
        """From images at places (n,) int64 to the next ones, as far as features tell them."""
        motions = [_motion(self.matcher, int(place), int(place) + 1, self.cameras) for place in places]
        known = places[np.array([motion is not None for motion in motions], bool)]
        apart = np.array([motion for motion in motions if motion is not None]).reshape(-1, 4, 4)
        scan_from_camera = geometry.inverse(self.camera_from_scan)
        return ImageMotions(
            self.images[known], self.images[known + 1], scan_from_camera @ apart @ self.camera_from_scan
        )


def _motion(matcher: Matcher, first: int, second: int, cameras: Poses) -> np.ndarray | None:
    """(4, 4), first from second, of two cameras, by places that each of them sees; None: features do not tell."""
    motions, features = [], []
    for known, new in ((first, second), (second, first)):
        by_features = matcher.pose(new, np.array([known]), cameras, _FARTHEST_M, _FEWEST)
        if by_features is not None:
            motion = geometry.inverse(cameras[known]) @ by_features[0]
            motions.append(motion if known == first else geometry.inverse(motion))
            features.append(by_features[1])
    if len(motions) < 2:
        return motions[0] if motions and features[0] >= _ENOUGH_ALONE else None
    meters, degrees = relocalization.apart(motions[0], motions[1])
    if meters > _SAME_M or degrees > _SAME_DEG:
        return None
    return np.asarray(geometry.interpolate(motions[0], motions[1], np.array(features[1] / sum(features))))


def _start(
    dataset: Dataset,
    world_from_scan: Poses,
    firm: Indices,
    motions: ImageMotions,
    begin: StartPoses | None,
    config: LidarConfig,
) -> StartPoses:
    """Where the bundle adjustment begins: by the odometry, motions of images, and those of the result that are firm.

    firm: (F,) int64, scans after which planes determine the motion
    """
    rough = dataset.scans.world_from_sensor
    off = np.linalg.norm(motions.off(dataset, rough).reshape(-1, 2, 3), axis=2)
    turn, shift = np.median(off, axis=0) / rough_poses.MEDIAN_OF_NORM
    error = RoughError.of_jumps(config) if begin is None else begin.error
    error = replace(
        error,
        step_m=max(error.step_m, float(shift)),
        step_deg=max(error.step_deg, float(np.degrees(turn))),
        by_images=np.zeros(0, np.int64),  # what they told of an earlier result is no odometry
    )
    odometry = rough_poses.odometry_of(
        rough, error, rough if begin is None else begin.world_from_scan, config
    )
    odometry = with_motions(odometry, firm, world_from_scan, *_FIRM)
    poses, known = _solved(dataset, world_from_scan, odometry, motions)
    _log.info(
        "images lay out %d of %d motions of scans; the odometry is off by %.3f m a step",
        len(known), len(rough) - 1, shift,
    )  # fmt: skip
    # what images tell is neither wrong nor open any more
    wrong, left = (np.setdiff1d(each, known) for each in (error.wrong_after, error.open_after))
    return StartPoses(poses, replace(error, wrong_after=wrong, open_after=left, by_images=known))


def _solved(
    dataset: Dataset, world_from_scan: Poses, odometry: OdometryPrior, motions: ImageMotions
) -> tuple[np.ndarray, np.ndarray]:
    """Poses (S, 4, 4) of the scans, the first as in the recording, and scans (K,) int64 after which images tell the
    motion."""
    numbers = np.unique(np.concatenate([motions.first, motions.second]))
    times = np.concatenate([dataset.scans.times, dataset.images.times[numbers]])
    order = np.argsort(times, kind="stable")
    node = np.empty(len(order), np.int64)
    node[order] = np.arange(len(order))
    scans, images = node[: len(world_from_scan)], node[len(world_from_scan) :]
    begin = np.concatenate(
        [
            world_from_scan,
            trajectory.sample(
                Trajectory(dataset.scans.times, world_from_scan), times[len(world_from_scan) :]
            ),
        ]
    )[order]
    first, second = (images[np.searchsorted(numbers, each)] for each in (motions.first, motions.second))
    seen = Edges(
        first=first,
        second=second,
        first_from_second=motions.first_from_second,
        information=motions.information,
        is_loop=np.zeros(len(motions), bool),
    )
    graph = pose_graph.solve(begin, pose_graph.concatenate([_chain(times[order], scans, odometry), seen]))
    poses = graph.world_from_node[scans]
    # where it began in the recording
    poses = dataset.scans.world_from_sensor[0] @ geometry.inverse(poses[0]) @ poses
    poses[0] = dataset.scans.world_from_sensor[0]
    return poses, _covered(times[order], scans, first, second)


def _chain(times: Vector, scans: Indices, odometry: OdometryPrior) -> Edges:
    """The odometry's motions from node to node at times (N,), s, ascending. scans: (S,) int64, nodes"""
    earlier = np.arange(len(times) - 1)
    step = np.searchsorted(scans, earlier, side="right") - 1
    fraction = np.diff(times) / np.diff(times[scans])[step]
    still = np.broadcast_to(np.eye(4), (len(earlier), 4, 4))
    motion = geometry.interpolate(still, odometry.previous_from_next[step], fraction)
    covariance = fraction[:, None, None] * pose_graph.information_of(odometry.information)[step]
    along = trajectory.bracket(times[scans], times)[1]
    interpolated = (4.0 * along * (1.0 - along)) ** 2
    covariance += (interpolated[:-1] + interpolated[1:])[:, None, None] * np.diag(_BETWEEN**2)
    covariance += _NOTHING**2 * np.eye(6)
    information = pose_graph.information_of(covariance)
    # by how much the sensor turned from scan to scan is known better than when
    turns = odometry.information.copy()
    turns[:, 3:] = turns[:, :, 3:] = 0.0
    return Edges(
        first=np.concatenate([earlier, scans[:-1]]),
        second=np.concatenate([earlier + 1, scans[1:]]),
        first_from_second=np.concatenate([motion, odometry.previous_from_next]),
        information=np.concatenate([information, turns]),
        is_loop=np.zeros(len(earlier) + len(turns), bool),
    )


def _covered(times: Vector, scans: Indices, first: Indices, second: Indices) -> np.ndarray:
    """(K,) int64: of scans at nodes (S,), those after which motions from nodes (E,) to later ones (E,) tell half of the
    motion to the next, or more. times: (N,) float64, s, of the nodes"""
    inside = _inside(first, second, len(times) - 1)
    covered = np.concatenate([[0.0], np.cumsum(np.diff(times) * inside)])
    return np.flatnonzero(np.diff(covered[scans]) >= _HALF * np.diff(times[scans]))
