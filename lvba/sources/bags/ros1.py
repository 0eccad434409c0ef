"""Bags of ROS 1, with an index, without one, and cut.

A file is a sequence of records: length of header, header (fields `name=value`), length of data, data. Messages are
in chunks; behind each chunk are the times of its messages, and at the end of the file the connections and a list of
chunks, to which the record at the start points. Source: wiki.ros.org/Bags/Format/2.0.
"""

import contextlib
import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field, replace
from io import BufferedReader
from pathlib import Path

import numpy as np

from lvba.errors import InputError
from lvba.io import files
from lvba.sources.bags.compression import Damaged, Unpacker
from lvba.sources.bags.container import MAX_MESSAGE, Contents, Encoding, Losses, Message, Topic, type_name

MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _BAG, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 4, 5, 6, 7
_MAX_HEADER = 1024**2
_MAX_CONNECTION = 16 * 1024**2
_MAX_CONNECTIONS = 100_000
_MOST_INDICES = 200_000
"""Records that are read to know when the first and last message of each connection came."""
_NANO = 1_000_000_000
_ENTRIES = np.dtype([("seconds", "<u4"), ("nanoseconds", "<u4"), ("offset", "<u4")])
_U4 = struct.Struct("<I")


@dataclass(frozen=True)
class _Record:
    """op: what it is, -1: unknown; start: of the record, data: of its data, in the file; length: of the data"""

    op: int
    fields: dict[bytes, bytes]
    start: int
    data: int
    length: int


@dataclass
class _Times:
    """Of one connection: messages, and when the first and last came (ns)."""

    count: int = 0
    first: int | None = None
    last: int | None = None

    def add(self, count: int, first: int, last: int) -> None:
        """So many more, from first to last."""
        self.count += count
        self.first = first if self.first is None else min(first, self.first)
        self.last = last if self.last is None else max(last, self.last)


@dataclass
class _Listing:
    """connections: by id; chunks: positions, each with the ids in it (None: not known)

    unread: bytes behind the last record
    """

    connections: dict[int, Topic] = field(default_factory=dict)
    times: dict[int, _Times] = field(default_factory=dict)
    chunks: dict[int, set[int] | None] = field(default_factory=dict)
    indexed: bool = False
    unread: int = 0


class Ros1Bag:
    """A file of version 2.0."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._size = files.size(path, 2**63)
        self._known: _Listing | None = None

    def contents(self) -> Contents:
        """By the index; without one, by the heads of its records.

        Raises InputError: it is no bag of version 2.0, it is encrypted, or nothing is left in it.
        """
        listing = self._listing()
        topics = tuple(
            replace(topic, count=times.count, first=times.first, last=times.last)
            for number, topic in listing.connections.items()
            for times in [listing.times.get(number, _Times())]
        )
        notes = []
        if not listing.indexed:
            left = sum(topic.count or 0 for topic in topics)
            cut = f"; its last {listing.unread} bytes are lost" if listing.unread else ""
            notes.append(
                f"{self.path.name} has no index (it was cut, or not closed): {left} messages are left{cut}"
            )
        return Contents("ROS 1 bag", topics, tuple(notes))

    def messages(self, names: Collection[str], losses: Losses) -> Iterator[Message]:
        """Those of the topics of these names, chunk by chunk."""
        listing = self._listing()
        connections = dict(listing.connections)
        wanted = {number for number, topic in connections.items() if topic.name in names}
        unpacker = Unpacker(self.path)
        with files.open_binary(self.path) as file, files.as_input_error(self.path):
            for position, inside in listing.chunks.items():
                if inside is not None and not inside & wanted:
                    continue
                content = self._content(file, position, unpacker, losses)
                yield from self._in_content(content, connections, names, losses)
            if not listing.indexed:
                yield from self._outside_chunks(file, listing, connections, names, losses)

    def _listing(self) -> _Listing:
        if self._known is None:
            with files.open_binary(self.path) as file, files.as_input_error(self.path):
                self._known = self._by_index(file) or self._by_scan(file)
        return self._known

    def _by_index(self, file: BufferedReader) -> _Listing | None:
        """None: there is none, or it contradicts the file."""
        head = self._head(file)
        try:
            index, count, chunks = (
                _number(head.fields, name, form)
                for name, form in ((b"index_pos", "<Q"), (b"conn_count", "<I"), (b"chunk_count", "<I"))
            )
        except Damaged:
            return None
        if not len(MAGIC) < index <= self._size or (index == self._size and count + chunks):
            return None
        listing = _Listing(indexed=True)
        try:
            for record in self._records(file, index, ()):
                self._read_index(file, record, listing)
            if len(listing.connections) != count or len(listing.chunks) != chunks:
                return None
            listing.chunks = dict(sorted(listing.chunks.items()))
            self._ends(file, listing)
        except Damaged:
            return None
        return listing

    def _head(self, file: BufferedReader) -> _Record:
        file.seek(0)
        if file.read(len(MAGIC)) != MAGIC:
            raise InputError(
                self.path, "is no ROS 1 bag of version 2.0", "convert it by `rosbag fix`, or copy it again"
            )
        try:
            head = _read_record(file, len(MAGIC), self._size)
        except Damaged as error:
            raise InputError(self.path, f"its first record is damaged ({error})", "copy it again") from error
        if head.fields.get(b"encryptor"):
            raise InputError(self.path, "is encrypted", "decrypt it by rosbag first")
        return head

    def _read_index(self, file: BufferedReader, record: _Record, listing: _Listing) -> None:
        if record.op == _CONNECTION:
            self._connect(record.fields, _data(file, record, _MAX_CONNECTION), listing.connections)
        elif record.op == _CHUNK_INFO:
            position = _number(record.fields, b"chunk_pos", "<Q")
            pairs = np.frombuffer(
                _data(file, record, _MAX_CONNECTION)[: record.length // 8 * 8], "<u4"
            ).reshape(-1, 2)
            listing.chunks[position] = {int(number) for number in pairs[:, 0]}
            for number, count in pairs.tolist():
                listing.times.setdefault(number, _Times()).count += count

    def _ends(self, file: BufferedReader, listing: _Listing) -> None:
        """When the first and last message of each connection came, by the times behind its first and last chunk."""
        first: dict[int, int] = {}
        last: dict[int, int] = {}
        for position, inside in listing.chunks.items():
            for number in inside or ():
                first.setdefault(number, position)
                last[number] = position
        records = 0
        for position in sorted({*first.values(), *last.values()}):
            chunk = _read_record(file, position, self._size)
            if chunk.op != _CHUNK:
                raise Damaged("a chunk is not where the index says")
            for record in self._records(file, chunk.data + chunk.length, ()):
                records += 1
                if record.op != _INDEX:
                    break
                if records > _MOST_INDICES:
                    raise Damaged("it has too many connections")
                number = _number(record.fields, b"conn", "<I")
                span = _span(_data(file, record, MAX_MESSAGE))
                if span and position in (first.get(number), last.get(number)):
                    times = listing.times.setdefault(number, _Times())
                    times.add(0, span[1], span[2])

    def _by_scan(self, file: BufferedReader) -> _Listing:
        """Record by record; the content of chunks is passed over where it is not needed."""
        listing = _Listing()
        self._head(file)
        unpacker = Unpacker(self.path)
        chunk, end = None, len(MAGIC)
        try:
            for record in self._records(file, len(MAGIC), (_CHUNK,)):
                if chunk is not None and record.op != _INDEX:
                    self._count_inside(file, chunk, listing, unpacker)
                    chunk = None
                end = min(record.data + record.length, self._size)
                if record.op == _CHUNK:
                    chunk = record.start
                    listing.chunks[chunk] = None
                elif record.op == _INDEX and chunk is not None:
                    self._count_index(file, record, listing, chunk)
                elif record.op == _CONNECTION:
                    self._connect(record.fields, _data(file, record, _MAX_CONNECTION), listing.connections)
                elif record.op == _MESSAGE:
                    _count_message(record.fields, listing)
        except Damaged:
            pass
        if chunk is not None:
            self._count_inside(file, chunk, listing, unpacker)
        listing.unread = self._size - end
        if not listing.connections:
            raise InputError(self.path, "is cut before its first messages", "copy it again, or record anew")
        return listing

    def _count_index(self, file: BufferedReader, record: _Record, listing: _Listing, chunk: int) -> None:
        number = _number(record.fields, b"conn", "<I")
        span = _span(_data(file, record, MAX_MESSAGE))
        inside = listing.chunks[chunk]
        listing.chunks[chunk] = (inside or set()) | {number}
        if span:
            listing.times.setdefault(number, _Times()).add(*span)

    def _count_inside(self, file: BufferedReader, chunk: int, listing: _Listing, unpacker: Unpacker) -> None:
        """Reads a chunk for its connections, where one is not known, and for its messages, where it has no times."""
        inside = listing.chunks[chunk]
        if inside is not None and inside <= listing.connections.keys():
            return
        for fields, data in _inner(self._content(file, chunk, unpacker, Losses()), Losses(), ""):
            op = fields.get(b"op")
            if op == bytes([_CONNECTION]):
                with contextlib.suppress(Damaged):
                    self._connect(fields, data, listing.connections)
            elif op == bytes([_MESSAGE]) and inside is None:
                _count_message(fields, listing)

    def _connect(
        self, fields: dict[bytes, bytes], data: bytes | memoryview, connections: dict[int, Topic]
    ) -> None:
        number = _number(fields, b"conn", "<I")
        if number in connections or len(connections) >= _MAX_CONNECTIONS:
            return
        about = _fields(bytes(data))
        name, kind = fields.get(b"topic", b""), about.get(b"type", b"")
        definition = about.get(b"message_definition", b"").decode("utf-8", "replace")
        message_type = type_name(kind.decode("utf-8", "replace"))
        connections[number] = Topic(
            name=name.decode("utf-8", "replace"),
            message_type=message_type,
            encoding=Encoding.ROS1,
            definition=definition,
        )

    def _records(self, file: BufferedReader, position: int, cut: Collection[int]) -> Iterator[_Record]:
        """From a position to the end of the file. cut: kinds of which the last one may go beyond it

        Raises Damaged: where a record begins is none.
        """
        while position < self._size:
            record = _read_record(file, position, self._size, cut)
            yield record
            position = record.data + record.length

    def _content(self, file: BufferedReader, position: int, unpacker: Unpacker, losses: Losses) -> bytes:
        """The records in a chunk; what is left of them, if it is damaged."""
        try:
            record = _read_record(file, position, self._size, (_CHUNK,))
            if record.op != _CHUNK:
                raise Damaged("it is not a chunk")
            if record.length > MAX_MESSAGE:
                raise Damaged(f"it has {record.length} bytes")
            file.seek(record.data)
            kind = record.fields.get(b"compression", b"none").decode("ascii", "replace")
            size = _number(record.fields, b"size", "<I")
            content = unpacker.unpack(kind, file.read(min(record.length, self._size - record.data)), size)
            if len(content) < size:
                losses.add(f"{self.path.name}: a chunk is cut")
        except Damaged as error:
            losses.add(f"{self.path.name}: a chunk cannot be read: {error}")
            return b""
        return content

    def _in_content(
        self, content: bytes, connections: dict[int, Topic], names: Collection[str], losses: Losses
    ) -> Iterator[Message]:
        for fields, data in _inner(content, losses, self.path.name):
            op = fields.get(b"op")
            if op == bytes([_MESSAGE]):
                message = _message(fields, data, connections)
                if message and message.topic.name in names:
                    yield message
            elif op == bytes([_CONNECTION]):
                try:
                    self._connect(fields, data, connections)
                except Damaged as error:
                    losses.add(f"{self.path.name}: a connection cannot be read: {error}")

    def _outside_chunks(
        self,
        file: BufferedReader,
        listing: _Listing,
        connections: dict[int, Topic],
        names: Collection[str],
        losses: Losses,
    ) -> Iterator[Message]:
        """Messages that are in no chunk: of the last one of a bag that was not closed."""
        start = max(listing.chunks, default=len(MAGIC))
        try:
            for record in self._records(file, start, (_CHUNK,)):
                if record.op == _MESSAGE:
                    message = _message(record.fields, _data(file, record, MAX_MESSAGE), connections)
                    if message and message.topic.name in names:
                        yield message
        except Damaged:
            pass
        if listing.unread:
            losses.add(f"{self.path.name}: its last {listing.unread} bytes are lost")


def _read_record(file: BufferedReader, position: int, size: int, cut: Collection[int] = ()) -> _Record:
    file.seek(position)
    head = file.read(4)
    if len(head) < 4:
        raise Damaged("the file ends in it")
    (length,) = _U4.unpack(head)
    if length > min(_MAX_HEADER, size - position):
        raise Damaged("its header is longer than the file")
    text = file.read(length + 4)
    if len(text) < length + 4:
        raise Damaged("the file ends in it")
    fields = _fields(text[:length])
    (data,) = _U4.unpack(text[length:])
    op = fields.get(b"op", b"")
    start = position + 8 + length
    kind = op[0] if len(op) == 1 else -1
    if start + data > size and kind not in cut:
        raise Damaged("the file ends in it")
    if kind not in (_MESSAGE, _BAG, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION):
        raise Damaged("it is of no known kind")
    return _Record(kind, fields, position, start, data)


def _data(file: BufferedReader, record: _Record, most: int) -> bytes:
    if record.length > most:
        raise Damaged(f"it has {record.length} bytes")
    file.seek(record.data)
    return file.read(record.length)


def _fields(header: bytes) -> dict[bytes, bytes]:
    """Name to value. Raises Damaged"""
    listing, at, end = {}, 0, len(header)
    while at < end:
        if at + 4 > end:
            raise Damaged("its header is cut")
        (length,) = _U4.unpack_from(header, at)
        at += 4
        name, equal, value = header[at : at + length].partition(b"=")
        if not equal or at + length > end:
            raise Damaged("its header is invalid")
        listing[name] = value
        at += length
    return listing


def _number(fields: dict[bytes, bytes], name: bytes, form: str) -> int:
    try:
        (value,) = struct.unpack(form, fields[name])
    except (KeyError, struct.error) as error:
        raise Damaged(f"it does not say its {name.decode()}") from error
    return int(value)


def _span(entries: bytes) -> tuple[int, int, int] | None:
    """(messages, ns of the first, ns of the last) of an index record's data."""
    table = np.frombuffer(entries[: len(entries) // 12 * 12], _ENTRIES)
    if not len(table):
        return None
    times = table["seconds"].astype(np.int64) * _NANO + table["nanoseconds"]
    return len(times), int(times.min()), int(times.max())


def _inner(content: bytes, losses: Losses, name: str) -> Iterator[tuple[dict[bytes, bytes], memoryview]]:
    """(fields, data) of the records in a chunk."""
    whole, at, end = memoryview(content), 0, len(content)
    while at + 8 <= end:
        (length,) = _U4.unpack_from(content, at)
        data = at + 8 + length
        try:
            if data > end:
                raise Damaged("its header goes beyond the chunk")
            (size,) = _U4.unpack_from(content, data - 4)
            if data + size > end:
                raise Damaged("it goes beyond the chunk")
            fields = _fields(content[at + 4 : data - 4])
        except Damaged as error:
            losses.add(f"{name}: the rest of a chunk is lost: a record of it is damaged ({error})")
            return
        yield fields, whole[data : data + size]
        at = data + size


def _time(fields: dict[bytes, bytes]) -> int | None:
    stamp = fields.get(b"time", b"")
    if len(stamp) != 8:
        return None
    seconds, nanoseconds = struct.unpack("<II", stamp)
    return int(seconds) * _NANO + int(nanoseconds)


def _message(
    fields: dict[bytes, bytes], data: bytes | memoryview, connections: dict[int, Topic]
) -> Message | None:
    number, time = fields.get(b"conn", b""), _time(fields)
    if len(number) != 4 or time is None:
        return None
    topic = connections.get(_U4.unpack(number)[0])
    return Message(topic, time, data) if topic else None


def _count_message(fields: dict[bytes, bytes], listing: _Listing) -> None:
    number, time = fields.get(b"conn", b""), _time(fields)
    if len(number) == 4 and time is not None:
        listing.times.setdefault(_U4.unpack(number)[0], _Times()).add(1, time, time)
