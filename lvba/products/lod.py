"""A map of any size as an octree with levels of detail, so that a viewer loads only what it shows.

The layout is Potree 2's: a node holds a sample of the points in its cube, evenly spaced, and its eight children hold what
is in between; a node is shown with all nodes above it. The points are the map's own: none is moved by more than half a
step of the coordinates (0.05 mm in a cube of up to 200 km), none left out, none doubled.

Memory does not grow with the map: points are sorted by cubes into a file first, and one cube after the other is made into
nodes. The grids of all levels above end where a cube ends, so this samples the same points as doing all at once.
"""

import contextlib
import json
import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lvba.arrays import Vector
from lvba.errors import InputError
from lvba.io import files, ply, potree
from lvba.io.potree import Frame, Nodes, Scratch
from lvba.kernels import flatness
from lvba.kernels import octree as kernels
from lvba.progress import Progress, silent

_STEP_M = 0.0001
ERROR = "plane_error"
"""An attribute of points: distance, m, from the plane through the points round it; NaN where there is none."""
_PLANE_M = 0.5
"""Largest edge of the cells that planes are fitted in."""
_CHUNK_LEVEL = kernels.GRID_LEVELS
"""Points are counted in cubes of this level; deeper ones would cut through cells of the root's grid."""


@dataclass(frozen=True)
class LodConfig:
    """How the octree is cut."""

    leaf_points: int = 20_000
    """A node of at most so many points has no children."""
    chunk_points: int = 2_000_000
    """Points that are made into nodes at a time; far more than `leaf_points`, for larger cubes are divided."""


@dataclass(frozen=True)
class Chunk:
    """A cube whose points are made into nodes together: its level, and where its points are in the sorted file."""

    level: int
    first: int
    count: int


def write(map_file: Path, folder: Path, config: LodConfig | None = None, progress: Progress = silent) -> None:
    """Writes the map (a PLY with x, y, z, red, green, blue and any other columns) as octree into the folder.

    Raises: InputError if the map cannot be read or the folder not be written.
    """
    config = config or LodConfig()
    files.make_folder(folder)
    survey = _survey(map_file)
    nodes: list[Nodes] = []
    with contextlib.closing(Scratch(folder, survey.rows)) as points:
        chunks = _sort_by_chunk(map_file, points, survey, config)
        pieces = _pieces(points, chunks, survey.frame, config, nodes, progress)
        potree.write_points(folder, _measured(pieces, survey.ranges))
    whole = _merged(nodes)
    potree.write_hierarchy(folder, whole, survey.rows)
    spacing = survey.frame.edge / (1 << kernels.GRID_LEVELS)
    potree.write_metadata(folder, survey.frame, whole, survey.rows, survey.ranges, spacing, _source(map_file))


def is_of(map_file: Path, folder: Path) -> bool:
    """Whether an octree lies in the folder, and was made of this map as it is now.

    Octrees of versions that did not write down what they were made of are taken for it if they have as many points.
    Raises: InputError if the map cannot be read.
    """
    try:
        metadata = json.loads(files.read_text(folder / potree.METADATA))
        source, points = metadata.get("source"), metadata.get("points")
    except (InputError, ValueError, AttributeError):
        return False
    return bool(points == ply.count(map_file) and (source is None or source == _source(map_file)))


def _source(map_file: Path) -> dict[str, str]:
    return {"file": map_file.name, "sha256": files.sha256(map_file, sys.maxsize)}


@dataclass(frozen=True)
class _Survey:
    """What one reading of the map tells: its frame, how points are stored, ranges by attribute, number of points."""

    frame: Frame
    rows: np.dtype
    ranges: dict[str, tuple[np.ndarray, np.ndarray]]
    count: int


def _survey(map_file: Path) -> _Survey:
    low: dict[str, np.ndarray] = {}
    high: dict[str, np.ndarray] = {}
    count = 0
    for piece in ply.read_ply_chunks(map_file):
        rows = potree.row_type(piece.dtype, {ERROR: "<f4"})
        others = {name: piece[name] for name in (rows.names or ())[2:] if name != ERROR}
        count += len(piece)
        for name, values in {"position": _xyz(piece), "rgb": _rgb(piece), **others}.items():
            known = values[np.isfinite(values)] if values.ndim == 1 else values
            if len(known):
                low[name] = np.minimum(low.get(name, known.min(0)), known.min(0))
                high[name] = np.maximum(high.get(name, known.max(0)), known.max(0))
    none = np.zeros(3)
    ranges = {name: (low.get(name, none), high.get(name, none)) for name in rows.names or ()}
    return _Survey(frame_of(*ranges["position"]), rows, ranges, count)


def frame_of(low: Vector, high: Vector) -> Frame:
    """The cube over the corners low, high (3,) m, with the coarsest steps of at most 0.1 mm that 31 bits allow."""
    extent = max(float((high - low).max()), 0.01)
    bits = min(math.ceil(math.log2(extent / _STEP_M + 1)), 31)
    steps = (1 << bits) - 1  # the highest corner is the last step
    return Frame(np.asarray(low, float), extent * (steps + 1) / steps, bits)


def _xyz(piece: np.ndarray) -> np.ndarray:
    return np.stack([piece[axis].astype(float) for axis in "xyz"], axis=1)


def _rgb(piece: np.ndarray) -> np.ndarray:
    return np.stack([piece[name].astype(np.uint16) * 257 for name in ("red", "green", "blue")], axis=1)


def _stored(piece: np.ndarray, survey: _Survey) -> np.ndarray:
    """The rows of a piece of the map."""
    frame, out = survey.frame, np.empty(len(piece), survey.rows)
    steps = np.rint((_xyz(piece) - frame.offset) / frame.scale)
    out["position"] = np.clip(steps, 0, (1 << frame.bits) - 1)
    out["rgb"] = _rgb(piece)
    for name in (survey.rows.names or ())[2:]:
        out[name] = piece[name] if name in (piece.dtype.names or ()) else np.nan
    return out


def _cubes(rows: np.ndarray, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Keys (N,) uint64 of the points, and the number (N,) int64 of their cubes of _CHUNK_LEVEL."""
    key = kernels.keys(np.ascontiguousarray(rows["position"]), frame.bits)
    return key, (key >> np.uint64(3 * (kernels.KEY_LEVELS - _CHUNK_LEVEL))).astype(np.int64)


def _sort_by_chunk(map_file: Path, out: Scratch, survey: _Survey, config: LodConfig) -> list[Chunk]:
    """Puts all points on disk, those of a chunk together and in the map's order; the chunks."""
    counts = np.zeros(1 << 3 * _CHUNK_LEVEL, np.int64)
    if survey.count > config.chunk_points:
        for piece in ply.read_ply_chunks(map_file):
            cube = _cubes(_stored(piece, survey), survey.frame)[1]
            counts += np.bincount(cube, minlength=len(counts))
    else:
        counts[0] = survey.count
    chunks, chunk_of_cube = cut(counts, config.chunk_points)
    fill = np.array([chunk.first for chunk in chunks], np.int64)
    for piece in ply.read_ply_chunks(map_file):
        points = _stored(piece, survey)
        chunk = chunk_of_cube[_cubes(points, survey.frame)[1]]
        order = np.argsort(chunk, kind="stable")
        occupied, starts, number = np.unique(chunk[order], return_index=True, return_counts=True)
        for c, start, n in zip(occupied, starts, number, strict=True):
            out.put(int(fill[c]), points[order[start : start + n]])
            fill[c] += n
    return chunks


def cut(counts: np.ndarray, most: int) -> tuple[list[Chunk], np.ndarray]:
    """The largest cubes of at most `most` points (or the smallest there are), and the chunk of each smallest cube.

    counts: (8^L,) int64, points in each cube of level L, in the order of keys
    """
    chunks: list[Chunk] = []
    chunk_of_cube = np.zeros(len(counts), np.int32)
    before = np.concatenate([[0], np.cumsum(counts)])
    waiting = [(0, 0, len(counts))]
    while waiting:
        level, start, end = waiting.pop()
        count = int(before[end] - before[start])
        if count <= most or end - start == 1:
            if count or level == 0:
                chunk_of_cube[start:end] = len(chunks)
                chunks.append(Chunk(level, int(before[start]), count))
            continue
        step = (end - start) // 8
        waiting += [(level + 1, first, first + step) for first in range(start, end, step)][::-1]
    return chunks, chunk_of_cube


def _pieces(
    scratch: Scratch,
    chunks: list[Chunk],
    frame: Frame,
    config: LodConfig,
    nodes: list[Nodes],
    progress: Progress,
) -> Iterator[np.ndarray]:
    """The rows of octree.bin, piece by piece; the nodes they make up are added to `nodes`."""
    written = 0
    above: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for number, chunk in enumerate(chunks):
        points = scratch.get(chunk.first, chunk.count)
        level, key, points = _by_node(points, frame, chunk.level, config.leaf_points)
        own = int(np.searchsorted(level, chunk.level))
        if own:
            # copies: a view would keep the whole chunk
            above.append((level[:own].copy(), key[:own].copy(), points[:own].copy()))
        nodes.append(_nodes(level[own:], key[own:], written))
        written += len(points) - own
        yield points[own:]
        progress("build octree", number + 1, len(chunks))
    if above:
        level, key, points = (np.concatenate(parts) for parts in zip(*above, strict=True))
        order = np.lexsort((key, level))
        nodes.append(_nodes(level[order], key[order], written))
        yield points[order]


def _measured(
    pieces: Iterator[np.ndarray], ranges: dict[str, tuple[np.ndarray, np.ndarray]]
) -> Iterator[np.ndarray]:
    """The pieces as they are; the range of their plane errors goes into `ranges`."""
    for piece in pieces:
        known = piece[ERROR][np.isfinite(piece[ERROR])]
        if len(known):
            low, high = ranges[ERROR]
            ranges[ERROR] = (np.minimum(low.max(), known.min()), np.maximum(high.max(), known.max()))
        yield piece


def _by_node(
    points: np.ndarray, frame: Frame, first: int, leaf_points: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Levels, keys and rows of a chunk's points, those of a node together."""
    key = _cubes(points, frame)[0]
    order = np.argsort(key, kind="stable")
    key, points = key[order], points[order]
    if np.isnan(points[ERROR]).all():
        points[ERROR] = _plane_errors(key, points, frame, first)
    level = kernels.levels(key, first, leaf_points)
    by_level = np.argsort(level, kind="stable")
    return level[by_level].astype(np.int64), key[by_level], points[by_level]


def _plane_errors(key: np.ndarray, points: np.ndarray, frame: Frame, first: int) -> np.ndarray:
    """(N,) float32, m, of a chunk's points in the order of their keys."""
    level = min(max(first, math.ceil(math.log2(frame.edge / _PLANE_M))), kernels.KEY_LEVELS)
    cell = key >> np.uint64(3 * (kernels.KEY_LEVELS - level))
    starts = np.flatnonzero(np.concatenate([[True], cell[1:] != cell[:-1], [True]]))
    return flatness.plane_error(np.ascontiguousarray(points["position"]), starts, frame.scale)


def _nodes(level: np.ndarray, key: np.ndarray, first: int) -> Nodes:
    """The nodes of points that stand by level and key, the first of them at place `first` of the file."""
    path = key >> (3 * (kernels.KEY_LEVELS - level)).astype(np.uint64)
    new = np.flatnonzero(np.diff(level, prepend=-1) | (np.diff(path, prepend=~path[:1]) != 0))
    return Nodes(level[new], path[new], np.diff(new, append=len(level)), first + new)


def _merged(parts: list[Nodes]) -> Nodes:
    """All nodes, by level, then by path. An empty map has an empty root."""
    columns = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("level", "path", "points", "first")
    )
    whole = Nodes(*columns)
    if not len(whole):
        one = np.zeros(1, np.int64)
        return Nodes(one, one.astype(np.uint64), one, one)
    order = np.lexsort((whole.path, whole.level))
    return Nodes(whole.level[order], whole.path[order], whole.points[order], whole.first[order])
