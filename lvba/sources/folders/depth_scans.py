"""Depth images as scans in the frame of the depth camera: x right, y down, z forward, points in the order of rows."""

import math
from collections.abc import Callable, Iterable, Mapping
from itertools import islice
from pathlib import Path

import numpy as np

from lvba.camera import Camera
from lvba.errors import InputError
from lvba.io import depth, files, image_header
from lvba.lens import undistort
from lvba.sources.folders import tables
from lvba.sources.folders.items import Item, at_hand
from lvba.sources.source import PoseSample, RawImage, RawScan

FRAME = "depth"
IMAGE_FRAME = "camera"


_MOST_POINTS = 102_400
"""Of larger depth images every second, third, ... row and column: what neighboring pixels measure is one measurement, its
error alike. Scan poses of a handheld RealSense camera were 49 mm off with all 290,000 points, 12 mm with every second row
and column, and its refinement took three times as long."""


class DepthCamera:
    """The rays of the pixels of a depth image that become points (`_MOST_POINTS`), made once.

    camera: of the depth images, at the size that files have; meters: of one unit of the files; nothing: a value beside 0
    of pixels that measured nothing
    """

    notes: tuple[str, ...]
    """What people should know of it."""

    def __init__(self, camera: Camera, meters: float, nothing: int = 0) -> None:
        self._camera, self._meters, self._nothing = camera, meters, nothing
        columns, rows = np.meshgrid(
            np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float)
        )
        u, v = (columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy
        x, y = (u, v) if camera.is_pinhole else undistort(camera.lens, camera.distortion, u, v)
        step = math.ceil(math.sqrt(camera.width * camera.height / _MOST_POINTS))
        nth = {2: "second", 3: "third"}.get(step, f"{step}th")
        self.notes = () if step == 1 else (f"every {nth} row and column of depth images becomes points.",)
        self._taken = np.s_[step // 2 :: step, step // 2 :: step]
        self._rays = np.stack([x, y], axis=-1)[self._taken].reshape(-1, 2).astype(np.float32)
        self._rows = rows[self._taken].astype(np.int64).ravel()

    def scan(self, path: Path, stamp: int, trusted: np.ndarray | None = None) -> RawScan:
        """The points of a depth image, along the axis of the camera, without pixels that measured nothing.

        stamp: ns; trusted: (H, W) bool, pixels to take, or None
        Raises: InputError if the file is damaged, of another size, or has no depth.
        """
        values = depth.read_depth(path)
        camera = self._camera
        if values.shape != (camera.height, camera.width):
            size = f"{values.shape[1]} x {values.shape[0]} px instead of {camera.width} x {camera.height}"
            raise InputError(path, size, "give depth images of one size, with their intrinsics")
        if trusted is not None:
            if trusted.shape != values.shape:
                raise InputError(path, "its confidence image has another size", "copy the files again")
            values = np.where(trusted, values, 0)
        return self.scan_of(path, values, stamp)

    def scan_of(self, path: Path, values: np.ndarray, stamp: int) -> RawScan:
        """As `scan`, of depths that are at hand. values: (H, W) uint16 or float32, in the unit; stamp: ns

        Raises: InputError if there is no depth.
        """
        flat = values[self._taken].ravel()
        measured = np.flatnonzero((flat != 0) & (flat != self._nothing))
        if not len(measured):
            raise InputError(path, "measured nothing: none of its values is a depth", "remove the file")
        distance = flat[measured].astype(np.float32) * np.float32(self._meters)
        points = np.empty((len(measured), 3), np.float32)
        points[:, :2] = self._rays[measured] * distance[:, None]
        points[:, 2] = distance
        return RawScan(stamp=stamp, frame=FRAME, points=points, rows=self._rows[measured])

    def item(
        self, stream: str, path: Path, stamp: int, trusted: Callable[[], np.ndarray] | None = None
    ) -> Item:
        """A scan that is loaded when it is its turn. stamp: ns"""
        return Item(
            stamp, stream, lambda: self.scan(path, stamp, None if trusted is None else trusted()), str(path)
        )


PERIOD_NS = 1_000_000_000 // 30
"""From frame to frame where a folder has no times."""
NO_TIMES = "it has no times: 30 frames a second are assumed."


def pose_items(
    files_by_number: Mapping[int, Path], read: Callable[[Path], np.ndarray | None]
) -> tuple[list[Item], list[str]]:
    """Poses of frames, PERIOD_NS apart, and notes on those that were lost.

    read: the pose (4, 4), world from depth camera, that a file holds; None: tracking was lost
    Raises: InputError of `read`, or if a pose is none.
    """
    items, lost = list[Item](), 0
    for number, file in files_by_number.items():
        matrix = read(file)
        if matrix is None:
            lost += 1
            continue
        sample = PoseSample(number * PERIOD_NS, "world", FRAME, tables.pose(file, matrix))
        items.append(at_hand(sample.stamp, "pose", sample))
    count = f"{lost} of {lost + len(items)} poses"
    return items, [f"{count} are not finite (tracking was lost): they are left out."] if lost else []


def image_item(stream: str, path: Path, stamp: int, frame: str = IMAGE_FRAME) -> Item:
    """An image file whose bytes are read when it is its turn. stamp: ns"""
    return Item(stamp, stream, lambda: _image(path, stamp, frame), str(path))


def image_files(paths: Iterable[Path]) -> str:
    """What images are in, by the endings of their names: "JPEG files", "JPEG and PNG files"."""
    endings = {path.suffix[1:].upper().replace("JPG", "JPEG") or "image" for path in paths}
    return f"{' and '.join(sorted(endings))} files"


def _image(path: Path, stamp: int, frame: str) -> RawImage:
    content = files.read_bytes(path)
    image_header.size(path, content[: image_header.START_BYTES])
    image_header.check_whole(path, content)
    suffix = ".png" if content.startswith(b"\x89PNG") else ".jpg"
    return RawImage(stamp=stamp, frame=frame, encoded=content, suffix=suffix)


_LOOKED_AT = 20


def size_of_first(paths: Iterable[Path]) -> image_header.ImageSize:
    """Width and height of the first image that is there and whole at its start, of the first twenty.

    Raises: InputError of the first, if none is.
    """
    first: InputError | None = None
    for path in islice(paths, _LOOKED_AT):
        try:
            return image_size(path)
        except InputError as error:
            first = first or error
    raise first or InputError("images", "there are none", "copy the folder again")


def image_size(path: Path) -> image_header.ImageSize:
    """Width and height of a PNG or JPEG file. Raises: InputError if it is neither."""
    return image_header.size(path, files.read_start(path, image_header.START_BYTES))
