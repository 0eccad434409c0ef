"""A bag as a source of records."""

import contextlib
import re
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lvba.errors import InputError
from lvba.io import files
from lvba.sources import packets
from lvba.sources.bags import decoders, ouster_packets, point_clouds, poses, velodyne_packets
from lvba.sources.bags.bag_files import container_at, topics_said
from lvba.sources.bags.container import MAX_MESSAGE, Container, Contents, Losses, Message, Topic
from lvba.sources.bags.decoders import Decoder
from lvba.sources.bags.definitions import Undecodable, short
from lvba.sources.bags.layout import Layout, decode, layout_of
from lvba.sources.bags.ouster_topics import OusterPass, OusterTopics
from lvba.sources.source import Kind, KnownGeometry, Record, SourceDescription, Stream

_PATIENCE = 100
"""So many messages of a topic may fail, before any succeeds."""
_BESIDE = (Kind.CAMERA_INFO, Kind.TRANSFORMS, Kind.GNSS)
"""Kinds that may be lost: others can say what they say."""
_MOST_LOOKED_AT = 50
"""Topics of clouds whose first message is read for its fields, and packets of whose metadata count."""
_MOST_METADATA = 20
"""Messages of metadata that are read: a driver writes one more each time a sensor is set up."""
_WRONG = (KeyError, TypeError, ValueError, OverflowError, IndexError, AttributeError)
"""What comes of fields that are not those of the type's name."""
_RECTIFIED = re.compile("rect|undistort")
_NUMBERS_OF = ("poses",)
"""Of paths, which hold all poses so far in each message."""


def open_bag(path: Path) -> "BagSource | None":
    """The bag at a path, of ROS 1 or ROS 2, a file or a folder of files; None: it is none.

    Raises InputError: it is one, and damaged past use.
    """
    container = container_at(path)
    return BagSource(path, container) if container is not None else None


def said_by_metadata(folder: Path) -> SourceDescription | None:
    """A ROS 2 bag by its metadata alone, for where its files cannot be read yet; None: it has none.

    Raises InputError: the metadata are damaged.
    """
    topics = topics_said(folder)
    kinds = decoders.kinds_of(topics)
    streams = tuple(
        Stream(
            name=topic.name,
            kind=kinds[topic.name],
            message_type=topic.message_type,
            count=topic.count,
        )
        for topic in sorted(topics, key=lambda topic: topic.name)
    )
    return SourceDescription(str(folder), "ROS 2 bag", _size(folder), streams) if streams else None


@dataclass
class _Tally:
    """Of one topic in one pass. reasons: why messages were lost, each with how often; damaged: the same of parts of them

    unstamped: had a stamp of zero
    device: lidar_id of the first message that has one; others: messages of other devices, by theirs
    """

    read: int = 0
    device: int | None = None
    others: Counter[int] = field(default_factory=Counter)
    unstamped: int = 0
    reasons: Counter[str] = field(default_factory=Counter)
    damaged: Counter[str] = field(default_factory=Counter)

    @property
    def lost(self) -> int:
        """Messages that were not read."""
        return sum(self.reasons.values())


class BagSource:
    """The bag that a container holds."""

    def __init__(self, path: Path, container: Container) -> None:
        self._path, self._container = path, container
        self._description: SourceDescription | None = None
        self._layouts: dict[Topic, Layout | Undecodable] = {}
        self._losses: tuple[str, ...] = ()
        self._inside: Contents | None = None
        self._ouster: OusterTopics | None = None

    def describe(self) -> SourceDescription:
        """Its topics, by the indices of its files; fields of points by the first message of each topic.

        Raises InputError: it is damaged past use.
        """
        if self._description is None:
            contents = self._contents()
            self._description = SourceDescription(
                path=str(self._path),
                format=contents.format,
                size=_size(self._path),
                streams=tuple(self._streams(contents)),
                notes=contents.notes,
            )
        return self._description

    def geometry(self) -> KnownGeometry:
        """Nothing: a bag has no convention for it; camera infos and transforms are streams."""
        return KnownGeometry()

    def losses(self) -> tuple[str, ...]:
        """What the last pass could not read, one sentence each, with numbers."""
        return self._losses

    def records(self, streams: Collection[str]) -> Iterator[tuple[str, Record]]:
        """Records of the topics of these names, in the order in which they were recorded, in one pass.

        Raises InputError: there is no such topic, it has nothing that is read here, or most of it cannot be decoded (but
        of camera infos, transforms and positions: those are counted in `losses`, too).
        """
        needed, topics = self._check(streams), self._ouster_topics()
        losses, tallies, unasked = Losses(), {name: _Tally() for name in streams}, _Tally()
        self._losses = ()
        makers: dict[Topic, Decoder] = {}
        ouster = OusterPass(topics)
        for message in self._container.messages({*streams, *topics.beside(streams)}, losses):
            topic, tally = message.topic, tallies.get(message.topic.name, unasked)
            if topic not in makers:
                makers[topic] = ouster.maker(topic.name) or _maker(topic, streams)
            try:
                decoded = self._decoded(message, makers[topic], tally)
                tally.read += 1
                if tally is not unasked:
                    yield from ((topic.name, record) for record in decoded)
            except Undecodable as error:
                tally.reasons[str(error)] += 1
                impatient = not tally.read and tally.lost >= _PATIENCE and topic.name in needed
                if impatient and not str(error).startswith("it has no"):
                    raise self._useless(topic.name, tally) from error
        yield from ouster.finish()
        self._losses = (*losses.sentences(), *_sentences(tallies), *ouster.sentences())
        for name, tally in tallies.items():
            if name in needed and tally.lost > tally.read:
                raise self._useless(name, tally)

    def values(self, topic: str, count: int) -> list[dict[str, Any]]:
        """The named values of the first messages of a topic, at most so many; those that are damaged are left out."""
        kept: list[dict[str, Any]] = []
        for tried, message in enumerate(self._container.messages((topic,), Losses()), 1):
            with contextlib.suppress(Undecodable):
                kept.append(decode(self._layout(message.topic), message.data, message.topic.encoding))
            if len(kept) == count or tried == 10 * count:
                break
        return kept

    def _ouster_topics(self) -> OusterTopics:
        if self._ouster is None:
            topics = {topic.name: topic for topic in reversed(self._contents().topics)}
            types = {name: topic.message_type for name, topic in topics.items()}

            def texts(name: str) -> list[str]:
                # without an index, all of the bag would be read for a second one
                most = min(topics[name].count or 1, _MOST_METADATA)
                return [str(values.get("data", "")) for values in self.values(name, most)]

            self._ouster = OusterTopics(self._path, types, texts)
        return self._ouster

    def _contents(self) -> Contents:
        if self._inside is None:
            self._inside = self._container.contents()
        return self._inside

    def _decoded(self, message: Message, make: Decoder, tally: _Tally) -> list[Record]:
        """The records of a message, but parts that cannot be decoded. Raises Undecodable: it has none"""
        topic = message.topic
        if len(message.data) > MAX_MESSAGE:
            raise Undecodable("it has more than 1 GiB")
        values = decode(self._layout(topic), message.data, topic.encoding, _NUMBERS_OF)
        if _is_of_another_device(values.get("lidar_id"), tally):
            return []
        try:
            if "header.stamp.sec" not in values:
                return _all(make(values, message.time, ""), tally)
            stamp = poses.stamp_of(values)
            if stamp == 0:
                tally.unstamped += 1
                stamp = message.time
            return _all(make(values, stamp, poses.frame_of(values)), tally)
        except Undecodable:
            raise
        except _WRONG as error:
            raise Undecodable("its fields are not those of its type") from error

    def _layout(self, topic: Topic) -> Layout:
        if topic not in self._layouts:
            try:
                self._layouts[topic] = layout_of(topic.definition, topic.message_type, topic.encoding)
            except Undecodable as error:
                self._layouts[topic] = error
        layout = self._layouts[topic]
        if isinstance(layout, Undecodable):
            raise Undecodable(*layout.args)
        return layout

    def _check(self, streams: Collection[str]) -> set[str]:
        """Those of the streams without which there is no map.

        Raises InputError: one is not there, or not read.
        """
        by_name = {stream.name: stream for stream in self.describe().streams}
        for name in streams:
            if name not in by_name:
                known = ", ".join(sorted(by_name)) or "none"
                raise InputError(self._path, f"has no topic {name}", f"give one of its topics: {known}")
            stream = by_name[name]
            if stream.kind is Kind.PACKETS:
                raise InputError(self._path, packets.problem(stream), packets.mend(stream.message_type))
            if stream.kind is Kind.OTHER:
                problem = f"{name} has messages that are not read ({stream.message_type})"
                raise InputError(self._path, problem, "choose another topic: lvba inspect lists them")
        return {name for name in streams if by_name[name].kind not in _BESIDE}

    def _useless(self, name: str, tally: _Tally) -> InputError:
        reason, _ = tally.reasons.most_common(1)[0]
        problem = f"{tally.lost} of {tally.lost + tally.read} messages of {name} cannot be decoded: {reason}"
        kind = next(each.message_type for each in self.describe().streams if each.name == name)
        of_packets = "packets are of" in reason or "by the metadata" in reason
        mend = packets.mend(kind) if of_packets else "choose another topic, or record it anew"
        return InputError(self._path, problem, mend)

    def _streams(self, contents: Contents) -> Iterator[Stream]:
        """One for each name: several publishers may have written to it."""
        by_name: dict[str, list[Topic]] = {}
        kinds = decoders.kinds_of(contents.topics)
        for topic in contents.topics:
            by_name.setdefault(topic.name, []).append(topic)
        looked = 0
        for name, topics in sorted(by_name.items()):
            kind = kinds[name]
            looked += kind is Kind.SCANS
            counts = [topic.count for topic in topics]
            known = [count for count in counts if count is not None]
            count = sum(known) if len(known) == len(counts) else None
            yield Stream(
                name=name,
                kind=kind,
                message_type=topics[0].message_type,
                count=self._ouster_topics().records(name, count) if looked <= _MOST_LOOKED_AT else count,
                first=min((topic.first for topic in topics if topic.first is not None), default=None),
                last=max((topic.last for topic in topics if topic.last is not None), default=None),
                fields=self._fields(name, topics) if kind is Kind.SCANS and looked <= _MOST_LOOKED_AT else (),
            )

    def _fields(self, name: str, topics: list[Topic]) -> tuple[str, ...]:
        if not any(topic.count for topic in topics) or all(topic.first is None for topic in topics):
            return ()
        try:
            [values] = self.values(name, 1)
            if short(topics[0].message_type) == "sensor_msgs/PointCloud2":
                return point_clouds.field_names(values)
            if "packets" in values:
                return velodyne_packets.FIELDS
            if "buf" in values:
                return ouster_packets.FIELDS
            return point_clouds.livox_fields(values)
        except (*_WRONG, InputError):
            return ()


def _is_of_another_device(device: Any, tally: _Tally) -> bool:
    """Whether a message is of another LiDAR than the first one: Livox drivers may publish several in one topic."""
    if not isinstance(device, int):
        return False
    if tally.device is None:
        tally.device = device
    if device == tally.device:
        return False
    tally.others[device] += 1
    return True


def _all(records: Iterator[Record], tally: _Tally) -> list[Record]:
    """Records; what is damaged beside them is counted. Raises Undecodable: there is nothing beside it"""
    kept: list[Record] = []
    try:
        kept.extend(records)  # what comes before it fails stays
    except Undecodable as error:
        if not kept:
            raise
        tally.damaged[str(error)] += 1
    return kept


def _maker(topic: Topic, streams: Collection[str]) -> Decoder:
    rectified = rectifies(topic.name, streams)
    return decoders.decoder_of(topic.message_type, topic.name, rectified=rectified) or _none


def _none(values: dict[str, Any], stamp: int, frame: str) -> Iterator[Record]:
    raise Undecodable("nothing here reads its type")


def rectifies(info: str, streams: Collection[str]) -> bool:
    """Whether the wanted images beside a topic of camera infos have no distortion left, by their names."""
    beside = info.rpartition("/")[0] + "/"
    rests = [
        name[len(beside) :] for name in streams if name.startswith(beside) and "image" in name[len(beside) :]
    ]
    return bool(rests) and all(_RECTIFIED.search(rest) for rest in rests)


def _sentences(tallies: dict[str, _Tally]) -> Iterator[str]:
    for name, tally in tallies.items():
        total = tally.read + tally.lost
        for reason, count in tally.reasons.most_common(20):
            yield f"{name}: {count} of {total} messages are lost: {reason}"
        for reason, count in tally.damaged.most_common(20):
            yield f"{name}: {count} of {total} messages are damaged in part: {reason}"
        if tally.others:
            ids = ", ".join(map(str, sorted(tally.others)))
            count = sum(tally.others.values())
            left_out = f"{name}: {count} messages of other LiDARs are left out"
            yield f"{left_out}: lidar_id {ids}, where the first has {tally.device}"
        if tally.unstamped:
            yield f"{name}: {tally.unstamped} messages have no stamp; the time of recording is taken"


def _size(path: Path) -> int:
    """bytes"""
    if path.is_dir():
        return sum(inner.stat().st_size for inner in path.iterdir() if inner.is_file())
    return files.size(path, 2**63)
