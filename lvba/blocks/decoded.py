"""The frames of a recording decoded once, in pieces that all later steps read: points of scans, keyframes, images.

Each piece holds frames of one core, so that no frame is in two of them. A step is given the pieces of the frames that it
works on, and holds one of them (PIECES_HELD of images) at a time beside what it copies out.
"""

import copy
import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Generic, TypeVar

import numpy as np
from scipy.spatial import cKDTree

from lvba.arrays import Indices, Picture
from lvba.blocks.split import Part
from lvba.blocks.survey import Survey
from lvba.camera import Camera
from lvba.dataset import Dataset, Scan
from lvba.io import dataset as recordings
from lvba.lidar.scan_errors import ScanErrors
from lvba.parallel import in_order
from lvba.plan import Ref, StreamedRef
from lvba.products import judging_size
from lvba.progress import Progress, silent
from lvba.visual import image
from lvba.visual.image import ImageConfig

PIECE_BYTES = 1 << 25
"""Images in color are kept in pieces of about this size ..."""
PIECES_HELD = 3
"""... of which so many are in memory at a time."""

BLANK = 0.95
"""Part of an image that is black or clipped from which it shows nothing."""

T = TypeVar("T")
Range = tuple[int, int]
"""Half-open, of numbers of frames in the whole recording."""
Pieces = Sequence[tuple[Range, Callable[[], T]]]
"""Pieces by the frames they hold, ascending, as functions that read them."""
Made = tuple[Range, Ref]
Given = tuple[Range, StreamedRef]
"""A piece in a plan: as a step makes it, and as it is given to another one."""
GivenScans = tuple[Range, StreamedRef | tuple[StreamedRef, StreamedRef]]
"""The same of scans; of two, the second says which points of the first move."""
_REGION_M = 300.0
"""Scans of parts whose paths come this near to a part's may have points in its region of space: twice the reach of usual
sensors. Of parts further off, where there are such points all the same, the files are read again."""


def given(pieces: Sequence[Made], numbers: Indices) -> list[Given]:
    """The pieces that hold some frames, ascending numbers (n,)."""
    return [
        ((first, end), StreamedRef(ref.key))
        for (first, end), ref in pieces
        if np.searchsorted(numbers, first) < np.searchsorted(numbers, end)
    ]


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


@dataclass(frozen=True)
class Keyframes:
    """Keyframes as the visual bundle adjustment reads them. numbers: (k,) int64; images: (k, H, W, C) uint8"""

    numbers: np.ndarray
    images: np.ndarray


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


def keyframes_of_photos(
    dataset: Dataset,
    images: Range,
    photos: Pieces[np.ndarray],
    survey: Survey,
    config: ImageConfig,
    enabled: bool = True,
    progress: Progress = silent,
) -> Keyframes:
    """The keyframes among some images, as `image.measuring_camera` sees them. enabled: False: none, nobody needs them.

    photos: pieces that hold these images, raw, in color
    """
    numbers = survey.keyframes
    chosen = numbers[(numbers >= images[0]) & (numbers < images[1])]
    if not enabled or not len(chosen):
        return Keyframes(chosen[:0], np.zeros((0, 1, 1, config.channels), np.uint8))
    held = _Reader(photos, keep=PIECES_HELD)

    gathered = image.load_undistorted(
        lambda index: held.frame(int(chosen[index])), len(chosen), dataset.camera, config, progress
    )
    return Keyframes(chosen, gathered)


def decode_photos(dataset: Dataset, images: Range, progress: Progress = silent) -> np.ndarray:
    """Some images in color as they were taken, (n, H, W, 3) uint8: which lens they have is known better later.

    Raises InputError: an image cannot be read.
    """
    camera, first = dataset.camera, images[0]
    photos = np.empty((images[1] - first, camera.height, camera.width, 3), np.uint8)

    def load(number: int) -> None:
        photos[number - first] = recordings.load_image(dataset, number)

    for done, _ in enumerate(in_order(load, range(*images))):
        progress("images", done + 1, len(photos))
    return photos


def judging_photos(
    dataset: Dataset, images: Range, photos: Pieces[np.ndarray], progress: Progress = silent
) -> np.ndarray:
    """Some images in color as they judge a map (`products.judging_size`), still with their lens, (n, h, w, 3) uint8.

    photos: pieces that hold these images, raw, in color
    """
    camera, held = judging_size.judging(dataset.camera), _Reader(photos)
    smaller = np.empty((images[1] - images[0], camera.height, camera.width, 3), np.uint8)
    for done, number in enumerate(range(*images)):
        smaller[done] = judging_size.reduced(held.frame(number), dataset.camera)
        progress("images", done + 1, len(smaller))
    return smaller


def photo_ranges(camera: Camera, cores: Sequence[Range]) -> tuple[list[Range], list[Range]]:
    """The images of a camera, by the parts that they belong to, cut into ranges of about PIECE_BYTES of color: the full
    ones, and those that judge, none where the full ones do."""
    smaller = judging_size.judging(camera)
    full, judging = (
        [piece for core in cores for piece in _cut(core, 3 * each.width * each.height)]
        for each in (camera, smaller)
    )
    return full, judging if smaller != camera else []


def _cut(images: Range, size: int) -> list[Range]:
    """Some images of so many bytes each in ranges of about PIECE_BYTES."""
    count = images[1] - images[0]
    if not count:
        return []
    pieces = max(1, -(-count * size // PIECE_BYTES))
    bounds = [images[0] + count * k // pieces for k in range(pieces + 1)]
    return [each for each in pairwise(bounds) if each[0] < each[1]]


class _Reader(Generic[T]):
    """Reads pieces, and keeps the last ones. May be called from several threads."""

    def __init__(self, pieces: Pieces[T], keep: int = 1) -> None:
        self._pieces, self._keep = pieces, keep
        self._kept: OrderedDict[int, T] = OrderedDict()
        self._lock = threading.Lock()

    def find(self, number: int) -> tuple[int, T] | None:
        """The first frame of the piece that holds a frame, and the piece; None where no piece does."""
        for index, ((first, end), read) in enumerate(self._pieces):
            if first <= number < end:
                with self._lock:
                    if index not in self._kept:
                        while len(self._kept) >= self._keep:
                            self._kept.popitem(last=False)
                        self._kept[index] = read()
                    self._kept.move_to_end(index)
                    return first, self._kept[index]
        return None

    def frame(self: "_Reader[np.ndarray]", number: int) -> np.ndarray:
        """One frame of pieces that are arrays of them."""
        piece = self.find(number)
        if piece is None:
            raise IndexError(f"no piece holds image {number}")
        return np.asarray(piece[1][number - piece[0]])


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
        self._reader = _Reader(given)

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


class PhotoReader:
    """Images in color without distortion, as the camera has it, at the size at which they judge.

    pieces: of `judging_photos`; camera: that took the images, with its lens; first: number in the whole recording of the
    image called 0
    """

    def __init__(self, pieces: Pieces[np.ndarray], camera: Camera, first: int = 0) -> None:
        self._reader, self._first = _Reader(pieces, keep=PIECES_HELD), first
        self._undistort = _undistorter(camera)
        # several states that are looked at together ask for one image after each other
        self._last = threading.local()

    def seen_by(self, camera: Camera) -> "PhotoReader":
        """The same images as another camera has them; what is in memory of them is in it once."""
        other = copy.copy(self)
        other._undistort, other._last = _undistorter(camera), threading.local()
        return other

    def __call__(self, index: int) -> np.ndarray:
        """(h, w, 3) uint8 RGB."""
        if getattr(self._last, "index", None) != index:
            self._last.image = self._undistort(self._reader.frame(self._first + index))
            self._last.index = index
        return np.asarray(self._last.image)


def _undistorter(camera: Camera) -> image.Undistorter:
    return image.Undistorter(judging_size.judging(camera))


def blank_photos(pieces: Pieces[np.ndarray], images: Range) -> np.ndarray:
    """Which of some images (half-open range) show nothing, (b,) int32, counted from the first of these."""
    blank: list[int] = []
    for (first, _), read in pieces:
        at = first + np.flatnonzero([shows_nothing(photo) for photo in read()]) - images[0]
        blank += [int(number) for number in at if 0 <= number < images[1] - images[0]]
    return np.array(sorted(blank), np.int32)


def shows_nothing(photo: Picture) -> bool:
    """Whether an image (H, W, 3) uint8 is black, or clipped, nearly everywhere, by every 64th pixel."""
    sample = photo[::8, ::8]
    nothing = (sample.max(axis=-1) <= image.DARK) | (sample.min(axis=-1) >= image.SATURATED)
    return bool(nothing.mean() > BLANK)


def keyframe_images(pieces: Pieces[Keyframes], numbers: Indices) -> np.ndarray:
    """The images (k, H, W, C) uint8 of some keyframes (k,), ascending numbers in the whole recording."""
    gathered: np.ndarray | None = None
    for (first, end), read in pieces:
        wanted = np.flatnonzero((numbers >= first) & (numbers < end))
        if not len(wanted):
            continue
        piece = read()
        if len(wanted) == len(numbers) == len(piece.numbers):
            return piece.images
        if gathered is None:
            gathered = np.empty((len(numbers), *piece.images.shape[1:]), np.uint8)
        gathered[wanted] = piece.images[np.searchsorted(piece.numbers, numbers[wanted])]
    return np.zeros((0, 1, 1, 1), np.uint8) if gathered is None else gathered
