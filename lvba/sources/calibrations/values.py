"""Numbers, transforms and cameras in calibration files, checked."""

from typing import Any

import numpy as np

from lvba import geometry
from lvba.arrays import Pose
from lvba.camera import Camera
from lvba.errors import InputError
from lvba.io import camera_config
from lvba.io.camera_keys import as_float
from lvba.lens import Lens

_MAX_SIDE = 100_000
_MAX_LENGTH_M = 1000.0
_MAX_OFFSET_S = 10.0
_NORM_TOLERANCE = 1e-2

_RADIAL_TANGENTIAL = {
    *("radtan", "radial-tangential", "radial_tangential", "plumb_bob", "brown", "brown_conrady"),
    *("rational_polynomial", "opencv", "full_opencv", "pinhole"),
}
_EQUIDISTANT = {
    "equidistant",
    "equi",
    "fisheye",
    "opencv_fisheye",
    "kannala_brandt",
    "kannala_brandt4",
    "kb4",
}
_UNDISTORTED = {"", "none"}
_UNKNOWN = {
    **dict.fromkeys(("omni", "omnidir", "mei", "unified"), "omnidirectional (Mei)"),
    **dict.fromkeys(("ds", "double_sphere"), "double sphere"),
    **dict.fromkeys(("eucm", "ucm", "ext_unified"), "(extended) unified camera (EUCM)"),
    **dict.fromkeys(("fov", "atan"), "FOV (arctangent)"),
    **dict.fromkeys(("thin_prism_fisheye", "rad_tan_thin_prism_fisheye", "thin_prism"), "thin prism"),
    **dict.fromkeys(("scaramuzza", "ocam", "ocamcalib"), "OCam (Scaramuzza)"),
    **dict.fromkeys(("equirectangular", "spherical"), "equirectangular"),
    **dict.fromkeys(("simple_division", "division"), "division"),
}
"""Models that cannot be used, as files and people name them."""
MEND = "undistort the images to a pinhole, or calibrate a pinhole with radial-tangential or equidistant (KB4) distortion"


def numbers(where: object, key: str, value: Any, counts: tuple[int, ...]) -> np.ndarray:
    """The finite numbers of a list, of nested lists or of an OpenCV matrix, (N,) float64.

    counts: how many there may be
    Raises: InputError if there are others.
    """
    if isinstance(value, dict):
        value = value.get("data")
    flat = [as_float(item) for item in _flat(value)]
    wanted = " or ".join(map(str, counts))
    if len(flat) not in counts or any(item is None or abs(item) > 1e9 for item in flat):
        raise InputError(where, f"{key} is not {wanted} finite numbers", f"write {key} with {wanted} numbers")
    return np.array(flat, float)


def _flat(value: Any) -> list[Any]:
    if not isinstance(value, list | tuple):
        return [value]
    return [item for row in value for item in _flat(row)] if len(value) <= 64 else [None]


def number(where: object, key: str, value: Any) -> float:
    """One finite number. Raises: InputError if it is none."""
    return float(numbers(where, key, value, (1,))[0])


def time_offset(where: object, key: str, value: Any) -> float:
    """Seconds by which two clocks differ. Raises: InputError if it is no number, or more than 10 s."""
    offset = number(where, key, value)
    if abs(offset) > _MAX_OFFSET_S:
        raise InputError(where, f"{key} is {offset:g} s", "write seconds")
    return offset


def matrix(where: object, key: str, value: Any) -> Pose:
    """The (4, 4) transform of 16 or 12 numbers, row by row.

    Raises: InputError if it is no rigid transform.
    """
    table = numbers(where, key, value, (16, 12)).reshape(-1, 4)
    if len(table) == 4 and np.abs(table[3] - [0, 0, 0, 1]).max() > 1e-6:
        mend = "write it row by row; the translation is the last column"
        raise InputError(where, f"the last row of {key} is not 0 0 0 1", mend)
    return rigid(where, key, table[:3, :3], table[:3, 3])


def rigid(where: object, key: str, rotation: np.ndarray, translation: np.ndarray) -> Pose:
    """The (4, 4) transform of a rotation, made orthonormal, and a translation.

    rotation: (3, 3) float64; translation: (3,) float64, m
    Raises: InputError if it is no rotation, or longer than 1 km.
    """
    _check_length(where, key, translation)
    path: Any = where
    return geometry.from_rotation_translation(camera_config.as_rotation(path, key, rotation), translation)


def translation_and_quaternion(where: object, key: str, value: Any) -> Pose:
    """The (4, 4) transform of x y z qx qy qz qw.

    Raises: InputError if there are not 7 numbers or the quaternion is none of length 1.
    """
    row = numbers(where, key, value, (7,))
    length = np.linalg.norm(row[3:])
    if not abs(length - 1) <= _NORM_TOLERANCE:
        mend = "write x y z qx qy qz qw with a unit quaternion"
        raise InputError(where, f"{key}: its quaternion has length {length:.6g} instead of 1", mend)
    _check_length(where, key, row[:3])
    return geometry.from_quaternion_translation(row[3:], row[:3])


def _check_length(where: object, key: str, translation: np.ndarray) -> None:
    if not np.abs(translation).max() <= _MAX_LENGTH_M:
        raise InputError(where, f"{key} is {np.abs(translation).max():g} m long", "write meters")


def need(where: object, mapping: dict[str, Any], key: str, prefix: str = "") -> Any:
    """A value of a mapping. Raises: InputError if it is not there; prefix: where the mapping lies, in errors."""
    if mapping.get(key) is None:
        raise InputError(where, f"{prefix}{key} is missing", f"add {key}")
    return mapping[key]


def lens_of(where: object, model: str) -> Lens | None:
    """The lens that a file's name of a camera or distortion model means; None: without distortion.

    Raises: InputError, naming the model, if it cannot be used here.
    """
    name = model.strip().lower().replace(" ", "_")
    if name in _UNDISTORTED:
        return None
    if name in _EQUIDISTANT:
        return Lens.EQUIDISTANT
    if name in _RADIAL_TANGENTIAL:
        return Lens.RADIAL_TANGENTIAL
    kind = f" ({known})" if (known := _UNKNOWN.get(name)) else ""
    raise InputError(where, f"the camera model {model[:40]!r}{kind} cannot be used", MEND)


def camera(
    where: object,
    lens: Lens | None,
    focal_and_center: np.ndarray,
    coefficients: np.ndarray,
    size: tuple[float, float],
) -> Camera:
    """The camera, checked.

    lens: None: the coefficients must be zero
    focal_and_center: (4,) float64, fx fy cx cy, px, the centre of the first pixel at 0
    coefficients: (N,) float64, k1 k2 p1 p2 [k3 [k4 k5 k6]], or k1 k2 k3 k4 of an equidistant lens
    size: width and height, px; 0 and 0: the file does not say it
    Raises: InputError if a value cannot be of a camera.
    """
    width, height = (int(side) for side in size)
    if (
        (width, height) != tuple(size)
        or not (0 <= width <= _MAX_SIDE and 0 <= height <= _MAX_SIDE)
        or bool(width) != bool(height)
    ):
        raise InputError(
            where, f"{size[0]:g} x {size[1]:g} is not a valid image size", "write width and height in px"
        )
    fx, fy, cx, cy = (float(value) for value in focal_and_center)
    wide, high = (width, height) if width else (_MAX_SIDE, _MAX_SIDE)
    if not (1e-2 * (width or 100) <= fx <= 1e3 * wide and 1e-2 * (height or 100) <= fy <= 1e3 * high):
        raise InputError(where, f"the focal lengths {fx:g} and {fy:g} px are none of such images", "write px")
    if not (-wide <= cx <= 2 * wide and -high <= cy <= 2 * high):
        raise InputError(where, f"the principal point ({cx:g}, {cy:g}) is far outside the image", "write px")
    return Camera(
        width=width,
        height=height,
        fx=fx,
        fy=fy,
        cx=cx,
        cy=cy,
        distortion=_coefficients(where, lens, coefficients),
        lens=lens or Lens.RADIAL_TANGENTIAL,
    )


def _coefficients(where: object, lens: Lens | None, coefficients: np.ndarray) -> tuple[float, ...]:
    """As few as hold all that are not zero."""
    most = {None: 0, Lens.EQUIDISTANT: 4, Lens.RADIAL_TANGENTIAL: 8}[lens]
    if np.any(coefficients[most:]):
        problem = f"has {len(coefficients)} distortion coefficients, of which the model here has {most}"
        raise InputError(where, problem, MEND)
    padded = np.zeros(8)
    padded[: min(len(coefficients), most)] = coefficients[:most]
    if np.abs(padded).max() > 1e4:
        raise InputError(where, "a distortion coefficient is above 10,000", "correct it")
    count = 8 if padded[5:].any() else 5 if padded[4] else 4
    return tuple(float(value) for value in padded[:count])
