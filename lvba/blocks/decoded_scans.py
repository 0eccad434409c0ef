"""Points of scans, decoded once, and who reads them: whole or without the points that move."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial import cKDTree

from lvba.arrays import Indices
from lvba.blocks.pieces import Given, Made, PieceReader, Range, given
from lvba.blocks.split import Part
from lvba.blocks.survey import Survey
from lvba.dataset import Dataset, Scan
from lvba.io import dataset as recordings
from lvba.lidar.scan_errors import ScanErrors
from lvba.parallel import in_order
from lvba.plan import StreamedRef
from lvba.progress import Progress, silent

GivenScans = tuple[Range, StreamedRef | tuple[StreamedRef, StreamedRef]]
"""A piece of scans as a plan gives it to a step; of two, the second says which points of the first move."""
_REGION_M = 300.0
"""Scans of parts whose paths come this near to a part's may have points in its region of space: twice the reach of usual
sensors. Of parts further off, where there are such points all the same, the files are read again."""


def given_static(pieces: Sequence[Made], moving: Sequence[Made], numbers: Indices) -> list[GivenScans]:
    """The pieces that hold some scans, ascending numbers (n,), without points that move. moving: of the same ranges"""
    return [
        (frames, (points, moves))
        for (frames, points), (_, moves) in zip(given(pieces, numbers), given(moving, numbers), strict=True)
    ]


def about_region(dataset: Dataset, part: Part, pieces: Sequence[Made]) -> list[Given]:
    """The scans that may have points in the region of space that a part owns. dataset: the whole recording."""
    path = dataset.scans.world_from_sensor[:, :3, 3]
    near = cKDTree(path[slice(*part.core_scans)]).query(path, distance_upper_bound=_REGION_M)[0]
    return given(pieces, np.flatnonzero(np.isfinite(near)))


@dataclass(frozen=True)
class ScanPoints:
    """Points of successive scans, one after another.

    points: (M, 3) float32, m, scan frame, all finite; offsets: (n + 1,) int64, where each scan begins
    intensity: (M,) float32, NaN where the file has none; None: not kept
    errors: by which points were moved; None: they are as in their files
    cosine: (M,) float16, of the angles of incidence that they were moved by; None: by none
    every: all but the map takes every so many-th point of each scan
    """

    points: np.ndarray
    offsets: np.ndarray
    intensity: np.ndarray | None = None
    errors: ScanErrors | None = None
    cosine: np.ndarray | None = None
    every: int = 1


@dataclass(frozen=True)
class MovingPoints:
    """Points of successive scans that move. numbers: (K,) int64, ascending, among the `count` points of the scans"""

    numbers: np.ndarray
    count: int

    @property
    def mask(self) -> np.ndarray:
        """Which of the points move, (count,) bool."""
        moves = np.zeros(self.count, bool)
        moves[self.numbers] = True
        return moves


ScanPieces = Sequence[
    tuple[Range, Callable[[], ScanPoints] | tuple[Callable[[], ScanPoints], Callable[[], MovingPoints]]]
]
"""Pieces of scans, with the points that move, which readers take out, or without."""


def decode_scans(
    dataset: Dataset,
    scans: Range,
    errors: ScanErrors | None = None,
    survey: Survey | None = None,
    progress: Progress = silent,
) -> ScanPoints:
    """The points of some scans, with intensities where there are no images that would color the map.

    errors: of the scans of the recording: points are moved to where they belong; survey: None: all points are solved with
    Raises InputError: a scan cannot be read.
    """
    errors = errors if errors is not None and errors.corrected else None
    points, intensity, cosines = [], [], []
    loaded = in_order(lambda number: recordings.load_scan(dataset, number), range(*scans))
    for number, scan in enumerate(loaded, scans[0]):
        cosine = None if errors is None else errors.cosines(scan)
        points.append(placed(dataset, number, scan, errors, cosine))
        if cosine is not None:
            cosines.append(cosine.astype(np.float16))
        if not dataset.image_paths:
            known = scan.intensity
            intensity.append(np.full(len(scan), np.nan, np.float32) if known is None else known)
        progress("scans", len(points), scans[1] - scans[0])
    return ScanPoints(
        points=np.concatenate(points),
        offsets=np.concatenate([[0], np.cumsum([len(each) for each in points])]).astype(np.int64),
        intensity=np.concatenate(intensity).astype(np.float32) if intensity else None,
        errors=errors,
        cosine=np.concatenate(cosines) if cosines else None,
        every=1 if survey is None else survey.every,
    )


def placed(
    dataset: Dataset, number: int, scan: Scan, errors: ScanErrors | None, cosine: np.ndarray | None = None
) -> np.ndarray:
    """The points (N, 3) float32, m, of a scan where they belong. cosine: as of `ScanErrors.points`"""
    if errors is None:
        return scan.points
    return errors.points(scan, number, float(dataset.scans.times[number]), cosine)


class ScanReader:
    """Points of scans.

    first: number in the whole recording of the scan called 0; whole: the recording, whose files are read for scans that
    no piece holds; all_points: else those that are solved with, `ScanPoints.every`
    static: without those that move, where these are known
    """

    def __init__(
        self,
        pieces: ScanPieces,
        first: int = 0,
        whole: Dataset | None = None,
        all_points: bool = False,
        static: bool = True,
    ) -> None:
        given = [
            (frames, read if not isinstance(read, tuple) else partial(_static, *read) if static else read[0])
            for frames, read in pieces
        ]
        self._pieces, self._first, self._whole, self._all = given, first, whole, all_points
        self._reader = PieceReader(given)

    def __call__(self, scan: int) -> np.ndarray:
        """(N, 3) float32, m, scan frame.

        Raises InputError: it is in no piece, and its file cannot be read.
        """
        held = self._held(scan)
        if held is not None:
            return held[0].points[held[1]]
        if self._whole is None:
            raise IndexError(f"no piece holds scan {self._first + scan}")
        number = self._first + scan
        any_piece = self._pieces[0][1]() if self._pieces else None
        errors, every = (None, 1) if any_piece is None else (any_piece.errors, self._every(any_piece))
        return placed(self._whole, number, recordings.load_scan(self._whole, number), errors)[::every]

    def load(self, scans: Sequence[int] | np.ndarray) -> list[np.ndarray]:
        """The points of some scans, copied where a view would hold more in memory."""
        loaded = []
        for scan in map(int, scans):
            points = self(scan)
            whole = len(self._pieces) == 1 and points.flags.c_contiguous
            loaded.append(points if whole else points.copy())
        return loaded

    def cosines(self, scans: Sequence[int] | np.ndarray) -> np.ndarray | None:
        """Of the angles of incidence that the points of some scans were moved by, one after another, (M,) float64; None:
        those of some are not known."""
        gathered = []
        for scan in map(int, scans):
            held = self._held(scan)
            if held is None or held[0].cosine is None:
                return None
            gathered.append(held[0].cosine[held[1]])
        return np.concatenate(gathered).astype(float) if gathered else None

    def intensities(self, scans: Sequence[int] | np.ndarray) -> np.ndarray:
        """Of the points of some scans, one after another, (M,) float32, NaN where not known."""
        gathered = []
        for scan in map(int, scans):
            held = self._held(scan)
            if held is None or held[0].intensity is None:
                gathered.append(np.full(len(self(scan)), np.nan, np.float32))
                continue
            gathered.append(held[0].intensity[held[1]])
        return np.concatenate(gathered)

    def _held(self, scan: int) -> tuple[ScanPoints, slice] | None:
        """The piece that holds a scan, and which of its points are the scan's; None: no piece does."""
        held = self._reader.find(self._first + scan)
        if held is None:
            return None
        begin, end = held[1].offsets[self._first + scan - held[0] :][:2]
        return held[1], slice(begin, end, self._every(held[1]))

    def _every(self, piece: ScanPoints) -> int:
        return 1 if self._all else piece.every


def _static(read: Callable[[], ScanPoints], read_moving: Callable[[], MovingPoints]) -> ScanPoints:
    """The points of the same scans that do not move."""
    points, moving = read(), read_moving()
    if not len(moving.numbers):
        return points
    static = ~moving.mask
    return replace(
        points,
        points=points.points[static],
        offsets=points.offsets - np.searchsorted(moving.numbers, points.offsets),
        intensity=None if points.intensity is None else points.intensity[static],
        cosine=None if points.cosine is None else points.cosine[static],
    )


def moving_solved(pieces: ScanPieces, scans: Indices) -> np.ndarray:
    """Which of the points that some scans were solved with before any were taken out move, (M,) bool, in order.

    scans: (n,) ascending numbers in the whole recording
    """
    masks = [np.zeros(0, bool)]
    for (first, end), read in pieces:
        points = read[0]() if isinstance(read, tuple) else read()
        moves = read[1]().mask if isinstance(read, tuple) else np.zeros(len(points.points), bool)
        held = scans[(scans >= first) & (scans < end)] - first
        masks += [moves[points.offsets[scan] : points.offsets[scan + 1] : points.every] for scan in held]
    return np.concatenate(masks)
