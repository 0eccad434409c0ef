"""MCAP files, of any profile, with a summary, without one, and cut.

A file is a sequence of records: one byte says its kind, eight its length. Messages are in chunks or beside them; behind
each chunk are the times of its messages, and at the end of the file a summary, to which the footer points.
Source: mcap.dev/spec.
"""

import struct
import zlib
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from io import BufferedReader
from pathlib import Path
from typing import Any

import numpy as np

from lvba.errors import InputError
from lvba.io import files
from lvba.sources.bags.compression import Damaged, Unpacker
from lvba.sources.bags.container import MAX_MESSAGE, Contents, Encoding, Losses, Message, Topic, type_name
from lvba.sources.bags.definitions import MAX_TEXT

MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _INDEX, _CHUNK_INDEX, _STATISTICS, _DATA_END = (
    *(2, 3, 4, 5, 6, 7, 8, 11, 15),
)
_MAX_SMALL = 64 * 1024**2
"""bytes of a record that is no message and no chunk."""
_MOST_COUNTED = 256 * 1024**2
"""bytes of chunks that are read to count messages, where a file has neither a summary nor times behind its chunks."""
_HEAD = struct.Struct("<BQ")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_CHUNK_HEAD = struct.Struct("<QQQI")
_ENTRIES = np.dtype([("time", "<i8"), ("offset", "<u8")])
_COUNTS = np.dtype([("channel", "<u2"), ("count", "<u8")])


@dataclass(frozen=True)
class _Chunk:
    """position: of its record; indices: where the times of each channel are, None: not known"""

    position: int
    indices: Mapping[int, int | None] | None


@dataclass
class _Listing:
    """schemas: (name, encoding, text) by id; counts: of each channel, None: not known

    unread: bytes behind the last record; counted: bytes of chunks that were read to count messages
    """

    schemas: dict[int, tuple[str, str, str]] = field(default_factory=dict)
    channels: dict[int, Topic] = field(default_factory=dict)
    counts: dict[int, int] | None = None
    spans: dict[int, tuple[int, int]] = field(default_factory=dict)
    chunks: list[_Chunk] = field(default_factory=list)
    indexed: bool = False
    unread: int = 0
    counted: int = 0


class McapFile:
    """A file of version 0."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._size = files.size(path, 2**63)
        self._known: _Listing | None = None

    def contents(self) -> Contents:
        """By the summary; without one, by the heads of its records.

        Raises InputError: it is no MCAP file, or nothing is left in it.
        """
        listing = self._listing()
        topics = tuple(
            replace(
                topic,
                count=None if listing.counts is None else listing.counts.get(number, 0),
                first=listing.spans.get(number, (None, None))[0],
                last=listing.spans.get(number, (None, None))[1],
            )
            for number, topic in listing.channels.items()
        )
        return Contents("MCAP file", topics, self._notes(listing))

    def _notes(self, listing: _Listing) -> tuple[str, ...]:
        if listing.indexed:
            return ()
        cut = f"; its last {listing.unread} bytes are lost" if listing.unread else ""
        left = "" if listing.counts is None else f": {sum(listing.counts.values())} messages are left"
        return (f"{self.path.name} has no summary (it was cut, or not closed){left}{cut}",)

    def messages(self, names: Collection[str], losses: Losses) -> Iterator[Message]:
        """Those of the topics of these names, in the order of the file."""
        listing = self._listing()
        state = _Listing(schemas=dict(listing.schemas), channels=dict(listing.channels))
        wanted = {number for number, topic in state.channels.items() if topic.name in names}
        passed = {
            chunk.position for chunk in listing.chunks if chunk.indices and not chunk.indices.keys() & wanted
        }
        unpacker = Unpacker(self.path)
        with files.open_binary(self.path) as file, files.as_input_error(self.path):
            try:
                for op, start, length in self._heads(file, len(MAGIC)):
                    if op in (_FOOTER, _DATA_END):
                        break
                    if op == _CHUNK and start - _HEAD.size not in passed:
                        content = self._content(file, start, length, unpacker, losses)
                        yield from self._in_content(content, state, names, losses)
                    elif op in (_SCHEMA, _CHANNEL, _MESSAGE):
                        yield from _take(op, _read(file, start, length, MAX_MESSAGE), state, names)
            except Damaged as error:
                losses.add(f"{self.path.name}: the rest of the file is lost: {error}")
        if listing.unread:
            losses.add(f"{self.path.name}: its last {listing.unread} bytes are lost")

    def _listing(self) -> _Listing:
        if self._known is None:
            with files.open_binary(self.path) as file, files.as_input_error(self.path):
                if file.read(len(MAGIC)) != MAGIC:
                    raise InputError(self.path, "is no MCAP file of version 0", "copy it again")
                self._known = self._by_summary(file) or self._by_scan(file)
        return self._known

    def _by_summary(self, file: BufferedReader) -> _Listing | None:
        """None: there is none, or it is damaged."""
        tail = _HEAD.size + 20 + len(MAGIC)
        if self._size < 2 * len(MAGIC) + tail:
            return None
        file.seek(self._size - tail)
        end = file.read(tail)
        start = int.from_bytes(end[9:17], "little")
        if end[0] != _FOOTER or not end.endswith(MAGIC) or not len(MAGIC) <= start < self._size - tail:
            return None
        listing = _Listing(indexed=True)
        try:
            for op, at, length in self._heads(file, start):
                if op in (_SCHEMA, _CHANNEL):
                    list(_take(op, _read(file, at, length, _MAX_SMALL), listing, ()))
                elif op == _CHUNK_INDEX:
                    listing.chunks.append(_chunk(_read(file, at, length, _MAX_SMALL)))
                elif op == _STATISTICS:
                    listing.counts = _counts(_read(file, at, length, _MAX_SMALL))
                elif op == _FOOTER:
                    break
            if not listing.channels and listing.counts != {}:
                return None  # a summary need not repeat them
            self._ends(file, listing)
        except (Damaged, struct.error):
            return None
        return listing

    def _ends(self, file: BufferedReader, listing: _Listing) -> None:
        """When the first and last message of each channel came, by the times behind its first and last chunk."""
        listing.chunks.sort(key=lambda chunk: chunk.position)
        first: dict[int, int] = {}
        last: dict[int, int] = {}
        for chunk in listing.chunks:
            for channel, position in (chunk.indices or {}).items():
                assert position is not None
                first.setdefault(channel, position)
                last[channel] = position
        left = _MOST_COUNTED
        for channel, position in [*first.items(), *last.items()]:
            op, length = self._head(file, position)
            left -= length
            if op != _INDEX or left < 0:
                raise Damaged("the times of a chunk are not where the summary says")
            _add_times(
                listing, _read(file, position + _HEAD.size, length, _MAX_SMALL), channel, counted=False
            )

    def _by_scan(self, file: BufferedReader) -> _Listing:
        """Record by record; the content of chunks is passed over where it is not needed."""
        listing, unpacker = _Listing(counts={}), Unpacker(self.path)
        pending, end, inside = None, len(MAGIC), set[int]()
        try:
            for op, start, length in self._heads(file, len(MAGIC)):
                if op == _INDEX and pending is not None:
                    inside.add(
                        _add_times(listing, _read(file, start, length, _MAX_SMALL), None, counted=True)
                    )
                else:
                    self._count_inside(file, pending, inside, listing, unpacker)
                    pending, inside = None, set[int]()
                end = start + length
                if op in (_FOOTER, _DATA_END):
                    end = self._size
                    break
                if op == _CHUNK:
                    pending = (start, length)
                elif op in (_SCHEMA, _CHANNEL):
                    list(_take(op, _read(file, start, length, _MAX_SMALL), listing, ()))
                elif op == _MESSAGE:
                    _count_message(_read(file, start, min(length, _MESSAGE_HEAD.size), _MAX_SMALL), listing)
        except Damaged:
            end = min(end, self._size)
        self._count_inside(file, pending, inside, listing, unpacker)
        listing.unread = max(0, self._size - end)
        if not listing.channels:
            raise InputError(self.path, "is cut before its first messages", "copy it again, or record anew")
        return listing

    def _count_inside(
        self,
        file: BufferedReader,
        chunk: tuple[int, int] | None,
        inside: set[int],
        listing: _Listing,
        unpacker: Unpacker,
    ) -> None:
        """Reads a chunk for its channels, where one is not known, and for its messages, where it has no times."""
        if chunk is not None:
            listing.chunks.append(_Chunk(chunk[0] - _HEAD.size, dict.fromkeys(inside) or None))
        if chunk is None or (inside and inside <= listing.channels.keys()):
            return
        listing.counted += chunk[1]
        if listing.counted > _MOST_COUNTED and listing.channels:
            listing.counts, listing.spans = None, {}
            return
        try:
            for op, content in _inner(self._content(file, *chunk, unpacker, Losses())):
                if op == _MESSAGE and not inside:
                    _count_message(content, listing)
                elif op in (_SCHEMA, _CHANNEL):
                    list(_take(op, content, listing, ()))
        except Damaged:
            pass

    def _head(self, file: BufferedReader, position: int) -> tuple[int, int]:
        """Kind and length of the record at a position. Raises Damaged"""
        if position > self._size:  # a summary may say what no file can be asked for
            raise Damaged("a record would begin beyond the end of the file")
        file.seek(position)
        head = file.read(_HEAD.size)
        if len(head) < _HEAD.size:
            raise Damaged("the file ends in a record")
        op, length = _HEAD.unpack(head)
        return op, length

    def _heads(self, file: BufferedReader, position: int) -> Iterator[tuple[int, int, int]]:
        """(kind, where its content begins, length) from a position on; of the last chunk also if it is cut.

        Raises Damaged: where a record begins is none.
        """
        while position < self._size:
            op, length = self._head(file, position)
            start = position + _HEAD.size
            if op == 0 or (op == _FOOTER and length != 20) or (start + length > self._size and op != _CHUNK):
                raise Damaged("the file ends in a record")
            yield op, start, length
            position = start + length
            if position == self._size - len(MAGIC) and op == _FOOTER:
                return

    def _content(
        self, file: BufferedReader, start: int, length: int, unpacker: Unpacker, losses: Losses
    ) -> memoryview:
        """The records in a chunk; what is left of them, if it is damaged."""
        try:
            if length > MAX_MESSAGE:
                raise Damaged(f"it has {length} bytes")
            chunk = _read(file, start, min(length, self._size - start), MAX_MESSAGE)
            _, _, size, crc = _CHUNK_HEAD.unpack_from(chunk)
            kind, at = _text(chunk, _CHUNK_HEAD.size)
            (stored,) = struct.unpack_from("<Q", chunk, at)
            packed = memoryview(chunk)[at + 8 : at + 8 + stored]
            content = packed if not kind else memoryview(unpacker.unpack(kind, bytes(packed), size))
        except (Damaged, struct.error) as error:
            losses.add(f"{self.path.name}: a chunk cannot be read: {error}")
            return memoryview(b"")
        if len(content) < size:
            losses.add(f"{self.path.name}: a chunk is cut")
        elif crc and zlib.crc32(content) != crc:
            losses.add(f"{self.path.name}: the checksum of a chunk is wrong, which is read all the same")
        return content

    def _in_content(
        self, content: memoryview, state: _Listing, names: Collection[str], losses: Losses
    ) -> Iterator[Message]:
        try:
            for op, data in _inner(content):
                if op in (_SCHEMA, _CHANNEL, _MESSAGE):
                    yield from _take(op, data, state, names)
        except Damaged as error:
            losses.add(f"{self.path.name}: the rest of a chunk is lost: {error}")


def _read(file: BufferedReader, start: int, length: int, most: int) -> bytes:
    if length > most:
        raise Damaged(f"a record has {length} bytes")
    file.seek(start)
    data = file.read(length)
    if len(data) < length:
        raise Damaged("the file ends in a record")
    return data


def _inner(content: memoryview) -> Iterator[tuple[int, memoryview]]:
    """(kind, content) of the records in a chunk. Raises Damaged"""
    at, end = 0, len(content)
    while at + _HEAD.size <= end:
        op, length = _HEAD.unpack_from(content, at)
        at += _HEAD.size
        if length > end - at:
            raise Damaged("a record of it goes beyond its end")
        yield op, content[at : at + length]
        at += length


def _text(data: bytes | memoryview, at: int) -> tuple[str, int]:
    """A string, and where it ends. Raises Damaged"""
    (length,) = struct.unpack_from("<I", data, at)
    end = at + 4 + length
    if end > len(data):
        raise Damaged("a text goes beyond its record")
    return bytes(data[at + 4 : end]).decode("utf-8", "replace"), end


def _take(op: int, data: bytes | memoryview, state: _Listing, names: Collection[str]) -> Iterator[Message]:
    """The message that a record is, if wanted; schemas and channels are noted.

    Raises Damaged: a length in it goes beyond its end.
    """
    try:
        if op == _SCHEMA:
            _note_schema(data, state)
        elif op == _CHANNEL:
            _note_channel(data, state)
        elif op == _MESSAGE:
            channel, _, time, _ = _MESSAGE_HEAD.unpack_from(data)
            topic = state.channels.get(channel)
            if topic is not None and topic.name in names:
                yield Message(topic, _signed(time), memoryview(data)[_MESSAGE_HEAD.size :])
    except struct.error:
        raise Damaged("a record is shorter than its kind") from None


def _signed(time: int) -> int:
    """ns: the file's numbers have no sign, but a negative one comes as one."""
    return time - 2**64 if time >= 2**63 else time


def _note_schema(data: bytes | memoryview, state: _Listing) -> None:
    (number,) = struct.unpack_from("<H", data)
    name, at = _text(data, 2)
    encoding, at = _text(data, at)
    text, _ = _text(data, at)
    state.schemas[number] = name, encoding, text[: MAX_TEXT + 1] if encoding in ("ros1msg", "ros2msg") else ""


def _note_channel(data: bytes | memoryview, state: _Listing) -> None:
    number, schema = struct.unpack_from("<HH", data)
    name, at = _text(data, 4)
    encoding, _ = _text(data, at)
    kind, _, text = state.schemas.get(schema, ("", "", ""))
    try:
        layout = Encoding(encoding)
    except ValueError:
        layout = Encoding.OTHER
    state.channels[number] = Topic(name=name, message_type=type_name(kind), encoding=layout, definition=text)


def _chunk(data: bytes) -> _Chunk:
    """Of a chunk index record."""
    _, _, position, _ = struct.unpack_from("<QQQQ", data)
    (length,) = struct.unpack_from("<I", data, 32)
    pairs = _rows(data[36 : 36 + length], np.dtype([("channel", "<u2"), ("position", "<u8")]))
    return _Chunk(position, {int(channel): int(place) for channel, place in pairs.tolist()} or None)


def _rows(data: bytes, kind: np.dtype[Any]) -> np.ndarray:
    """Whole rows of a table."""
    return np.frombuffer(data[: len(data) // kind.itemsize * kind.itemsize], kind)


def _counts(data: bytes) -> dict[int, int]:
    """Messages of each channel, of a statistics record."""
    (length,) = struct.unpack_from("<I", data, 42)
    pairs = _rows(data[46 : 46 + length], _COUNTS)
    return {int(channel): int(count) for channel, count in pairs.tolist()}


def _add_times(listing: _Listing, data: bytes, channel: int | None, *, counted: bool) -> int:
    """Notes the times of one channel in one chunk; returns the channel, by the record where None is given."""
    if len(data) < 6:
        raise Damaged("a record is shorter than its kind")
    said, length = struct.unpack_from("<HI", data)
    number = said if channel is None else channel
    times = _rows(data[6 : 6 + length], _ENTRIES)["time"]
    if len(times):
        _span(listing, number, int(times.min()), int(times.max()))
    if counted and listing.counts is not None:
        listing.counts[number] = listing.counts.get(number, 0) + len(times)
    return number


def _span(listing: _Listing, channel: int, first: int, last: int) -> None:
    before = listing.spans.get(channel, (first, last))
    listing.spans[channel] = min(first, before[0]), max(last, before[1])


def _count_message(data: bytes | memoryview, listing: _Listing) -> None:
    if len(data) < _MESSAGE_HEAD.size:
        raise Damaged("a record is shorter than its kind")
    channel, _, time, _ = _MESSAGE_HEAD.unpack_from(data)
    _span(listing, channel, _signed(time), _signed(time))
    if listing.counts is not None:
        listing.counts[channel] = listing.counts.get(channel, 0) + 1
