"""Which topics of a bag have packets of Ouster's sensors, and the metadata of each; what makes records of them."""

import contextlib
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

from lvba.errors import InputError
from lvba.io import files
from lvba.sources.bags.definitions import Undecodable, short
from lvba.sources.bags.ouster_metadata import MAX_TEXT, OusterSensor, parse
from lvba.sources.bags.ouster_packets import PacketFormat
from lvba.sources.bags.ouster_scans import ReadingMaker, ScanMaker
from lvba.sources.bags.sensor_clock import SensorClock
from lvba.sources.source import Kind, RawScan, Record, TransformSample

PACKETS = ("ouster_ros/PacketMsg", "ouster_sensor_msgs/PacketMsg", "ouster_msgs/PacketMsg")
_TEXT = "std_msgs/String"
_SENSOR, _LIDAR, _IMU = "os_sensor", "os_lidar", "os_imu"
"""Frames, as Ouster's driver names them."""
_WORDS, _LIDAR_PACKETS = re.compile("lidar_packets|imu_packets|metadata"), re.compile("lidar_packets|packets")
"""Of names of topics, as the driver has them."""
Maker = Callable[[dict[str, Any], int, str], Iterator[Record]]


def kinds(types: Mapping[str, str]) -> dict[str, Kind]:
    """What topics of packets and their metadata have, by their names. types: of messages, by the name of the topic

    Metadata say where the LiDAR and the IMU are in a sensor: they are transforms.
    """
    given = {name: _of_packets(name) for name, kind in types.items() if short(kind) in PACKETS}
    if given:
        given |= dict.fromkeys(_metadata(types), Kind.TRANSFORMS)
    return given


def _of_packets(topic: str) -> Kind:
    last = topic.rpartition("/")[2].lower()
    if "imu" in last:
        return Kind.IMU
    return Kind.OTHER if "zone" in last else Kind.SCANS


def _metadata(types: Mapping[str, str]) -> list[str]:
    """Names of topics of metadata."""
    return [
        name
        for name, kind in types.items()
        if short(kind) == _TEXT and "metadata" in name.rpartition("/")[2].lower()
    ]


class OusterTopics:
    """Those of one bag.

    types: of messages, by the name of the topic; texts: what a topic of texts has
    path: of the bag: metadata may lie beside it, by its name with the ending .json
    """

    def __init__(self, path: Path, types: Mapping[str, str], texts: Callable[[str], list[str]]) -> None:
        self._path, self._types, self._texts = path, types, texts
        self.kinds = kinds(types)
        self._spaces = Counter(_space(name) for name, kind in self.kinds.items() if kind is Kind.SCANS)
        self._sensors: dict[str, OusterSensor | InputError] = {}

    def sensor(self, topic: str) -> OusterSensor:
        """What is known of the sensor of a topic of packets.

        Raises InputError: its metadata are neither in the bag nor beside it, or they are none.
        """
        if topic not in self._sensors:
            try:
                self._sensors[topic] = self._read(topic)
            except InputError as error:
                self._sensors[topic] = error
        sensor = self._sensors[topic]
        if isinstance(sensor, InputError):
            raise sensor
        return sensor

    def records(self, topic: str, messages: int | None) -> int | None:
        """About how many records these messages of a topic make: a scan has many packets."""
        if self.kinds.get(topic) is Kind.SCANS and messages:
            with contextlib.suppress(InputError):  # which reading them raises
                return -(-messages // self.sensor(topic).packets)
        return messages

    def beside(self, topics: Collection[str]) -> set[str]:
        """Topics of IMUs of the sensors of these topics: packets of an IMU come the least late, and tell the clock."""
        units = {self.unit(topic) for topic in topics if self.kinds.get(topic) is Kind.SCANS}
        return {topic for topic, kind in self.kinds.items() if kind is Kind.IMU and self.unit(topic) in units}

    def unit(self, topic: str) -> str:
        """What names of topics of one sensor have in common: the namespace, or more where it has several sensors."""
        space = _space(topic)
        return _WORDS.sub("", topic) if self._spaces[space] > 1 else space

    def frame(self, topic: str, name: str) -> str:
        """Of a topic's sensor, with the namespace of the topic where there are several."""
        return f"{self.unit(topic).strip('/_')}/{name}" if self._spaces.total() > 1 else name

    def _read(self, topic: str) -> OusterSensor:
        name = self._metadata_of(topic)
        beside = _beside(self._path)
        if name:
            where, texts = name, self._texts(name)
        elif beside.is_file():
            where, texts = str(beside), [files.read_text(beside, MAX_TEXT)]
        else:
            problem = f"{topic} has packets of an Ouster, and no topic has the metadata of the sensor"
            raise InputError(self._path, problem, self._mend(topic))
        reason = "there are none"
        for text in reversed(texts):  # the last ones are those in force
            try:
                sensor = parse(text)
                PacketFormat(sensor)  # or its packets are not read
                return sensor
            except Undecodable as error:
                reason = str(error)
        problem = f"{topic} has packets of an Ouster whose metadata, {where}, cannot be used: {reason}"
        raise InputError(self._path, problem, self._mend(topic))

    def _mend(self, topic: str) -> str:
        named = _LIDAR_PACKETS.sub("metadata", topic)
        named = named if named != topic else f"{_space(topic)}/metadata"
        return (
            f"record {named} (std_msgs/String, latched) with them, or save its text as {_beside(self._path)}"
        )

    def _metadata_of(self, topic: str) -> str:
        """The topic of metadata of the same sensor, or the only one; "": there is none."""
        names = _metadata(self._types)
        near = [name for name in names if self.unit(name) == self.unit(topic)]
        if not near and len(names) == 1 and self._spaces.total() <= 1:
            near = names
        return min(near, key=len, default="")


def _space(topic: str) -> str:
    return topic.rpartition("/")[0]


def _beside(path: Path) -> Path:
    """Where metadata may lie."""
    return path.with_name(f"{path.name if path.is_dir() else path.stem}.json")


class OusterPass:
    """What is kept of these topics during one pass over a bag: packets of scans that are not whole yet, and clocks."""

    def __init__(self, topics: OusterTopics) -> None:
        self._topics = topics
        self._clocks: dict[str, SensorClock] = {}
        self._scans: dict[str, ScanMaker] = {}

    def maker(self, topic: str) -> Maker | None:
        """What makes records of the messages of a topic; None: it is none of these.

        Raises InputError: metadata are needed, and cannot be used.
        """
        kind, frame = self._topics.kinds.get(topic), self._topics.frame
        clock = self._clocks.setdefault(self._topics.unit(topic), SensorClock())
        if kind is Kind.SCANS:
            made = ScanMaker(self._topics.sensor(topic), clock, frame(topic, _LIDAR))
            self._scans[topic] = made
            return made
        if kind is Kind.IMU:
            return ReadingMaker(clock, frame(topic, _IMU))
        if kind is Kind.TRANSFORMS:
            return lambda values, stamp, _: self._transforms(topic, values, stamp)
        return None

    def finish(self) -> Iterator[tuple[str, RawScan]]:
        """The last scan of each topic, which no other one ends."""
        for topic, maker in self._scans.items():
            yield from ((topic, scan) for scan in maker.finish())

    def sentences(self) -> Iterator[str]:
        """What was lost, with numbers."""
        for topic, maker in self._scans.items():
            if maker.slivers:
                yield f"{topic}: {maker.slivers} scans with less than a quarter of their columns are not used"

    def _transforms(self, topic: str, values: dict[str, Any], stamp: int) -> Iterator[TransformSample]:
        try:
            sensor = parse(str(values["data"]))
        except Undecodable as error:
            raise Undecodable(f"as metadata of an Ouster, {error}") from error
        parent = self._topics.frame(topic, _SENSOR)
        for name, pose in ((_LIDAR, sensor.sensor_from_lidar), (_IMU, sensor.sensor_from_imu)):
            yield TransformSample(stamp, parent, self._topics.frame(topic, name), pose, static=True)
