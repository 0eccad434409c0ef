"""Numbers, times and poses in text files of folders."""

import math
import re
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from lvba import geometry
from lvba.arrays import Pose, Poses
from lvba.camera import Camera
from lvba.errors import InputError
from lvba.io import files
from lvba.io.camera_keys import as_float
from lvba.io.image_header import ImageSize

_DECIMAL = re.compile(r"([+-]?)(\d+)(?:\.(\d*))?(?:[eE]([+-]?\d+))?")
_ROTATION_TOLERANCE = 1e-2
"""Largest entry of R R^T - I of a pose: some files have 3 digits."""
_MAX_POSITION_M = 1e8
_MAX_SECONDS = 2**33
_FIRST_SECONDS = 100_000
"""Dates before are of clocks that were never set, and could not be half a sweep earlier."""
_SECOND = 1_000_000_000


def nanoseconds(where: object, text: str) -> int:
    """Whole ns of a decimal number of seconds, all digits kept.

    Raises: InputError if it is none, negative, or past the year 2200.
    """
    match = _DECIMAL.fullmatch(text.strip())
    if match is None or match[1] == "-":
        raise InputError(where, f"{text[:40]!r} is no time in seconds", "write seconds")
    if match[4]:
        seconds = float(text)
        value = round(seconds * 1e9) if seconds <= _MAX_SECONDS else _MAX_SECONDS * _SECOND + 1
    else:
        value = int(match[2][:12]) * _SECOND + int(f"{match[3] or '':0<9}"[:9])
    if not value <= _MAX_SECONDS * _SECOND or len(match[2]) > 12:
        raise InputError(where, f"{text[:40]!r} is no time in seconds", "write seconds")
    return value


def date_nanoseconds(where: object, text: str) -> int:
    """ns since 1970 of "2011-09-26 13:02:25.964389445", taken for UTC.

    Raises: InputError if it is no such date.
    """
    day, _, fraction = text.strip().partition(".")
    try:
        seconds = int(datetime.strptime(day, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC).timestamp())
    except ValueError as error:
        raise InputError(where, f"{text[:40]!r} is no date", "write 2011-09-26 13:02:25.964389445") from error
    if (fraction and not fraction.isdigit()) or not _FIRST_SECONDS < seconds < _MAX_SECONDS:
        raise InputError(where, f"{text[:40]!r} is no date", "write 2011-09-26 13:02:25.964389445")
    return seconds * _SECOND + int(f"{fraction:0<9}"[:9])


def dates(path: Path) -> list[int]:
    """ns since 1970 of the lines of a file of dates.

    Raises: InputError with the line, if it holds none or a line is no date.
    """
    lines = files.read_text(path).rstrip().split("\n")
    if lines == [""]:
        raise InputError(path, "is empty", "copy the file again")
    return [date_nanoseconds(f"{path}:{number}", line) for number, line in enumerate(lines, 1)]


def lines_of_words(path: Path, separator: str | None = None) -> list[tuple[int, list[str]]]:
    """Number and words of each line that is neither empty nor a comment (#).

    Raises: InputError if the file cannot be read.
    """
    lines = []
    for number, line in enumerate(files.read_text(path).split("\n"), 1):
        words = [word.strip() for word in line.split("#", 1)[0].strip().split(separator)]
        if words and words != [""]:
            lines.append((number, words))
    return lines


def numbers(where: object, words: list[str], count: int, what: str) -> np.ndarray:
    """(count,) float64. what: the numbers are, for the fix.

    Raises: InputError if there are not as many, or one is not finite.
    """
    values = [as_float(word) for word in words]
    if len(values) != count or None in values:
        raise InputError(where, f"not {count} finite numbers", f"write {what}")
    return np.array(values, float)


def named_rows(path: Path, keys: dict[str, int]) -> dict[str, np.ndarray]:
    """Rows of numbers behind "KEY:", of the keys with so many numbers each; those that are there.

    Raises: InputError with the line, if a row has another count.
    """
    rows = {}
    for number, line in enumerate(files.read_text(path).split("\n"), 1):
        key, _, rest = line.partition(":")
        if (count := keys.get(key.strip())) is not None:
            rows[key.strip()] = numbers(
                f"{path}:{number}", rest.split(), count, f"{key.strip()}: {count} numbers"
            )
    return rows


def need_rows(path: Path, keys: dict[str, int]) -> dict[str, np.ndarray]:
    """As `named_rows`. Raises: InputError also if a key is not there."""
    rows = named_rows(path, keys)
    for key, count in keys.items():
        if key not in rows:
            raise InputError(path, f"has no line {key}", f"add {key}: {count} numbers")
    return rows


def pose(where: object, world_from_sensor: np.ndarray) -> Pose:
    """The (4, 4) transform of a (4, 4) or (3, 4) matrix, its rotation made orthonormal.

    world_from_sensor: (4, 4) or (3, 4) float64, m
    Raises: InputError if it is no rigid transform.
    """
    matrix = world_from_sensor
    rotation, translation = matrix[:3, :3], matrix[:3, 3]
    off = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if not off <= _ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        reason = f"rows off orthonormal by {off:.3g}" if not off <= _ROTATION_TOLERANCE else "a reflection"
        raise InputError(where, f"no rotation: {reason}", "correct the pose, or remove it")
    if not np.abs(translation).max() <= _MAX_POSITION_M:
        raise InputError(where, "a position is not on this planet", "write meters")
    if matrix.shape[0] == 4 and np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise InputError(where, "the last row is not 0 0 0 1", "write the pose row by row")
    return geometry.orthonormalize(geometry.from_rotation_translation(rotation, translation))


def quaternion_pose(where: object, position: np.ndarray, quaternion_xyzw: np.ndarray) -> Pose:
    """The (4, 4) transform. position: (3,) float64, m; quaternion_xyzw: (4,) float64.

    Raises: InputError if the quaternion is not of length 1.
    """
    length = math.sqrt(float(quaternion_xyzw @ quaternion_xyzw))
    if not abs(length - 1) <= 1e-2:
        problem = f"a quaternion of length {length:.6g} instead of 1"
        raise InputError(where, problem, "write unit quaternions")
    if not np.abs(position).max() <= _MAX_POSITION_M:
        raise InputError(where, "a position is not on this planet", "write meters")
    return geometry.from_quaternion_translation(quaternion_xyzw, position)


def matrix_file(path: Path) -> np.ndarray:
    """(R, C) float64 of a text file of numbers, which may be inf or nan; commas or spaces.

    Raises: InputError if it holds none, or rows have different lengths.
    """
    rows = []
    for number, line in enumerate(files.read_text(path, 64 * 1024).split("\n"), 1):
        words = line.replace(",", " ").split()
        if not words:
            continue
        try:
            rows.append([float(word) for word in words])
        except ValueError as error:
            raise InputError(f"{path}:{number}", "not only numbers", "copy the file again") from error
    if not rows or len({len(row) for row in rows}) != 1:
        raise InputError(path, "is no table of numbers", "copy the file again")
    return np.array(rows)


OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Axes of a camera: x right, y down, z forward, from x right, y up, z back (ARKit, OpenGL). (4, 4)"""


def from_opengl(world_from_camera: Poses) -> np.ndarray:
    """(..., 4, 4) poses of cameras whose z is forward.

    world_from_camera: (..., 4, 4) float64, of the same cameras with z back and y up
    """
    return np.asarray(world_from_camera @ OPENCV_FROM_OPENGL)


def pinhole(where: object, matrix: np.ndarray, size: ImageSize) -> Camera:
    """The pinhole camera of images of this size.

    matrix: (3, 3) or (4, 4) float64, K, px
    Raises: InputError if it cannot be of such images.
    """
    if matrix.shape not in ((3, 3), (4, 4)) or not np.isfinite(matrix).all():
        raise InputError(where, "is no 3x3 matrix of intrinsics", "write fx 0 cx, 0 fy cy, 0 0 1")
    fx, fy, cx, cy = (float(matrix[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
    skewed = abs(float(matrix[0, 1])) > 1e-3 or np.abs(matrix[2, :3] - [0, 0, 1]).max() > 1e-6
    inside = 0 < cx < size.width and 0 < cy < size.height
    if (
        skewed
        or not inside
        or not (size.width / 10 < fx < 50 * size.width and size.height / 10 < fy < 50 * size.height)
    ):
        problem = (
            f"fx {fx:g}, fy {fy:g}, cx {cx:g}, cy {cy:g} are not of images of {size.width} x {size.height} px"
        )
        raise InputError(where, problem, "give the intrinsics of these images")
    return Camera(width=size.width, height=size.height, fx=fx, fy=fy, cx=cx, cy=cy)


def image_size(where: object, width: float, height: float) -> ImageSize:
    """Width and height, px, as a file says them. Raises: InputError if they are none."""
    if not (width == int(width) and height == int(height) and 0 < width <= 20_000 and 0 < height <= 20_000):
        raise InputError(
            where, f"{width:g} x {height:g} is not a valid image size", "write width and height in px"
        )
    return ImageSize(int(width), int(height))
