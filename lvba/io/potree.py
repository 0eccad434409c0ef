"""Point clouds with levels of detail in the layout of Potree 2: metadata.json, hierarchy.bin and octree.bin.

The attributes of a point stand together, uncompressed (encoding DEFAULT); the whole hierarchy is one chunk. Viewers fetch
the nodes that they need out of octree.bin by byte ranges.
"""

import json
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lvba.errors import InputError
from lvba.io import files, stream

METADATA, HIERARCHY, OCTREE = "metadata.json", "hierarchy.bin", "octree.bin"
_NODE = np.dtype([("type", "u1"), ("children", "u1"), ("points", "<u4"), ("offset", "<u8"), ("bytes", "<u8")])
_INNER, _LEAF = 0, 1
_TYPES = {
    "i1": "int8",
    "i2": "int16",
    "i4": "int32",
    "u1": "uint8",
    "u2": "uint16",
    "u4": "uint32",
    "f4": "float",
    "f8": "double",
}


@dataclass(frozen=True)
class Frame:
    """Where the octree is, and how whole numbers become meters: x = offset + scale * X.

    offset: (3,) float64, m, its low corner; edge: of its cube, m; bits: X is in [0, 2^bits)
    """

    offset: np.ndarray
    edge: float
    bits: int

    @property
    def scale(self) -> float:
        """Meters per step."""
        return self.edge / (1 << self.bits)


@dataclass(frozen=True)
class Nodes:
    """The nodes of an octree, by level, then by path.

    level: (K,) int64; path: (K,) uint64, three bits per level, x y z from the highest; points: (K,) int64;
    first: (K,) int64, where its points begin in octree.bin, counted in points
    """

    level: np.ndarray
    path: np.ndarray
    points: np.ndarray
    first: np.ndarray

    def __len__(self) -> int:
        return len(self.level)


def row_type(columns: np.dtype, more: Mapping[str, str] | None = None) -> np.dtype:
    """How a point is stored: position, rgb, then every other column by its own name and type, then those of `more`."""
    others = [(name, columns[name].newbyteorder("<")) for name in columns.names or () if name not in _OWN]
    added = [(name, kind) for name, kind in (more or {}).items() if name not in (columns.names or ())]
    return np.dtype([("position", "<i4", 3), ("rgb", "<u2", 3), *others, *added])


_OWN = ("x", "y", "z", "red", "green", "blue")


class Scratch:
    """Points on disk that need not fit into memory, at given places; gone when it is closed."""

    def __init__(self, folder: Path, rows: np.dtype) -> None:
        """Raises: InputError if nothing can be written to the folder."""
        self.rows, self._folder = rows, folder
        with files.as_input_error(folder):
            self._file = tempfile.TemporaryFile(prefix=".points.", dir=folder)  # noqa: SIM115 - closed by `close`

    def put(self, first: int, points: np.ndarray) -> None:
        """Writes rows from place `first` on.

        points: (n,) of the dtype `rows`
        """
        with files.as_input_error(self._folder):
            self._file.seek(first * self.rows.itemsize)
            self._file.write(np.ascontiguousarray(points).data)

    def get(self, first: int, count: int) -> np.ndarray:
        """`count` rows from place `first` on, (count,) of the dtype `rows`."""
        with files.as_input_error(self._folder):
            self._file.seek(first * self.rows.itemsize)
            return np.fromfile(self._file, self.rows, count)

    def close(self) -> None:
        """Removes the file."""
        self._file.close()


def write_points(folder: Path, pieces: Iterable[np.ndarray]) -> None:
    """Writes octree.bin: the rows of the pieces, one after the other. Raises: InputError"""
    with stream.writer(folder / OCTREE) as file:
        for piece in pieces:
            file.write(np.ascontiguousarray(piece).data)


def write_hierarchy(folder: Path, nodes: Nodes, rows: np.dtype) -> None:
    """Writes hierarchy.bin, from the root breadth first. Raises: InputError"""
    table = np.zeros(len(nodes), _NODE)
    table["points"] = nodes.points
    table["offset"] = nodes.first * rows.itemsize
    table["bytes"] = nodes.points * rows.itemsize
    table["children"] = _child_masks(nodes)
    table["type"] = np.where(table["children"] == 0, _LEAF, _INNER)
    files.write_bytes(folder / HIERARCHY, table.tobytes())


def _child_masks(nodes: Nodes) -> np.ndarray:
    masks = np.zeros(len(nodes), np.uint8)
    starts = np.searchsorted(nodes.level, np.arange(nodes.level.max() + 2))
    for level in range(1, len(starts) - 1):
        children = nodes.path[starts[level] : starts[level + 1]]
        parents = nodes.path[starts[level - 1] : starts[level]]
        place = starts[level - 1] + np.searchsorted(parents, children >> np.uint64(3))
        np.bitwise_or.at(masks, place, (1 << (children & np.uint64(7)).astype(np.uint8)).astype(np.uint8))
    return masks


def write_metadata(
    folder: Path,
    frame: Frame,
    nodes: Nodes,
    rows: np.dtype,
    ranges: dict[str, tuple[Any, Any]],
    spacing: float,
    source: Mapping[str, str],
) -> None:
    """Writes metadata.json.

    ranges: least and greatest value of each attribute, in meters for the position
    source: what the points were read from; Potree does not ask for it
    """
    corner = frame.offset.tolist()
    content = {
        "version": "2.0",
        "name": "map",
        "description": "",
        "points": int(nodes.points.sum()),
        "projection": "",
        "hierarchy": {
            "firstChunkSize": len(nodes) * _NODE.itemsize,
            "stepSize": 4,
            "depth": int(nodes.level.max()),
        },
        "offset": corner,
        "scale": [frame.scale] * 3,
        "spacing": spacing,
        "boundingBox": {"min": corner, "max": [low + frame.edge for low in corner]},
        "encoding": "DEFAULT",
        "attributes": [_attribute(name, rows[name], ranges[name]) for name in rows.names or ()],
        "source": dict(source),
    }
    files.write_text(folder / METADATA, json.dumps(content, indent=1))


def _attribute(name: str, kind: np.dtype, values: tuple[Any, Any]) -> dict[str, Any]:
    low, high = (np.atleast_1d(value).astype(float).tolist() for value in values)
    return {
        "name": name,
        "description": "",
        "size": kind.itemsize,
        "numElements": int(np.prod(kind.shape, dtype=int)),
        "elementSize": kind.base.itemsize,
        "type": _TYPES[kind.base.str[1:]],
        "min": low,
        "max": high,
    }


def read_nodes(folder: str | Path) -> Iterator[tuple[str, np.ndarray]]:
    """The name ("r", "r0", "r04" ...) and the rows of each node, breadth first.

    Raises: InputError if the files do not fit together.
    """
    folder = Path(folder)
    metadata = json.loads(files.read_text(folder / METADATA))
    kinds = {name: code for code, name in _TYPES.items()}
    rows = np.dtype(
        [(a["name"], "<" + kinds[a["type"]], (a["numElements"],) if a["numElements"] > 1 else ())
         for a in metadata["attributes"]]
    )  # fmt: skip
    table = np.frombuffer(files.read_bytes(folder / HIERARCHY), _NODE)
    if files.size(folder / OCTREE, 1 << 62) != int(table["bytes"].sum()):
        raise InputError(folder / OCTREE, "does not fit its hierarchy", "export it again")
    points = np.memmap(folder / OCTREE, np.uint8, "r") if table["bytes"].sum() else np.empty(0, np.uint8)
    names = ["r"]
    for place, node in enumerate(table):
        names += [names[place] + str(child) for child in range(8) if node["children"] >> child & 1]
        first = int(node["offset"])
        yield names[place], points[first : first + int(node["bytes"])].view(rows)
