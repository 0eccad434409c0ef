"""Point clouds in PCD files: ascii, binary and binary_compressed, any order and types of fields."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Protocol

import numpy as np

from lvba.dataset import Scan
from lvba.errors import InputError
from lvba.io import files, finite_points, pcd_header, point_fields
from lvba.io.pcd_header import Field, Header

INTENSITY_NAMES = ("intensity", "intensities", "reflectivity", "i")
MAX_ASCII_BYTES = 256 * 1024**2
"""Longest file of text read; real scans have some megabytes."""
_PIECE_BYTES = 1_000_000
_CORRECT_LINE = "correct the line, or write the file again"


def read_pcd(path: str | Path) -> Scan:
    """The points of a PCD file, without those that have no finite position or that of the origin.

    Raises: InputError if the file is unreadable, truncated or contradicts its header, or holds no other point.
    """
    content = files.read_bytes(path)
    header = pcd_header.parse(path, content, len(content))
    columns = _DECODERS[header.encoding](path, header, content)
    points = columns.points()
    intensity = header.field(INTENSITY_NAMES)
    names = point_fields.times_of(field.name for field in header.fields)
    fields = [header.field((name.lower(),)) for name in names]
    time = point_fields.joined([columns.values(field) for field in fields if field is not None])
    return finite_points.keep(
        path,
        points,
        None if intensity is None else columns.values(intensity).astype(np.float32),
        None if time is None else time.astype(np.float64),
    )


def check_pcd(path: str | Path, content: bytes | None = None) -> int:
    """The number of points that the header of a PCD file says, checked against its size; few points are looked at.

    content: of the file, if it is at hand; else only its start is read
    Raises: InputError
    """
    size = files.size(path) if content is None else len(content)
    start = files.read_start(path, pcd_header.MAX_HEADER_BYTES) if content is None else content
    header = pcd_header.parse(path, start, size)
    if content is not None and header.encoding == "binary":
        _check_sample(path, _Binary(path, header, content))
    if content is not None and header.encoding == "ascii":
        _check_lines(path, header, content)
    return header.points


def _check_sample(path: str | Path, columns: "_Binary") -> None:
    """That there are points with a position; all are looked at only if none of a thousand has one."""
    x = columns.values(_position_fields(columns.header)[0])
    sample = x[:: max(1, len(x) // 1000)]
    if not (np.isfinite(sample) & (sample != 0)).any():
        finite_points.keep(path, columns.points(), None, None)


def write_pcd(
    path: str | Path,
    points: np.ndarray,
    intensity: np.ndarray | None = None,
    time: np.ndarray | None = None,
    encoding: str = "binary",
) -> None:
    """Writes a PCD file.

    points: (N, 3), m, written as float32; intensity: (N,), as float32, in the sensor's unit; time: (N,) s, as float64
    encoding: ascii, binary or binary_compressed
    Raises: InputError if the file cannot be written.
    """
    types = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
    types += [] if intensity is None else [("intensity", "<f4")]
    types += [] if time is None else [("time", "<f8")]
    table = np.empty(len(points), np.dtype(types))
    for axis, name in enumerate("xyz"):
        table[name] = points[:, axis]
    if intensity is not None:
        table["intensity"] = intensity
    if time is not None:
        table["time"] = time
    files.write_bytes(path, _header_text(table, encoding).encode() + _ENCODERS[encoding](table))


class _Columns(Protocol):
    """The data of a PCD file, field by field."""

    def __init__(self, path: str | Path, header: Header, content: bytes) -> None: ...

    def values(self, field: Field) -> np.ndarray:
        """(N,) of the field's type, or float64: its first value at each point."""

    def points(self) -> np.ndarray:
        """(N, 3) float32."""


class _Binary:
    """Columns of point after point, in the types of the header."""

    def __init__(self, path: str | Path, header: Header, content: bytes) -> None:
        used = header.points * header.point_bytes
        surplus = content[header.data_start + used :]
        if len(surplus) >= header.point_bytes and surplus.strip(b"\0"):  # old PCL pads files with zeros
            held = (len(content) - header.data_start) // header.point_bytes
            raise InputError(
                path,
                f"the header says {header.points} points, the file holds {held}",
                "correct POINTS and WIDTH in its header",
            )
        self.header = header
        self.rows = np.frombuffer(content, np.uint8, used, header.data_start).reshape(header.points, -1)

    def values(self, field: Field) -> np.ndarray:
        """(N,) of the field's type: its first value at each point."""
        dtype = np.dtype({"names": ["v"], "formats": [field.dtype], "offsets": [field.offset],
                          "itemsize": self.header.point_bytes})  # fmt: skip
        return self.rows.reshape(-1).view(dtype)["v"]

    def points(self) -> np.ndarray:
        """(N, 3) float32."""
        x, y, z = _position_fields(self.header)
        if x.dtype == y.dtype == z.dtype and y.offset - x.offset == z.offset - y.offset == x.dtype.itemsize:
            dtype = np.dtype({"names": ["v"], "formats": [(x.dtype, (3,))], "offsets": [x.offset],
                              "itemsize": self.header.point_bytes})  # fmt: skip
            return _to_float32(self.rows.reshape(-1).view(dtype)["v"])
        return np.stack([_to_float32(self.values(field)) for field in (x, y, z)], axis=1)


class _Compressed:
    """Columns of LZF-compressed data, in which all values of a field follow each other."""

    def __init__(self, path: str | Path, header: Header, content: bytes) -> None:
        from lvba.kernels import lzf  # here: other files are read without the compiler

        packed_size, plain_size = (int(v) for v in np.frombuffer(content, "<u4", 2, header.data_start))
        held = len(content) - header.data_start - 8
        if packed_size > held:
            raise InputError(
                path, f"truncated: {packed_size} compressed bytes announced, {held} there", "copy it again"
            )
        needed = header.points * header.point_bytes
        if plain_size != needed:
            raise InputError(
                path,
                f"the header's {header.points} points need {needed} bytes, the compressed data hold {plain_size}",
                "correct POINTS and WIDTH in its header",
            )
        damaged = InputError(path, "its compressed data are damaged", "copy it again")
        if plain_size > packed_size * lzf.MAX_EXPANSION:
            raise damaged
        self.header = header
        self.plain = np.empty(plain_size, np.uint8)
        packed = np.frombuffer(content, np.uint8, packed_size, header.data_start + 8)
        if lzf.decompress(packed, self.plain) != plain_size:
            raise damaged

    def values(self, field: Field) -> np.ndarray:
        """(N,) of the field's type: its first value at each point."""
        count = self.header.points
        column = self.plain[field.offset * count :][: field.dtype.itemsize * field.count * count]
        return column.view(field.dtype).reshape(count, field.count)[:, 0]

    def points(self) -> np.ndarray:
        """(N, 3) float32."""
        return np.stack([_to_float32(self.values(field)) for field in _position_fields(self.header)], axis=1)


class _Ascii:
    """Columns of text, one point a line."""

    def __init__(self, path: str | Path, header: Header, content: bytes) -> None:
        _check_lines(path, header, content)
        pieces = [
            _parse_words(path, content, start, stop) for start, stop in _pieces(content, header.data_start)
        ]
        table = np.concatenate(pieces)
        self.table = table.reshape(header.points, header.point_values)
        self.header = header

    def values(self, field: Field) -> np.ndarray:
        """(N,) float64: the field's first value at each point."""
        return self.table[:, field.column]

    def points(self) -> np.ndarray:
        """(N, 3) float32."""
        return _to_float32(self.table[:, [field.column for field in _position_fields(self.header)]])


def _check_lines(path: str | Path, header: Header, content: bytes) -> None:
    """That there are as many lines as the header says, each with as many words as a point has values."""
    if len(content) > MAX_ASCII_BYTES:
        raise InputError(path, f"more than {MAX_ASCII_BYTES} bytes of text", "write it as binary")
    text = np.frombuffer(content, np.uint8, offset=header.data_start)
    space = text <= ord(" ")
    starts = np.flatnonzero(~space & np.concatenate([[True], space[:-1]]))
    line_ends = np.append(np.flatnonzero(text == ord("\n")), len(text))
    words = np.diff(np.searchsorted(starts, line_ends), prepend=0)
    lines = np.flatnonzero(words)
    bad = lines[words[lines] != header.point_values]
    if len(bad) and (len(lines) == header.points or bad[0] != lines[-1]):
        line = content.count(b"\n", 0, header.data_start) + 1 + bad[0]
        raise InputError(
            f"{path}:{line}", f"{words[bad[0]]} values instead of {header.point_values}", _CORRECT_LINE
        )
    if len(lines) != header.points:
        raise InputError(
            path,
            f"the header says {header.points} points, the file holds {len(lines)}",
            "copy it again, or correct POINTS and WIDTH in its header",
        )


def _pieces(content: bytes, start: int) -> Iterator[tuple[int, int]]:
    """Start and stop of whole lines, about a million bytes together: words take much more memory than text."""
    while start < len(content):
        stop = content.find(b"\n", start + _PIECE_BYTES) + 1 or len(content)
        yield start, stop
        start = stop


def _parse_words(path: str | Path, content: bytes, start: int, stop: int) -> np.ndarray:
    """The numbers between two places, float64."""
    words = content[start:stop].split()
    try:
        return np.fromiter(map(float, words), np.float64, len(words))
    except ValueError as error:
        line = content.count(b"\n", 0, start) + 1
        for number, text in enumerate(content[start:stop].split(b"\n"), line):
            for word in text.split():
                if not _is_number(word):
                    shown = ascii(word[:40].decode("ascii", "replace"))
                    raise InputError(f"{path}:{number}", f"{shown} is no number", _CORRECT_LINE) from error
        raise


def _is_number(word: bytes) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _position_fields(header: Header) -> tuple[Field, Field, Field]:
    x, y, z = (header.field((name,)) for name in "xyz")
    assert x is not None and y is not None and z is not None  # noqa: PT018 - parse has checked
    return x, y, z


def _to_float32(values: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore", invalid="ignore"):
        return np.ascontiguousarray(values, np.float32)


def _header_text(table: np.ndarray, encoding: str) -> str:
    names = table.dtype.names or ()
    sizes = " ".join(str(table.dtype[name].itemsize) for name in names)
    types, counts = " ".join("F" for _ in names), " ".join("1" for _ in names)
    return (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n"
        f"FIELDS {' '.join(names)}\nSIZE {sizes}\nTYPE {types}\nCOUNT {counts}\n"
        f"WIDTH {len(table)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(table)}\nDATA {encoding}\n"
    )


def _encode_ascii(table: np.ndarray) -> bytes:
    rows = (
        " ".join(repr(float(str(value))) for value in row) for row in table
    )  # shortest text of the same float32
    return "".join(f"{row}\n" for row in rows).encode()


def _encode_compressed(table: np.ndarray) -> bytes:
    from lvba.kernels import lzf

    plain = np.frombuffer(b"".join(table[name].tobytes() for name in table.dtype.names or ()), np.uint8)
    packed = np.empty(plain.size + plain.size // 32 + 2, np.uint8)
    packed = packed[: lzf.compress(plain, packed)]
    return np.array([packed.size, plain.size], "<u4").tobytes() + packed.tobytes()


_DECODERS: dict[str, type[_Columns]] = {"ascii": _Ascii, "binary": _Binary, "binary_compressed": _Compressed}
_ENCODERS: dict[str, Callable[[np.ndarray], bytes]] = {
    "ascii": _encode_ascii,
    "binary": lambda table: table.tobytes(),
    "binary_compressed": _encode_compressed,
}
