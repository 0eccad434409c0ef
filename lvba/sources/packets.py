"""Raw packets of sensors that need their own decoder: which driver makes point clouds of them, on which topic.

Those of Velodyne and Ouster are read here; where that fails, their drivers help, too.
"""

from collections.abc import Iterable

from lvba.sources.source import Kind, Stream

_OUSTER = ("ouster_ros, with the sensor's metadata", "/ouster/points")
_HESAI = ("hesai_ros_driver", "/lidar_points")
_PANDAR = ("HesaiLidar_General_ROS", "/hesai/pandar")
_ROBOSENSE = ("rslidar_sdk", "/rslidar_points")
_NEBULA = ("nebula_ros, with the sensor's calibration", "/pandar_points or /velodyne_points")
DRIVERS = {
    "ouster_ros/PacketMsg": _OUSTER,
    "ouster_sensor_msgs/PacketMsg": _OUSTER,
    "ouster_msgs/PacketMsg": _OUSTER,
    "hesai_ros_driver/UdpFrame": _HESAI,
    "hesai_lidar/PandarScan": _PANDAR,
    "pandar_msgs/PandarScan": _PANDAR,
    "rslidar_msgs/rslidarScan": _ROBOSENSE,
    "rslidar_msgs/rslidarPacket": _ROBOSENSE,
    "rslidar_msg/RslidarPacket": _ROBOSENSE,
    "nebula_msgs/NebulaPackets": _NEBULA,
    "velodyne_msgs/VelodyneScan": (
        "velodyne_pointcloud, with the sensor's calibration",
        "/velodyne_points",
    ),
}
"""By the short name of a message: the driver, and the usual topic of its clouds."""


def is_raw(message_type: str) -> bool:
    """Whether messages are packets, whether they are read or not; "package/Name" or "package/msg/Name"."""
    return message_type.replace("/msg/", "/") in DRIVERS


def mend(message_type: str) -> str:
    """What to do with packets of such messages, "package/Name" or "package/msg/Name"."""
    driver, topic = DRIVERS.get(message_type.replace("/msg/", "/"), ("the sensor's driver", "its topic"))
    return f"play the bag through {driver}, and record {topic} (sensor_msgs/PointCloud2)"


def problem(stream: Stream) -> str:
    """What is wrong with a stream of packets."""
    return f"{stream.name} has raw packets ({stream.message_type}), which are not read"


def only(streams: Iterable[Stream]) -> Stream | None:
    """The first stream of packets; None: there is none."""
    return next((stream for stream in streams if stream.kind is Kind.PACKETS and stream.count != 0), None)
