"""Poses, inertial readings and positions from the messages of nav_msgs, geometry_msgs, tf2_msgs and sensor_msgs."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from lvba import geometry
from lvba.arrays import Pose
from lvba.sources.bags.definitions import Undecodable
from lvba.sources.source import GnssFix, ImuSample, PathSample, PoseSample, TransformSample

_NANO = 1_000_000_000


def stamp_of(values: dict[str, Any], prefix: str = "header.") -> int:
    """ns, of a header."""
    return int(values[f"{prefix}stamp.sec"]) * _NANO + int(values[f"{prefix}stamp.nanosec"])


def frame_of(values: dict[str, Any], name: str = "header.frame_id") -> str:
    """A frame without the slash that old bags have before it."""
    return str(values[name]).lstrip("/")


def pose(values: dict[str, Any], prefix: str) -> Pose:
    """(4, 4) float64 of the pose whose numbers' names begin so; m.

    Raises Undecodable: a number is none, or the quaternion has no length.
    """
    move, turn = (
        ("translation", "rotation") if f"{prefix}rotation.w" in values else ("position", "orientation")
    )
    numbers = [values[f"{prefix}{move}.{axis}"] for axis in "xyz"]
    numbers += [values[f"{prefix}{turn}.{axis}"] for axis in "xyzw"]
    return np.asarray(poses(np.array([numbers]))[0])


def poses(rows: np.ndarray) -> np.ndarray:
    """(N, 4, 4) float64, m. rows: (N, 7) float64, position in m and quaternion x y z w

    Raises Undecodable: a number is none, or a quaternion has no length.
    """
    x, y, z, w = rows[:, 3:].T
    with np.errstate(over="ignore", invalid="ignore"):
        square = x * x + y * y + z * z + w * w
    if not np.isfinite(rows).all() or not np.isfinite(square).all() or (square < 1e-6).any():
        raise Undecodable("a pose of it has no orientation, or values that are not finite numbers")
    return geometry.from_quaternion_translation(rows[:, 3:], rows[:, :3])


def odometry(values: dict[str, Any], stamp: int, frame: str) -> Iterator[PoseSample]:
    """Of a nav_msgs/Odometry. stamp: ns"""
    yield PoseSample(stamp, frame, frame_of(values, "child_frame_id"), pose(values, "pose.pose."))


def pose_stamped(values: dict[str, Any], stamp: int, frame: str) -> Iterator[PoseSample]:
    """Of a geometry_msgs/PoseStamped. stamp: ns"""
    yield PoseSample(stamp, frame, "", pose(values, "pose."))


def pose_with_covariance(values: dict[str, Any], stamp: int, frame: str) -> Iterator[PoseSample]:
    """Of a geometry_msgs/PoseWithCovarianceStamped. stamp: ns"""
    yield PoseSample(stamp, frame, "", pose(values, "pose.pose."))


def transform(values: dict[str, Any], stamp: int, frame: str) -> Iterator[PoseSample]:
    """Of a geometry_msgs/TransformStamped in a topic of its own, as motion capture writes it. stamp: ns"""
    yield PoseSample(stamp, frame, frame_of(values, "child_frame_id"), pose(values, "transform."))


def tree(values: dict[str, Any], *, static: bool) -> Iterator[TransformSample]:
    """Of a tf2_msgs/TFMessage; static: its topic is tf_static.

    Raises Undecodable: a transform is none; after all others.
    """
    damaged = None
    for each in values["transforms"]:
        parent, child = frame_of(each), frame_of(each, "child_frame_id")
        try:
            parent_from_child = pose(each, "transform.")
        except Undecodable:
            damaged = Undecodable(
                f"the transform {parent[:40]} <- {child[:40]} has no orientation, or numbers that are none"
            )
            continue
        yield TransformSample(stamp_of(each), parent, child, parent_from_child, static)
    if damaged is not None:
        raise damaged


def path(values: dict[str, Any], stamp: int, frame: str) -> Iterator[PathSample]:
    """Of a nav_msgs/Path. stamp: ns

    Raises Undecodable: it has no poses, or one that is none.
    """
    if not len(values["poses"]):
        raise Undecodable("it has no poses")
    names = [f"pose.position.{axis}" for axis in "xyz"] + [f"pose.orientation.{axis}" for axis in "xyzw"]
    seconds, nanoseconds, *columns = (
        _column(values["poses"], name) for name in ("header.stamp.sec", "header.stamp.nanosec", *names)
    )
    times = seconds.astype(np.int64) * _NANO + nanoseconds.astype(np.int64)
    rows = np.stack(columns, axis=1).astype(float)
    yield PathSample(stamp, frame, times, poses(rows))


def _column(messages: Any, name: str) -> np.ndarray:
    return np.array([each[name] for each in messages]) if isinstance(messages, list) else messages[name]


def imu(values: dict[str, Any], stamp: int, frame: str) -> Iterator[ImuSample]:
    """Of a sensor_msgs/Imu. stamp: ns"""
    gyroscope, accelerometer = (
        np.array([values[f"{name}.{axis}"] for axis in "xyz"], float)
        for name in ("angular_velocity", "linear_acceleration")
    )
    yield ImuSample(stamp, frame, gyroscope, accelerometer)


def fix(values: dict[str, Any], stamp: int, frame: str) -> Iterator[GnssFix]:
    """Of a sensor_msgs/NavSatFix. stamp: ns

    Raises Undecodable: it says that there is a fix, but not where.
    """
    status = int(values["status.status"])
    latitude, longitude, altitude = (float(values[name]) for name in ("latitude", "longitude", "altitude"))
    if status >= 0 and not np.isfinite([latitude, longitude]).all():
        raise Undecodable("a position of it has values that are not finite numbers")
    known = values["position_covariance_type"] != 0
    covariance = np.array(values["position_covariance"], float).reshape(3, 3) if known else None
    yield GnssFix(
        stamp=stamp,
        frame=frame,
        latitude=latitude,
        longitude=longitude,
        altitude=altitude,
        covariance=covariance,
        status=status,
    )
