"""Bags of any container, with scans in the layout of any driver: for simulated recordings, and tests."""

import contextlib
from collections.abc import Collection, Iterator
from enum import StrEnum
from pathlib import Path
from typing import Any

from lvba.errors import InputError
from lvba.io import files
from lvba.sources.bags import definitions
from lvba.sources.bags.container import Encoding, type_name
from lvba.sources.bags.encode import encode
from lvba.sources.bags.layout import layout_of
from lvba.sources.bags.messages import message_of
from lvba.sources.bags.point_layouts import PointLayout
from lvba.sources.source import CameraInfo, Record, Source, TransformSample

_OTHERS = (
    "livox_ros_driver/CustomPoint",
    "livox_ros_driver/CustomMsg",
    "livox_ros_driver2/CustomPoint",
    "livox_ros_driver2/CustomMsg",
    "tf2_msgs/TFMessage",
)
"""Types that rosbags does not know in each generation of ROS."""


class BagForm(StrEnum):
    """Container and compression. Those of ROS 1 are a file, the others a folder with metadata.yaml."""

    ROS1 = "ros1"
    ROS1_LZ4 = "ros1-lz4"
    ROS1_BZ2 = "ros1-bz2"
    SQLITE3 = "sqlite3"
    MCAP = "mcap"
    MCAP_ZSTD = "mcap-zstd"

    @property
    def encoding(self) -> Encoding:
        """Of its messages."""
        return Encoding.ROS1 if self.value.startswith("ros1") else Encoding.CDR


def write_bag(
    source: Source,
    path: Path,
    form: BagForm = BagForm.ROS1,
    layout: PointLayout = PointLayout.LIVOX_CUSTOM_2,
    streams: Collection[str] | None = None,
) -> None:
    """Writes what a source has to a new bag; records are recorded at their stamps, in the order of the source.

    Of scans, the stamp is the start of the sweep, and times are ns from it.
    streams: names of those that are written; None: all
    Raises InputError: the path exists, or rosbags is not installed.
    """
    if path.exists():
        raise InputError(path, "exists", "remove it, or choose another path")
    names = {stream.name for stream in source.describe().streams} if streams is None else set(streams)
    with files.as_input_error(path), _opened(path, form) as (writer, store):
        connections: dict[tuple[str, str], Any] = {}
        for time, name, record in _with_times(source.records(names)):
            kind, values, _ = message_of(record, layout, form.encoding)
            if (name, kind) not in connections:
                connections[name, kind] = writer.add_connection(name, kind, typestore=store)
            data = encode(layout_of("", kind, form.encoding), values, form.encoding)
            writer.write(connections[name, kind], time, data)


def _with_times(records: Iterator[tuple[str, Record]]) -> Iterator[tuple[int, str, Record]]:
    """(ns when it was recorded, name, record): at its stamp, or later where one before it was.

    What says for the whole recording, and comes first, was recorded with what comes next, whatever its stamp.
    """
    last, waiting = 0, list[tuple[str, Record]]()
    for name, record in records:
        if not last and isinstance(record, CameraInfo | TransformSample):
            waiting.append((name, record))
            continue
        last = max(last, record.stamp)
        yield from ((last, *each) for each in waiting)
        waiting.clear()
        yield last, name, record
    yield from ((record.stamp, name, record) for name, record in waiting)


@contextlib.contextmanager
def _opened(path: Path, form: BagForm) -> Iterator[tuple[Any, Any]]:
    """The writer of rosbags, and the types that it needs."""
    try:
        from rosbags import rosbag1, rosbag2, typesys
        from rosbags.rosbag2.enums import CompressionFormat, CompressionMode
    except ImportError as error:
        problem = "bags are written by the package rosbags"
        raise InputError(path, problem, "install it: pip install 'lvba[bags]'") from error
    writer: Any
    if form.encoding is Encoding.ROS1:
        store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
        writer = rosbag1.Writer(path)
        if form is not BagForm.ROS1:
            kinds = rosbag1.Writer.CompressionFormat
            writer.set_compression(kinds.LZ4 if form is BagForm.ROS1_LZ4 else kinds.BZ2)
    else:
        store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        plugin = rosbag2.StoragePlugin.SQLITE3 if form is BagForm.SQLITE3 else rosbag2.StoragePlugin.MCAP
        writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
        if form is BagForm.MCAP_ZSTD:
            writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    for name in _OTHERS:
        message_type = type_name(name)
        if message_type not in store.types:
            store.register(typesys.get_types_from_msg(definitions.known_text(name), message_type))
    with writer:
        yield writer, store
