"""Which messages are which kind of stream, and what makes records of them."""

from collections.abc import Callable, Iterable, Iterator
from typing import Any

from lvba.sources import packets
from lvba.sources.bags import camera_info, images, ouster_topics, point_clouds, poses, velodyne_packets
from lvba.sources.bags.container import Topic
from lvba.sources.bags.definitions import short
from lvba.sources.source import Kind, Record

Decoder = Callable[[dict[str, Any], int, str], Iterator[Record]]
"""Of the values of a message, the stamp (ns) and frame of its header."""


def _camera_info(values: dict[str, Any], stamp: int, frame: str) -> Iterator[Record]:
    yield camera_info.info(values, stamp, frame, rectified=False)


def _rectified(values: dict[str, Any], stamp: int, frame: str) -> Iterator[Record]:
    yield camera_info.info(values, stamp, frame, rectified=True)


_LIVOX = ("livox_ros_driver", "livox_ros_driver2", "livox_interfaces")
_DECODERS: dict[str, tuple[Kind, Decoder]] = {
    "sensor_msgs/PointCloud2": (Kind.SCANS, point_clouds.point_cloud),
    **{f"{package}/CustomMsg": (Kind.SCANS, point_clouds.livox) for package in _LIVOX},
    "velodyne_msgs/VelodyneScan": (Kind.SCANS, velodyne_packets.scan),
    "sensor_msgs/Image": (Kind.IMAGES, images.image),
    "sensor_msgs/CompressedImage": (Kind.IMAGES, images.compressed),
    "nav_msgs/Odometry": (Kind.POSES, poses.odometry),
    "nav_msgs/Path": (Kind.POSES, poses.path),
    "geometry_msgs/PoseStamped": (Kind.POSES, poses.pose_stamped),
    "geometry_msgs/PoseWithCovarianceStamped": (Kind.POSES, poses.pose_with_covariance),
    "geometry_msgs/TransformStamped": (Kind.POSES, poses.transform),
    "sensor_msgs/Imu": (Kind.IMU, poses.imu),
    "sensor_msgs/NavSatFix": (Kind.GNSS, poses.fix),
    "sensor_msgs/CameraInfo": (Kind.CAMERA_INFO, _camera_info),
}
_TREES = ("tf2_msgs/TFMessage", "tf/tfMessage")


def _kind_of(message_type: str) -> Kind:
    """What a topic of such messages has, where its name does not matter."""
    name = short(message_type)
    if name in _DECODERS:
        return _DECODERS[name][0]
    if name in _TREES:
        return Kind.TRANSFORMS
    return Kind.PACKETS if name in packets.DRIVERS else Kind.OTHER


def kinds_of(topics: Iterable[Topic]) -> dict[str, Kind]:
    """What topics of a bag have, by their names; some types of messages have several kinds."""
    types: dict[str, str] = {}
    for topic in topics:
        types.setdefault(topic.name, topic.message_type)
    return {name: _kind_of(kind) for name, kind in types.items()} | ouster_topics.kinds(types)


def decoder_of(message_type: str, topic: str, *, rectified: bool) -> Decoder | None:
    """What makes records of the messages of a topic; None: nothing does.

    rectified: of camera infos: the images that are wanted beside it have no distortion left
    """
    name = short(message_type)
    if name in _TREES:
        static = topic.rstrip("/").endswith("tf_static")
        return lambda values, stamp, frame: poses.tree(values, static=static)
    if name == "sensor_msgs/CameraInfo" and rectified:
        return _rectified
    return _DECODERS[name][1] if name in _DECODERS else None
