"""Small bags, written by rosbags: its own writers and serialization, not ours."""

import functools
from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

LIVOX_POINT = "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line"
LIVOX_FIELDS = (
    "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n"
    "CustomPoint[] points"
)
SECOND = 1_000_000_000
T0 = 1_700_000_000 * SECOND


@functools.cache
def usual_types(ros: int):
    """Types of ROS 1 or 2 with those of Livox."""
    return typestore(ros)


def typestore(ros: int, *, extra: dict[str, str] | None = None):
    """Types of ROS 1 or 2 with those of Livox, and more, or others for them."""
    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
    texts = {
        f"livox_ros_driver{version}/msg/{name}": text
        for version in ("", "2")
        for name, text in (("CustomPoint", LIVOX_POINT), ("CustomMsg", LIVOX_FIELDS))
    }
    texts["tf2_msgs/msg/TFMessage"] = "geometry_msgs/TransformStamped[] transforms"
    texts |= extra or {}
    types = {}
    for name, text in texts.items():
        if name not in store.types:
            types |= get_types_from_msg(text, name)
    store.register(types)
    return store


class Messages:
    """Makes messages of one generation of ROS."""

    def __init__(self, ros: int, store=None) -> None:
        self.ros, self.store = ros, store or usual_types(ros)

    def make(self, name: str, /, **values):
        """A message, with zeros and nothing where no value is given."""
        kind = self.store.types[name]
        fields = {}
        for field, (node, detail) in self.store.fielddefs[name][1]:
            field_name = field
            if field_name.lower() in values:
                fields[field_name] = values[field_name.lower()]
            else:
                fields[field_name] = self._empty(node, detail)
        return kind(**fields)

    def _empty(self, node, detail):
        if int(node) == 1:
            return {"string": "", "bool": False}.get(detail[0], 0)
        if int(node) == 2:
            return self.make(detail)
        (inner, inner_detail), count = detail
        if int(inner) == 1 and inner_detail[0] != "string":
            kind = {"float64": np.float64, "float32": np.float32, "uint8": np.uint8}.get(
                inner_detail[0], np.uint8
            )
            return np.zeros(count or 0, kind)
        return [self._empty(inner, inner_detail) for _ in range(count or 0)]

    def header(self, stamp: int, frame: str = "sensor"):
        """A std_msgs/Header. stamp: ns"""
        time = self.make("builtin_interfaces/msg/Time", sec=stamp // SECOND, nanosec=stamp % SECOND)
        return self.make("std_msgs/msg/Header", stamp=time, frame_id=frame)

    def pose(self, position, quaternion):
        """A geometry_msgs/Pose."""
        point = self.make("geometry_msgs/msg/Point", **dict(zip("xyz", map(float, position))))
        turn = self.make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", map(float, quaternion))))
        return self.make("geometry_msgs/msg/Pose", position=point, orientation=turn)

    def cloud(self, stamp: int, table: np.ndarray, *, height: int = 1, padding: int = 0, big: bool = False):
        """A PointCloud2 of a structured array. padding: bytes behind each row"""
        codes = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
        fields = [
            self.make(
                "sensor_msgs/msg/PointField", name=name, offset=offset, datatype=codes[kind.str[1:]], count=1
            )
            for name, (kind, offset) in table.dtype.fields.items()
        ]
        width, step = len(table) // height, table.dtype.itemsize
        rows = [table[i * width : (i + 1) * width].tobytes() + bytes(padding) for i in range(height)]
        return self.make(
            "sensor_msgs/msg/PointCloud2",
            header=self.header(stamp, "lidar"),
            height=height,
            width=width,
            fields=fields,
            is_bigendian=big,
            point_step=step,
            row_step=width * step + padding,
            data=np.frombuffer(b"".join(rows), np.uint8),
        )

    def livox(self, stamp: int, points: np.ndarray, offsets: np.ndarray, driver: str = "livox_ros_driver2"):
        """A CustomMsg. points: (N, 3) m; offsets: (N,) ns"""
        listed = [
            self.make(
                f"{driver}/msg/CustomPoint",
                offset_time=int(offset),
                **dict(zip("xyz", map(float, point))),
                reflectivity=i % 256,
                line=i % 4,
            )
            for i, (point, offset) in enumerate(zip(points, offsets))
        ]
        return self.make(
            f"{driver}/msg/CustomMsg",
            header=self.header(stamp, "livox"),
            timebase=stamp,
            point_num=len(listed),
            points=listed,
        )

    def raw(self, message, name: str) -> bytes:
        """The bytes of a message."""
        serialize = self.store.serialize_ros1 if self.ros == 1 else self.store.serialize_cdr
        return bytes(serialize(message, name))


CONTAINERS = ("bag", "bag-lz4", "bag-bz2", "sqlite3", "mcap", "mcap-zstd", "sqlite3-message", "sqlite3-file")


def generation(container: str) -> int:
    """1 or 2, of ROS."""
    return 1 if container.startswith("bag") else 2


def write(path: Path, container: str, topics, messages: Messages) -> Path:
    """A bag; topics: name to (type, [(time in ns, message)]). The file, or the folder of ROS 2."""
    rows = sorted(
        ((time, name, message) for name, (_, rows) in topics.items() for time, message in rows),
        key=lambda row: row[0],
    )
    if generation(container) == 1:
        writer = Writer1(path)
        if container != "bag":
            form = {"bag-lz4": Writer1.CompressionFormat.LZ4, "bag-bz2": Writer1.CompressionFormat.BZ2}
            writer.set_compression(form[container])
    else:
        plugin = StoragePlugin.MCAP if "mcap" in container else StoragePlugin.SQLITE3
        writer = Writer2(path, version=9, storage_plugin=plugin)
        mode = {
            "zstd": CompressionMode.STORAGE,
            "message": CompressionMode.MESSAGE,
            "file": CompressionMode.FILE,
        }
        if (kind := container.partition("-")[2]) in mode:
            writer.set_compression(mode[kind], CompressionFormat.ZSTD)
    with writer:
        connections = {
            name: writer.add_connection(name, kind, typestore=messages.store)
            for name, (kind, _) in topics.items()
        }
        for time, name, message in rows:
            data = message if isinstance(message, bytes) else messages.raw(message, topics[name][0])
            writer.write(connections[name], time, data)
    return path
