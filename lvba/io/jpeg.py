"""Whether the data of a JPEG file are whole: every block there, every code valid, and nothing left over.

A decoder fills what is missing with gray and only mutters. Baseline files with all components in one scan (what cameras
and OpenCV write) are walked through; others, such as progressive ones, pass by their end marker alone. Damage that
by chance leaves the right number of blocks passes too: codes fall into step again after some bytes.
"""

import functools
from dataclasses import dataclass, field

import numpy as np

_BARE = frozenset(range(0xD0, 0xD9)) | {0x01}
_SIZES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_BASELINE = (0xC0, 0xC1)
_TRUNCATED = "truncated: its end is missing"
_DAMAGED = "damaged: its data cannot be decoded to the end"


@dataclass
class Segments:
    """What stands before the first scan's data. `data_start` is -1 where the file ends before them."""

    data_start: int = -1
    frame_marker: int = 0
    frame: bytes = b""
    """Precision, height, width, count, then identifier, sampling and quantization table of each component."""
    scan: bytes = b""
    tables: dict[int, bytes] = field(default_factory=dict)
    """16 counts, then symbols; by class (0: DC, 16: AC) plus number."""
    restart_interval: int = 0

    @property
    def size(self) -> tuple[int, int] | None:
        """Width and height, px, if the frame was met."""
        if len(self.frame) < 5:
            return None
        return int.from_bytes(self.frame[3:5], "big"), int.from_bytes(self.frame[1:3], "big")


def read_segments(content: bytes) -> Segments:
    """The segments of a file, or of its start, up to the first scan."""
    segments = Segments()
    position = 2
    while position + 4 <= len(content) and content[position] == 0xFF:
        marker = content[position + 1]
        if marker == 0xFF or marker in _BARE:  # fill byte, marker without content
            position += 1 if marker == 0xFF else 2
            continue
        length = int.from_bytes(content[position + 2 : position + 4], "big")
        body = content[position + 4 : position + 2 + length]
        position += 2 + length
        if marker in _SIZES:
            segments.frame_marker, segments.frame = marker, body
        elif marker == 0xC4:
            _add_tables(segments.tables, body)
        elif marker == 0xDD:
            segments.restart_interval = int.from_bytes(body[:2], "big")
        elif marker == 0xDA:
            segments.scan = body
            segments.data_start = position if position <= len(content) else -1
            break
    return segments


def problem(content: bytes) -> str:
    """What is wrong with the data of a JPEG file; empty: nothing that can be seen without making pixels."""
    segments = read_segments(content)
    if segments.data_start < 0 or content.rfind(b"\xff\xd9") < segments.data_start:
        return _TRUNCATED
    layout = _layout(segments)
    if layout is None:
        return ""
    pieces = _pieces(content, segments.data_start)
    if pieces is None:
        return _DAMAGED
    return "" if _is_whole(pieces, layout, segments.restart_interval) else _DAMAGED


@dataclass(frozen=True)
class _Layout:
    """Coded units in the scan, and the arguments of `jpeg.walk` for each."""

    units: int
    codes: np.ndarray
    dc: np.ndarray
    ac: np.ndarray


def _add_tables(tables: dict[int, bytes], body: bytes) -> None:
    while len(body) >= 17:
        length = 17 + sum(body[1:17])
        tables[body[0]] = body[1:length]
        body = body[length:]


def _layout(segments: Segments) -> _Layout | None:
    """None where the walk does not apply."""
    frame, scan = segments.frame, segments.scan
    size = segments.size
    if segments.frame_marker not in _BASELINE or size is None or len(frame) < 6 or frame[0] != 8 or not scan:
        return None
    count = frame[5]
    if scan[0] != count or len(frame) < 6 + 3 * count or len(scan) < 1 + 2 * count or not 1 <= count <= 4:
        return None
    samplings = {frame[6 + 3 * i]: (frame[7 + 3 * i] >> 4, frame[7 + 3 * i] & 15) for i in range(count)}
    rows: dict[int, int] = {}
    dc: list[int] = []
    ac: list[int] = []
    for i in range(count):
        horizontal, vertical = (1, 1) if count == 1 else samplings.get(scan[1 + 2 * i], (0, 0))
        selector = scan[2 + 2 * i]
        keys = (selector >> 4, 16 + (selector & 15))
        if not 1 <= horizontal * vertical <= 16 or any(key not in segments.tables for key in keys):
            return None
        blocks = horizontal * vertical
        dc += [rows.setdefault(keys[0], len(rows))] * blocks
        ac += [rows.setdefault(keys[1], len(rows))] * blocks
    wide = 8 * (1 if count == 1 else max(h for h, _ in samplings.values()))
    high = 8 * (1 if count == 1 else max(v for _, v in samplings.values()))
    units = -(-size[0] // wide) * -(-size[1] // high)
    codes = _lookups(tuple(segments.tables[key] for key in rows))
    return _Layout(units, codes, np.array(dc, np.int64), np.array(ac, np.int64))


@functools.lru_cache(maxsize=8)  # most files carry the same tables
def _lookups(tables: tuple[bytes, ...]) -> np.ndarray:
    """(T, 65536) uint16, `_lookup` of each table."""
    return np.stack([_lookup(table) for table in tables])


def _lookup(table: bytes) -> np.ndarray:
    """(65536,) uint16: code length times 256 plus symbol, for all 16 bits that start with the code; 0: no code."""
    lengths = np.repeat(np.arange(1, 17), np.frombuffer(table, np.uint8, 16))
    symbols = np.frombuffer(table, np.uint8, offset=16)[: len(lengths)]
    lengths = lengths[: len(symbols)]
    spans = 1 << (16 - lengths)
    entries = np.repeat((lengths * 256 + symbols).astype(np.uint16), spans)[:65536]
    return np.concatenate([entries, np.zeros(65536 - len(entries), np.uint16)])


def _pieces(content: bytes, start: int) -> list[np.ndarray] | None:
    """The data between restart markers, without stuffed zeros; None if another marker than the end stops them."""
    data = np.frombuffer(content, np.uint8, offset=start)
    full = np.flatnonzero(data[:-1] == 0xFF)
    following = data[full + 1]
    is_mark = (following != 0) & (following != 0xFF)
    marks, kinds = full[is_mark], following[is_mark]
    ends = np.flatnonzero((kinds < 0xD0) | (kinds > 0xD7))
    if not len(ends) or kinds[ends[0]] != 0xD9:
        return None
    stuffed = full[following == 0] + 1
    stops = marks[: ends[0] + 1]
    starts = np.concatenate([[0], stops[:-1] + 2])
    return [
        np.delete(data[first:stop], stuffed[(stuffed > first) & (stuffed < stop)] - first)
        for first, stop in zip(starts, stops, strict=True)
    ]


def _is_whole(pieces: list[np.ndarray], layout: _Layout, interval: int) -> bool:
    from lvba.kernels import jpeg  # here: a header is read without the compiler

    interval = interval or layout.units
    if len(pieces) != -(-layout.units // interval):
        return False
    left = layout.units
    for piece in pieces:
        padding = np.zeros(-len(piece) % 4, np.uint8)
        words = np.concatenate([piece, padding]).view(">u4").astype(np.uint32)
        units = min(interval, left)
        bits = jpeg.walk(words, 8 * len(piece), layout.codes, layout.dc, layout.ac, units)
        left -= interval
        rest = piece[(bits + 7) // 8 :]
        if bits < 0 or not ((rest == 0) | (rest == 0xFF)).all():  # some encoders pad, none leaves data
            return False
    return True
