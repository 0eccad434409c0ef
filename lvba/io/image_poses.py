"""What image_poses.txt holds: poses of the camera, or of the body that carries it. Inside lvba all are of the camera.

FAST-LIVO2 writes the pose of its body (the IMU) at the time of each image, and Global-LVBA reads it so; other tools write
the camera's (x right, y down, z forward). The scan poses tell which: an image pose is near B(t), the body's pose at its
time, or near B(t) body_from_camera. Where the extrinsic is too small to tell by, the file itself (its comment) or
config.yaml says it (`image_poses: body|camera`), and else it is the body, as in FAST-LIVO2's folders.
Source: FAST-LIVO2, src/LIVMapper.cpp (`_state.pos_end`, `_state.rot_end`); Global-LVBA, src/lvba_system.cpp.
"""

import dataclasses
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from lvba import geometry
from lvba.arrays import Pose, Poses
from lvba.dataset import BODY, CAMERA, Dataset
from lvba.errors import InputError
from lvba.io import pose_readings
from lvba.trajectory import Trajectory, align, bracket

KINDS = (CAMERA, BODY)
KEY = "image_poses"

MAX_LEFT_DEG = 10.0
"""Degrees (median) that image poses may be off the scan poses: beyond, it is another convention, and no roughness."""
_WARN_M = 1.0
_SMALL_DEG, _SMALL_M = 5.0, 0.05
"""An extrinsic below both is small: there what the file or config.yaml says counts for more than the data."""
_SIGMAS = 3.0
"""By how many times the uncertainty of the image poses' middle the two readings must differ for the data to tell."""
_SIGMAS_OF_FOREIGN = 2.0
"""The same where the extrinsic itself is uncertain: that uncertainty is no noise that images would share by chance."""
_NEARER = 0.5
"""The nearer reading must be at most this part of the other's distance away."""
_LEAST = (0.05, 1e-3)
"""Degrees and m that poses on file cannot show."""
FOREIGN_EXTRINSIC = (0.5, 0.01)
"""Standard deviation of the extrinsic, degrees and m, for poses that were not made with the calibration of the
recording, such as a reference's: an odometry uses the very calibration that is in config.yaml, truth does not."""
_SAME_FRAME_S = 1e-3
_NEAR_SCAN_S, _NEAR_SCANS_S, _NEAR_SCANS_DEG = 0.1, 2.0, 45.0
"""Between scans further apart the body may have been anywhere, unless the image is so near to one of them."""

_STATED = re.compile(r"\bimage_poses: *(body|camera)\b")
_COMMENTS = {
    CAMERA: "image_poses: camera - camera to world, x right, y down, z forward: t tx ty tz qx qy qz qw",
    BODY: "image_poses: body - body (the scans' frame) to world at the time of each image: t tx ty tz qx qy qz qw",
}


@dataclass(frozen=True)
class Reading:
    """What a file's poses are of, why that was taken, and what the user should know, a sentence each."""

    kind: str
    reason: str
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Statement:
    """What a file or setting says its poses are of ("" if nothing does), and which one says so."""

    kind: str = ""
    where: str = ""


def comment(kind: str) -> str:
    """The first line of a file of such poses, without '#'."""
    return _COMMENTS[kind]


def stated(comments: Iterable[str]) -> str:
    """What a pose file says itself that it holds, in its comments; "" if it does not."""
    return next((match[1] for line in comments if (match := _STATED.search(line))), "")


def to_camera(poses: Poses, kind: str, camera_from_body: Pose) -> np.ndarray:
    """world_from_camera (N, 4, 4) of poses (N, 4, 4) of a kind."""
    return poses @ geometry.inverse(camera_from_body) if kind == BODY else poses


def from_camera(world_from_camera: Poses, kind: str, camera_from_body: Pose) -> np.ndarray:
    """Poses (N, 4, 4) of a kind, of cameras (N, 4, 4)."""
    return world_from_camera @ camera_from_body if kind == BODY else world_from_camera


def decide(
    poses: Trajectory,
    scans: Trajectory,
    camera_from_body: Pose,
    statement: Statement,
    where: object,
    default: str = BODY,
    extrinsic_sigma: tuple[float, float] = (0.0, 0.0),
) -> Reading:
    """What the poses are of, decided by the scan poses in the same world: by images near to scans, where there are any.

    camera_from_body: (4, 4), the calibrated extrinsic; extrinsic_sigma: degrees and m by which that of
        these poses may differ
    statement, default: what decides where the extrinsic is too small to tell
    where: names the file in errors
    Raises: InputError if more than `MAX_LEFT_DEG` are left either way, of images near to scans.
    """
    times = poses.times
    inside = (times >= scans.times[0]) & (times <= scans.times[-1])
    if not inside.any():
        reason = "no image lies between two scans, so nothing can be compared"
        return _undecided(statement, default, reason, where)
    near = inside & _near_scans(scans, times)
    compared = near if near.any() else inside
    carriers, sensors = _carriers(scans, times[compared]), poses.world_from_sensor[compared]
    extrinsic = geometry.inverse(camera_from_body)
    evidence = _Evidence.of(
        _errors(carriers, sensors), _errors(carriers @ extrinsic, sensors), extrinsic, extrinsic_sigma
    )
    if not near.any():
        # what interpolation misses is no noise that many images would average out, and nobody's mistake
        return _judge(dataclasses.replace(evidence, images=1), statement, default, where)
    reading = _judge(evidence, statement, default, where)
    left_deg, left_m = evidence.left[reading.kind]
    if left_deg > MAX_LEFT_DEG:
        raise InputError(
            where,
            f"image poses and scan poses disagree by {_size(*evidence.left[CAMERA])} (medians) if these are the camera's "
            f"poses, and by {_size(*evidence.left[BODY])} if they are the body's",
            _mend(carriers, sensors, extrinsic),
        )
    if left_m <= _WARN_M:
        return reading
    words = (
        f"{where}: image poses and scan poses disagree by {_size(left_deg, left_m)} (medians) under Rcl, Pcl: check that "
        "X_camera = Rcl X_lidar + Pcl, and that both are in one world frame."
    )
    return dataclasses.replace(reading, warnings=(*reading.warnings, words))


def decide_beside(images: Trajectory, dataset: Dataset, statement: Statement) -> Reading:
    """What poses in a world of their own are of: by which kind they can be laid over the recording's cameras.

    What neither tells is what the recording's own file holds.
    """
    nearest = np.abs(dataset.images.times[:, None] - images.times).argmin(1)
    same = np.abs(images.times[nearest] - dataset.images.times) <= _SAME_FRAME_S
    if np.count_nonzero(same) < 2:
        return Reading(statement.kind or dataset.image_poses, "no image of the recording has the same time")
    extrinsic = geometry.inverse(dataset.camera_from_scan)
    cameras = dataset.images.world_from_sensor[same]
    given = images.world_from_sensor[nearest[same]]
    errors = {}
    for kind, sensors in ((BODY, cameras @ dataset.camera_from_scan), (CAMERA, cameras)):
        errors[kind] = _errors(align(sensors, given) @ sensors, given)
    evidence = _Evidence.of(errors[BODY], errors[CAMERA], extrinsic, FOREIGN_EXTRINSIC)
    return _judge(evidence, statement, dataset.image_poses, "the reference")


@dataclass(frozen=True)
class _Evidence:
    """How far poses are from what each kind makes of the scan poses: (degrees, meters) each.

    center: of the middle of all images; left: median over images; scatter: median about the middle; extrinsic:
    how far the two kinds are apart; extrinsic_sigma: how uncertain that is
    """

    center: dict[str, tuple[float, float]]
    left: dict[str, tuple[float, float]]
    scatter: tuple[float, float]
    extrinsic: tuple[float, float]
    extrinsic_sigma: tuple[float, float]
    images: int

    @classmethod
    def of(
        cls,
        as_body: np.ndarray,
        as_camera: np.ndarray,
        extrinsic: np.ndarray,
        extrinsic_sigma: tuple[float, float],
    ) -> "_Evidence":
        """From the errors (N, 4, 4) of all images if they are the body's, and if they are the camera's."""
        middle = {BODY: _middle(as_body), CAMERA: _middle(as_camera)}
        about = [
            _median(geometry.inverse(middle[kind]) @ errors)
            for kind, errors in ((BODY, as_body), (CAMERA, as_camera))
        ]
        return cls(
            {kind: _median(center[None]) for kind, center in middle.items()},
            {BODY: _median(as_body), CAMERA: _median(as_camera)},
            (min(about)[0], min(about)[1]),
            _median(extrinsic[None]),
            extrinsic_sigma,
            len(as_body),
        )

    @property
    def nearer(self) -> str:
        """The kind that the data speak for, or "" where both are about as near."""
        # errors of neighbors hang together: n images tell no more than about sqrt(n) independent ones
        few = self.images**0.25
        scale = [
            max(np.hypot(scatter / few, sigma), least)
            for scatter, sigma, least in zip(self.scatter, self.extrinsic_sigma, _LEAST, strict=True)
        ]

        def distance(size: tuple[float, float]) -> float:
            return float(np.hypot(size[0] / scale[0], size[1] / scale[1]))

        near, far = sorted(KINDS, key=lambda kind: distance(self.center[kind]))
        clear = distance(self.center[near]) <= _NEARER * distance(self.center[far])
        enough = _SIGMAS if not any(self.extrinsic_sigma) else _SIGMAS_OF_FOREIGN
        return near if clear and distance(self.extrinsic) >= enough else ""

    @property
    def same(self) -> bool:
        """Whether the two kinds hardly differ."""
        return self.extrinsic[0] < _LEAST[0] and self.extrinsic[1] < _LEAST[1]

    @property
    def small(self) -> bool:
        """Whether the extrinsic is small."""
        return self.extrinsic[0] < _SMALL_DEG and self.extrinsic[1] < _SMALL_M


def _judge(evidence: _Evidence, statement: Statement, default: str, where: object) -> Reading:
    nearer = evidence.nearer
    if evidence.same:
        return Reading(
            statement.kind or default, "body and camera are the same within what the poses can show"
        )
    if statement.kind and (evidence.small or not nearer):
        return Reading(statement.kind, f"{statement.where} says so")
    if not nearer:
        size = _size(*evidence.extrinsic)
        reason = f"the extrinsic ({size}) is too small, or the poses too rough, to tell by the scan poses"
        return _undecided(statement, default, reason, where)
    other = BODY if nearer == CAMERA else CAMERA
    reason = (
        f"as poses of the {nearer} they are {_size(*evidence.center[nearer])} from where the scan poses put it, "
        f"as poses of the {other} {_size(*evidence.center[other])}"
    )
    if statement.kind in ("", nearer):
        return Reading(nearer, reason)
    against = f"{where}: {statement.where} says image_poses: {statement.kind}, but {reason}: taken as the {nearer}'s."
    return Reading(nearer, reason, (against,))


def _undecided(statement: Statement, default: str, reason: str, where: object) -> Reading:
    if statement.kind:
        return Reading(statement.kind, f"{statement.where} says so")
    words = (
        f"{where}: image poses are taken for the {default}'s, for {reason}: "
        f"say `{KEY}: body` (or `camera`) in config.yaml."
    )
    return Reading(default, reason, (words,))


def _carriers(scans: Trajectory, times: np.ndarray) -> np.ndarray:
    """World from body at other times, (N, 4, 4)."""
    before, fraction = bracket(scans.times, times)
    after = np.minimum(before + 1, len(scans) - 1)
    return geometry.interpolate(scans.world_from_sensor[before], scans.world_from_sensor[after], fraction)


def _near_scans(scans: Trajectory, times: np.ndarray) -> np.ndarray:
    """(N,) bool: times at which interpolated scan poses tell where the body is."""
    before, fraction = bracket(scans.times, times)
    after = np.minimum(before + 1, len(scans) - 1)
    gap = scans.times[after] - scans.times[before]
    world_from_body = scans.world_from_sensor
    turn = geometry.rotation_angle_deg(geometry.inverse(world_from_body[before]) @ world_from_body[after])
    at_scan = gap * np.minimum(fraction, 1 - fraction) <= _NEAR_SCAN_S
    return np.asarray(at_scan | ((gap <= _NEAR_SCANS_S) & (turn <= _NEAR_SCANS_DEG)))


def _errors(expected: np.ndarray, poses: np.ndarray) -> np.ndarray:
    return np.asarray(geometry.inverse(expected) @ poses)


def _middle(transforms: np.ndarray) -> np.ndarray:
    """The (4, 4) transform of medians, element by element, made a rotation again."""
    rotation = geometry.closest_rotation(np.median(transforms[:, :3, :3], axis=0))
    return geometry.from_rotation_translation(rotation, np.median(transforms[:, :3, 3], axis=0))


def _median(transforms: np.ndarray) -> tuple[float, float]:
    """Median angle (degrees) and median length (m) of (N, 4, 4) transforms."""
    lengths = np.linalg.norm(transforms[:, :3, 3], axis=1)
    return float(np.median(geometry.rotation_angle_deg(transforms))), float(np.median(lengths))


def _size(degrees: float, meters: float) -> str:
    length = f"{meters:.2f} m" if meters >= 1 else f"{100 * meters:.1f} cm"
    return f"{degrees:.1f} degrees and {length}"


_MISTAKES: tuple[tuple[str, Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]], ...] = (
    (
        "the quaternions seem to be written w first: write qx qy qz qw",
        lambda poses, extrinsic: (pose_readings.w_first(poses), extrinsic),
    ),
    (
        "the poses seem to be world to camera or body: write their inverse",
        lambda poses, extrinsic: (geometry.inverse(poses), extrinsic),
    ),
    (
        "Rcl and Pcl seem to be LiDAR from camera: write the inverse, X_camera = Rcl X_lidar + Pcl",
        lambda poses, extrinsic: (poses, geometry.inverse(extrinsic)),
    ),
)
"""What is often mixed up, and the poses and extrinsic that would be right then."""


def _mend(carriers: np.ndarray, poses: np.ndarray, extrinsic: np.ndarray) -> str:
    """What to do: the mistake that explains best what is left, where one does."""
    explained = []
    for words, mended in _MISTAKES:
        right, place = mended(poses, extrinsic)
        for expected in (carriers, carriers @ place):
            left_deg, left_m = _median(_errors(expected, right))
            explained.append((left_deg / MAX_LEFT_DEG + left_m / _WARN_M, words))
    least, words = min(explained)
    if least <= 1:
        return words
    return (
        "check that X_camera = Rcl X_lidar + Pcl and X_body = extrinsic_R X_lidar + extrinsic_T, and that image poses "
        "are body to world, or camera to world with z forward"
    )
