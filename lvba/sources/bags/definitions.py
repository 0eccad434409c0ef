"""Definitions of messages: the text that a bag carries, or the known one where it carries none."""

import re
from dataclasses import dataclass

from lvba.sources.bags.container import Encoding

MAX_TEXT = 1024**2
_SEPARATOR = re.compile(r"^={20,}[ \t\r]*$", re.MULTILINE)
_FIELD = re.compile(r"^\s*([A-Za-z][\w/]*)(?:<=\d+)?(?:\[(<=)?(\d*)\])?\s+([A-Za-z]\w*)\s*(.*)$")


class Undecodable(ValueError):  # noqa: N818 (a state, which callers count)
    """A message, or all of a type, cannot be decoded; says why in a few words."""


@dataclass(frozen=True)
class Field:
    """One field. type: a primitive, or pkg/Type; count: None: one; -1: a sequence; else so many"""

    name: str
    type: str
    count: int | None


Types = dict[str, tuple[Field, ...]]
"""pkg/Type, to its fields."""


def parse(text: str, message_type: str) -> Types:
    """The types that a definition gives: that of the message, and those that it holds.

    message_type: pkg/Type, which the text before the first separator defines
    Raises Undecodable: it is no such text.
    """
    if len(text) > MAX_TEXT:
        raise Undecodable(f"a definition of {len(text)} characters")
    first, *others = _SEPARATOR.split(text)
    types = {message_type: _fields(first, message_type)}
    for part in others:
        head, _, body = part.strip().partition("\n")
        if not head.startswith("MSG:"):
            raise Undecodable("its definition is in another language than .msg")
        name = short(head[4:].strip())
        types.setdefault(name, _fields(body, name))
    return types


def short(message_type: str) -> str:
    """pkg/Type of pkg/msg/Type."""
    parts = message_type.split("/")
    return f"{parts[0]}/{parts[-1]}"


def _fields(text: str, message_type: str) -> tuple[Field, ...]:
    package = message_type.partition("/")[0]
    fields = []
    for line in text.splitlines():
        bare = line.strip()
        if not bare or bare.startswith("#"):
            continue
        match = _FIELD.match(line)
        if not match:
            raise Undecodable(f"an invalid line of its definition: {bare[:40]!r}")
        kind, bounded, number, name, rest = match.groups()
        if rest.startswith("="):
            continue  # a constant
        if len(number or "") > 9:
            raise Undecodable("a field of more than a billion elements")
        count = None if number is None else int(number) if number and not bounded else -1
        fields.append(Field(name.lower(), _resolved(kind, package), count))
    return tuple(fields)


def _resolved(kind: str, package: str) -> str:
    if "/" in kind:
        return short(kind)
    if kind == "Header":
        return "std_msgs/Header"
    return f"{package}/{kind}" if kind[0].isupper() else kind


def known(encoding: Encoding) -> Types:
    """Types that need no definition in the bag."""
    stamp = "uint32 seq;time stamp;" if encoding is Encoding.ROS1 else "builtin_interfaces/Time stamp;"
    header = f"{stamp}string frame_id"
    texts = {**_KNOWN, "std_msgs/Header": header}
    return {name: _fields(text.replace(";", "\n"), name) for name, text in texts.items()}


def known_text(name: str) -> str:
    """The definition of a type (pkg/Type) that needs none in the bag."""
    return _KNOWN[name].replace(";", "\n")


_LIVOX = {
    "CustomPoint": "uint32 offset_time;float32 x;float32 y;float32 z;uint8 reflectivity;uint8 tag;uint8 line",
    "CustomMsg": "std_msgs/Header header;uint64 timebase;uint32 point_num;uint8 lidar_id;uint8[3] rsvd;"
    "CustomPoint[] points",
}
_KNOWN = {
    "geometry_msgs/Point": "float64 x;float64 y;float64 z",
    "geometry_msgs/Vector3": "float64 x;float64 y;float64 z",
    "geometry_msgs/Quaternion": "float64 x;float64 y;float64 z;float64 w",
    "geometry_msgs/Pose": "Point position;Quaternion orientation",
    "geometry_msgs/Twist": "Vector3 linear;Vector3 angular",
    "geometry_msgs/Transform": "Vector3 translation;Quaternion rotation",
    "geometry_msgs/PoseWithCovariance": "Pose pose;float64[36] covariance",
    "geometry_msgs/TwistWithCovariance": "Twist twist;float64[36] covariance",
    "geometry_msgs/PoseStamped": "Header header;Pose pose",
    "geometry_msgs/PoseWithCovarianceStamped": "Header header;PoseWithCovariance pose",
    "geometry_msgs/TransformStamped": "Header header;string child_frame_id;Transform transform",
    "nav_msgs/Odometry": "Header header;string child_frame_id;geometry_msgs/PoseWithCovariance pose;"
    "geometry_msgs/TwistWithCovariance twist",
    "nav_msgs/Path": "Header header;geometry_msgs/PoseStamped[] poses",
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "tf/tfMessage": "geometry_msgs/TransformStamped[] transforms",
    "sensor_msgs/PointField": "string name;uint32 offset;uint8 datatype;uint32 count",
    "sensor_msgs/PointCloud2": "Header header;uint32 height;uint32 width;PointField[] fields;bool is_bigendian;"
    "uint32 point_step;uint32 row_step;uint8[] data;bool is_dense",
    "velodyne_msgs/VelodynePacket": "builtin_interfaces/Time stamp;uint8[1206] data",
    "std_msgs/String": "string data",
    **dict.fromkeys(
        ("ouster_ros/PacketMsg", "ouster_sensor_msgs/PacketMsg", "ouster_msgs/PacketMsg"), "uint8[] buf"
    ),
    "velodyne_msgs/VelodyneScan": "Header header;VelodynePacket[] packets",
    "sensor_msgs/Image": "Header header;uint32 height;uint32 width;string encoding;uint8 is_bigendian;uint32 step;"
    "uint8[] data",
    "sensor_msgs/CompressedImage": "Header header;string format;uint8[] data",
    "sensor_msgs/RegionOfInterest": "uint32 x_offset;uint32 y_offset;uint32 height;uint32 width;bool do_rectify",
    "sensor_msgs/CameraInfo": "Header header;uint32 height;uint32 width;string distortion_model;float64[] d;"
    "float64[9] k;float64[9] r;float64[12] p;uint32 binning_x;uint32 binning_y;RegionOfInterest roi",
    "sensor_msgs/Imu": "Header header;geometry_msgs/Quaternion orientation;float64[9] orientation_covariance;"
    "geometry_msgs/Vector3 angular_velocity;float64[9] angular_velocity_covariance;"
    "geometry_msgs/Vector3 linear_acceleration;float64[9] linear_acceleration_covariance",
    "sensor_msgs/NavSatStatus": "int8 status;uint16 service",
    "sensor_msgs/NavSatFix": "Header header;NavSatStatus status;float64 latitude;float64 longitude;float64 altitude;"
    "float64[9] position_covariance;uint8 position_covariance_type",
    **{
        f"{package}/{name}": text
        for package in ("livox_ros_driver", "livox_ros_driver2", "livox_interfaces")
        for name, text in _LIVOX.items()
    },
}
"""As in the packages of ROS and the Livox drivers; a semicolon ends a line."""
