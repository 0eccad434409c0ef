"""Point clouds as binary little-endian PLY, with as many fields per point as there are columns."""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np

from lvba.errors import InputError
from lvba.io import files, stream

CHUNK = 1 << 18
"""Points converted and written at a time."""
_MAX_HEADER = 1 << 16
_NAMES = {
    "f4": "float",
    "f8": "double",
    "u1": "uchar",
    "u2": "ushort",
    "u4": "uint",
    "i1": "char",
    "i2": "short",
    "i4": "int",
}
_TYPES = {name: code for code, name in _NAMES.items()} | {
    "float32": "f4",
    "float64": "f8",
    "uint8": "u1",
    "uint16": "u2",
    "uint32": "u4",
    "int8": "i1",
    "int16": "i2",
    "int32": "i4",
}


def write_ply(path: str | Path, columns: Mapping[str, np.ndarray], comments: tuple[str, ...] = ()) -> None:
    """Writes one vertex per row of the columns, in their order and types (float32, float64, 8 to 32 bit integers).

    columns: name to (N,) array, for example x, y, z, red, green, blue, views, spread
    Raises: InputError if the file cannot be written; ValueError for a type that PLY does not have.
    """
    write_ply_pieces(path, len(next(iter(columns.values()))), [columns], comments)


def write_ply_pieces(
    path: str | Path, count: int, pieces: Iterable[Mapping[str, np.ndarray]], comments: tuple[str, ...] = ()
) -> None:
    """Writes the rows of all pieces, one after the other; as `write_ply`, but not all are in memory at a time.

    count: rows of all pieces together, at least one piece; all have the columns of the first, of the same types
    """
    table = None
    with stream.writer(path) as file:
        for columns in pieces:
            if table is None:
                table = _row_type(columns)
                file.write(_header(columns, count, comments))
            here = len(next(iter(columns.values())))
            for first in range(0, here, CHUNK):
                rows = np.empty(min(CHUNK, here - first), table)
                for name, values in columns.items():
                    rows[name] = values[first : first + CHUNK]
                file.write(rows.data)
            count -= here
        if count:
            raise ValueError(f"{count} rows more were announced than there are")


def _header(columns: Mapping[str, np.ndarray], count: int, comments: tuple[str, ...]) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    lines += [f"element vertex {count}"]
    lines += [f"property {_NAMES[columns[name].dtype.str[1:]]} {name}" for name in columns]
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii", "replace")


def read_ply(path: str | Path) -> dict[str, np.ndarray]:
    """The columns of the vertices of a binary little-endian PLY without lists, as name to (N,) array.

    Raises: InputError if it is another kind of PLY, or shorter than its header says.
    """
    columns = {}
    for chunk in read_ply_chunks(path, chunk=1 << 62):
        columns = {name: chunk[name].copy() for name in chunk.dtype.names or ()}
    return columns


def read_ply_chunks(path: str | Path, chunk: int = CHUNK) -> Iterator[np.ndarray]:
    """The vertices in pieces of at most `chunk`, as structured arrays; at least one piece, maybe empty.

    Raises: InputError as read_ply.
    """
    table, count, start = _read_header(path)
    if files.size(path, limit=1 << 62) < start + count * table.itemsize:
        raise InputError(path, f"holds fewer than the {count} points of its header", "write or copy it again")
    with files.as_input_error(path), open(path, "rb") as file:
        file.seek(start)
        for first in range(0, max(count, 1), chunk):
            yield np.fromfile(file, table, min(chunk, count - first))


def count(path: str | Path) -> int:
    """How many vertices a file says that it has.

    Raises: InputError
    """
    return _read_header(path)[1]


def _row_type(columns: Mapping[str, np.ndarray]) -> np.dtype:
    for name, values in columns.items():
        if values.dtype.str[1:] not in _NAMES:
            raise ValueError(f"column {name} is {values.dtype}, which PLY does not have")
    return np.dtype([(name, values.dtype.newbyteorder("<")) for name, values in columns.items()])


def _read_header(path: str | Path) -> tuple[np.dtype, int, int]:
    """The row type, the number of vertices, and where they start."""
    head = _start(path)
    end = head.find(b"end_header\n")
    if not head.startswith(b"ply\n") or end < 0:
        raise InputError(path, "is not a PLY file", "give a map.ply of a result folder")
    lines = [line.split() for line in head[:end].decode("ascii", "replace").splitlines()]
    if ["format", "binary_little_endian", "1.0"] not in lines:
        raise InputError(path, "is not a binary little-endian PLY", "convert it")
    elements = [words for words in lines if words[:1] == ["element"]]
    properties = [words for words in lines if words[:1] == ["property"]]
    try:
        ((_, element, count),) = elements
        rows = np.dtype([(name, "<" + _TYPES[kind]) for _, kind, name in properties])
        if element != "vertex" or int(count) < 0:
            raise ValueError(element)
    except (ValueError, KeyError) as error:
        raise InputError(path, "holds other things than plain vertices", "convert it") from error
    return rows, int(count), end + len(b"end_header\n")


def _start(path: str | Path) -> bytes:
    files.size(path, limit=1 << 62)
    with files.as_input_error(path), open(path, "rb") as file:
        return file.read(_MAX_HEADER)
