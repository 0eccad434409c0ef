"""What bags and folders of other programs are read as: streams of records in one order, with the clocks of their drivers.

Times are int64 nanoseconds as the driver wrote them: float64 seconds since 1970 cannot hold them. What a stamp means
(begin, middle or end of a sweep), which unit a field of times has and which way an extrinsic goes is not decided here.
"""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Protocol

import numpy as np

from lvba.arrays import Pose
from lvba.camera import Camera


class Kind(StrEnum):
    """What a stream has records of."""

    SCANS = "scans"
    IMAGES = "images"
    POSES = "poses"
    IMU = "imu"
    GNSS = "gnss"
    CAMERA_INFO = "camera info"
    TRANSFORMS = "transforms"
    PACKETS = "packets"
    """Raw sensor packets, which need the sensor's own decoder."""
    OTHER = "other"


@dataclass(frozen=True)
class RawScan:
    """One sweep as the driver published it, in the LiDAR's own frame.

    stamp: ns, of the message's header
    points: (N, 3) float32, m; returns without a position (zeros, NaN) are left in
    intensity: (N,) float32, or None
    times: (N,) of the point's field of times, as it is (any unit, any zero; Livox: ns from `stamp`), or None
    time_field: name of that field
    rows: (N,) int64, ring or row of the sensor, or None
    """

    stamp: int
    frame: str
    points: np.ndarray
    intensity: np.ndarray | None = None
    times: np.ndarray | None = None
    time_field: str = ""
    rows: np.ndarray | None = None


@dataclass(frozen=True)
class RawImage:
    """One image: the bytes of a PNG or JPEG file, or pixels.

    stamp: ns, of the message's header
    encoded: bytes of a file, kept as they are; None: `pixels` has them
    pixels: (H, W) or (H, W, 3) uint8 or uint16, RGB; None: `encoded` has them
    suffix: of the file that holds `encoded`: ".jpg" or ".png"
    """

    stamp: int
    frame: str
    encoded: bytes | None = None
    pixels: np.ndarray | None = None
    suffix: str = ".png"


@dataclass(frozen=True)
class PoseSample:
    """A pose of an odometry. stamp: ns; parent_from_child: (4, 4) float64, m."""

    stamp: int
    parent: str
    child: str
    parent_from_child: Pose


@dataclass(frozen=True)
class PathSample:
    """All poses that a path topic holds so far; the last message has the most. times: (N,) int64 ns; poses: (N, 4, 4)."""

    stamp: int
    parent: str
    times: np.ndarray
    parent_from_child: np.ndarray


@dataclass(frozen=True)
class ImuSample:
    """A reading of an IMU. stamp: ns; gyroscope: (3,) float64, rad/s; accelerometer: (3,) float64, as the driver has it.

    Some drivers write g (Livox), the standard says m/s^2.
    """

    stamp: int
    frame: str
    gyroscope: np.ndarray
    accelerometer: np.ndarray


@dataclass(frozen=True)
class GnssFix:
    """A GNSS position. stamp: ns; latitude and longitude: deg; altitude: m above the ellipsoid.

    covariance: (3, 3) float64, m^2, east north up; None: unknown
    status: of sensor_msgs/NavSatStatus, -1: no fix
    """

    stamp: int
    frame: str
    latitude: float
    longitude: float
    altitude: float
    covariance: np.ndarray | None
    status: int


@dataclass(frozen=True)
class CameraInfo:
    """The calibration that a camera's driver publishes. stamp: ns; camera: None where its matrix is empty.

    other: that of rectified images where `camera` is of raw ones, and of raw ones where it is not; None: it is the same
    rectified: what `camera` is of
    """

    stamp: int
    frame: str
    camera: Camera | None
    other: Camera | None = None
    rectified: bool = False


@dataclass(frozen=True)
class TransformSample:
    """A transform of a tree of frames. static: it holds for all times. parent_from_child: (4, 4) float64, m."""

    stamp: int
    parent: str
    child: str
    parent_from_child: Pose
    static: bool


Record = RawScan | RawImage | PoseSample | PathSample | ImuSample | GnssFix | CameraInfo | TransformSample


@dataclass(frozen=True)
class Stream:
    """A topic of a bag, or what a folder has of one sensor.

    name: the topic, or a name of the folder's own
    message_type: as the source names it: sensor_msgs/msg/PointCloud2, "PNG files"
    count: records; None: unknown until all is read (a cut file)
    first, last: ns, when the recorder got the first and last record; None: unknown
    fields: of points, "name type" each; none elsewhere
    """

    name: str
    kind: Kind
    message_type: str
    count: int | None
    first: int | None = None
    last: int | None = None
    fields: tuple[str, ...] = ()


@dataclass(frozen=True)
class SourceDescription:
    """What a source holds, found without reading it all.

    format: for people: "ROS 1 bag", "MCAP file", "TUM RGB-D folder"
    size: bytes of its files
    notes: what is unusual or lost, one sentence each: "the file is cut: 219 messages are left"
    """

    path: str
    format: str
    size: int
    streams: tuple[Stream, ...]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class KnownGeometry:
    """What a folder's own files say of the rig, by the convention of its format; a bag has none.

    camera: intrinsics of its images; None: not said
    camera_from_lidar, body_from_lidar: (4, 4) float64, m; None: not said
    deskewed: points have no motion left: True for simulators, depth cameras and odometries that write deskewed scans
    """

    camera: Camera | None = None
    camera_from_lidar: Pose | None = None
    body_from_lidar: Pose | None = None
    deskewed: bool = False


class Source(Protocol):
    """A recording of another program, opened for reading; nothing in it is changed."""

    def describe(self) -> SourceDescription:
        """What it holds. Seconds at most, also for 100 GB.

        Raises InputError: the source is damaged past use.
        """

    def geometry(self) -> KnownGeometry:
        """What its own calibration files say."""

    def records(self, streams: Collection[str]) -> Iterator[tuple[str, Record]]:
        """Records of the streams of these names, in the order in which they were recorded, in one pass.

        Memory is bounded by a few records. What cannot be decoded is counted in `losses`, not raised, unless most is so.
        Raises InputError: naming the file, the topic and the fix.
        """

    def losses(self) -> tuple[str, ...]:
        """What the last pass could not read, one sentence each, with numbers."""


@dataclass(frozen=True)
class ListSource:
    """A source of records that are at hand: for simulations, and tests. items: (stream name, record), in time order."""

    description: SourceDescription
    items: tuple[tuple[str, Record], ...]
    known: KnownGeometry = field(default_factory=KnownGeometry)

    def describe(self) -> SourceDescription:
        """What was given."""
        return self.description

    def geometry(self) -> KnownGeometry:
        """What was given."""
        return self.known

    def records(self, streams: Collection[str]) -> Iterator[tuple[str, Record]]:
        """Those of the streams of these names."""
        return (item for item in self.items if item[0] in streams)

    def losses(self) -> tuple[str, ...]:
        """None."""
        return ()
