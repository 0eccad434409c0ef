"""Images, decoded once: in color as they were taken, keyframes without distortion, and those that judge."""

import copy
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lvba.arrays import Indices, Picture
from lvba.blocks.pieces import PieceReader, Pieces, Range
from lvba.blocks.survey import Survey
from lvba.camera import Camera
from lvba.dataset import Dataset
from lvba.io import dataset as recordings
from lvba.parallel import in_order
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


@dataclass(frozen=True)
class Keyframes:
    """Keyframes as the visual bundle adjustment reads them. numbers: (k,) int64; images: (k, H, W, C) uint8"""

    numbers: np.ndarray
    images: np.ndarray


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
    held = PieceReader(photos, keep=PIECES_HELD)

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
    camera, held = judging_size.judging(dataset.camera), PieceReader(photos)
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


class PhotoReader:
    """Images in color without distortion, as the camera has it, at the size at which they judge.

    pieces: of `judging_photos`; camera: that took the images, with its lens; first: number in the whole recording of the
    image called 0; turns: (I, 3) float64, rad, of these images (`Undistorter`); None: all rows were read at once
    """

    def __init__(
        self, pieces: Pieces[np.ndarray], camera: Camera, first: int = 0, turns: np.ndarray | None = None
    ) -> None:
        self._reader, self._first = PieceReader(pieces, keep=PIECES_HELD), first
        self._undistort, self._turns = _undistorter(camera), turns
        # several states that are looked at together ask for one image after each other
        self._last = threading.local()

    def seen_by(self, camera: Camera, turns: np.ndarray | None = None) -> "PhotoReader":
        """The same images as another camera has them; what is in memory of them is in it once."""
        other = copy.copy(self)
        other._undistort, other._turns, other._last = _undistorter(camera), turns, threading.local()
        return other

    def __call__(self, index: int) -> np.ndarray:
        """(h, w, 3) uint8 RGB."""
        if getattr(self._last, "index", None) != index:
            turn = None if self._turns is None else self._turns[index]
            self._last.image = self._undistort(self._reader.frame(self._first + index), turn)
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


def color_of_keyframes(
    pieces: Pieces[np.ndarray], numbers: Indices, camera: Camera, pinhole: Camera, color: int
) -> np.ndarray:
    """Red (0), green or blue of some keyframes (k,), (k, H, W, 1) uint8, as a pinhole camera sees it.

    pieces: of raw images; camera: theirs, with its lens; numbers: ascending, in the whole recording
    """
    undistort = image.Undistorter(camera, pinhole)
    gathered = np.zeros((len(numbers), pinhole.height, pinhole.width, 1), np.uint8)
    for (first, end), read in pieces:
        wanted = np.flatnonzero((numbers >= first) & (numbers < end))
        if len(wanted):
            raw = read()
            for row in wanted:
                gathered[row, ..., 0] = undistort(np.ascontiguousarray(raw[numbers[row] - first, ..., color]))
    return gathered
