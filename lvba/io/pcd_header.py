"""The header of a PCD file: what its bytes mean, checked against the size of the file before anything is allocated."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lvba.errors import InputError

MAX_HEADER_BYTES = 64 * 1024
_MAX_POINT_BYTES = 64 * 1024
_MAX_DIGITS = 18
_REWRITE = "write the file again with a tool that follows PCD 0.7"
_TYPES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}
_ENCODINGS = ("ascii", "binary", "binary_compressed")


@dataclass(frozen=True)
class Field:
    """One field of a point: `count` values of one type."""

    name: str
    dtype: np.dtype
    count: int
    offset: int
    """Bytes from the start of the point."""
    column: int
    """Values from the start of the point."""


@dataclass(frozen=True)
class Header:
    """What a PCD header says."""

    fields: tuple[Field, ...]
    points: int
    encoding: str
    data_start: int
    """Bytes from the start of the file."""

    @property
    def point_bytes(self) -> int:
        """Bytes of a point in a binary file."""
        last = self.fields[-1]
        return last.offset + last.dtype.itemsize * last.count

    @property
    def point_values(self) -> int:
        """Numbers of a point in a text file."""
        return self.fields[-1].column + self.fields[-1].count

    def field(self, names: tuple[str, ...]) -> Field | None:
        """The first field with one of the names (lower case), or None."""
        return next((field for name in names for field in self.fields if field.name.lower() == name), None)


def parse(path: str | Path, content: bytes, file_size: int) -> Header:
    """The header at the start of `content`, of a file of `file_size` bytes.

    Raises: InputError if it is malformed, or announces more than the file can hold.
    """
    entries, data_start = _entries(path, content)
    fields = _fields(path, entries)
    encoding = " ".join(entries["DATA"]).lower()
    if encoding not in _ENCODINGS:
        raise InputError(path, f"DATA is {encoding[:40]!r}", f"write it as one of {', '.join(_ENCODINGS)}")
    header = Header(fields, _point_count(path, entries), encoding, data_start)
    _check_size(path, header, file_size - data_start)
    return header


def _entries(path: str | Path, content: bytes) -> tuple[dict[str, list[str]], int]:
    """Words after each key, and where the data start."""
    entries: dict[str, list[str]] = {}
    start = 0
    while start < min(len(content), MAX_HEADER_BYTES):
        end = content.find(b"\n", start, MAX_HEADER_BYTES)
        if end < 0:
            break
        words = content[start:end].decode("ascii", "replace").split()
        start = end + 1
        if not words or words[0].startswith("#"):
            continue
        key = "FIELDS" if words[0] == "COLUMNS" else words[0]  # its name before PCD 0.7
        entries[key] = words[1:]
        if key == "DATA":
            return entries, start
    raise InputError(path, "no PCD header that ends in a DATA line", "give a PCD file that is complete")


def _fields(path: str | Path, entries: dict[str, list[str]]) -> tuple[Field, ...]:
    names = entries.get("FIELDS", [])
    if not names:
        raise InputError(path, "the header has no FIELDS", _REWRITE)
    sizes = _numbers(path, entries, "SIZE", ["4"] * len(names), len(names))
    types = entries.get("TYPE", ["F"] * len(names))
    counts = _numbers(path, entries, "COUNT", ["1"] * len(names), len(names))
    if len(types) != len(names):
        raise InputError(path, f"{len(names)} FIELDS but {len(types)} TYPE entries", _REWRITE)
    fields, offset, column = [], 0, 0
    for name, size, kind, count in zip(names, sizes, types, counts, strict=True):
        if size not in _TYPES.get(kind.upper(), ()):
            raise InputError(path, f"field {name[:40]!r} has TYPE {kind[:8]} and SIZE {size}", _REWRITE)
        fields.append(Field(name, np.dtype(f"<{kind.lower()}{size}"), count, offset, column))
        offset, column = offset + size * count, column + count
        if offset > _MAX_POINT_BYTES:
            raise InputError(path, f"more than {_MAX_POINT_BYTES} bytes per point", _REWRITE)
    _check_position(path, fields)
    return tuple(fields)


def _check_position(path: str | Path, fields: list[Field]) -> None:
    for name in ("x", "y", "z"):
        matching = [field for field in fields if field.name.lower() == name]
        if len(matching) != 1 or matching[0].count != 1:
            names = " ".join(field.name for field in fields)[:80]
            raise InputError(path, f"needs one field {name!r}, but FIELDS are {names!r}", _REWRITE)


def _numbers(
    path: str | Path, entries: dict[str, list[str]], key: str, default: list[str], length: int
) -> list[int]:
    words = entries.get(key, default)
    if len(words) != length:
        raise InputError(path, f"{key} has {len(words)} entries instead of {length}", _REWRITE)
    return [_number(path, key, word) for word in words]


def _number(path: str | Path, key: str, word: str) -> int:
    if not (word.isascii() and word.isdigit()) or len(word) > _MAX_DIGITS:
        raise InputError(path, f"{key} holds {word[:40]!r}, not a count", _REWRITE)
    return int(word)


def _point_count(path: str | Path, entries: dict[str, list[str]]) -> int:
    """POINTS, or WIDTH times HEIGHT; they must agree if both are there."""
    counts = {}
    if "POINTS" in entries:
        counts["POINTS"] = _numbers(path, entries, "POINTS", [], 1)[0]
    if "WIDTH" in entries:
        height = _numbers(path, entries, "HEIGHT", ["1"], 1)[0]
        counts["WIDTH x HEIGHT"] = _numbers(path, entries, "WIDTH", [], 1)[0] * height
    if not counts:
        raise InputError(path, "the header has neither POINTS nor WIDTH", _REWRITE)
    if len(set(counts.values())) > 1:
        said = " but ".join(f"{key} is {value}" for key, value in counts.items())
        raise InputError(path, f"header contradicts itself: {said}", "correct the header")
    count = next(iter(counts.values()))
    if count == 0:
        raise InputError(path, "an empty scan: the header says 0 points", "remove the file")
    return count


def _check_size(path: str | Path, header: Header, available: int) -> None:
    """That so many points can be in so many bytes (a compressed file is checked when its sizes are read)."""
    if header.encoding == "binary":
        least = header.points * header.point_bytes
    elif header.encoding == "ascii":
        least = header.points * 2 * header.point_values - 1  # a digit and a separator
    else:
        least = 8
    if available < least:
        raise InputError(
            path,
            f"truncated: {header.points} points need {least} bytes of data, the file holds {max(available, 0)}",
            "copy it again, or correct POINTS in its header",
        )
