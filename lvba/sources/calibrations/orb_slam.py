"""Settings of ORB-SLAM2 and ORB-SLAM3: names with dots, at top level.

    Camera.type: PinHole, Rectified or KannalaBrandt8; not in all files of ORB-SLAM2, which has pinholes alone
    Camera.fx, fy, cx, cy; k1 k2 p1 p2 k3 of a pinhole, k1 k2 k3 k4 of KannalaBrandt8 (equidistant)
    Camera1.fx, ..., Camera2.fx, ...         the same in files of version 1.0
    Camera.width, Camera.height              not in all files
    IMU.T_b_c1 (Tbc in older files)          body (IMU) from the first camera
    Stereo.T_c1_c2                           first camera from the second

Pixel centers are at whole numbers, as OpenCV has them. Source: Calibration_Tutorial.pdf of ORB-SLAM3.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np

from lvba.arrays import Pose
from lvba.camera import Camera
from lvba.errors import InputError
from lvba.lens import Lens
from lvba.sources.calibrations import values
from lvba.sources.calibrations.rig import FileCalibration

_INTRINSIC = re.compile(r"(Camera[12]?)\.(?:fx|fy|cx|cy)")
_TYPE, _WIDTH, _HEIGHT = "Camera.type", "Camera.width", "Camera.height"
_LENSES = {"rectified": Lens.RADIAL_TANGENTIAL, "kannalabrandt8": Lens.EQUIDISTANT}
"""Names of ORB-SLAM's own; others are as `values.lens_of` knows them."""
_COEFFICIENTS = {
    Lens.RADIAL_TANGENTIAL: ("k1", "k2", "p1", "p2", "k3"),
    Lens.EQUIDISTANT: ("k1", "k2", "k3", "k4"),
}
_EVERY = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
_BODY_FROM_FIRST = ("IMU.T_b_c1", "Tbc")
_FIRST_FROM_SECOND = "Stereo.T_c1_c2"
_RECTIFYING = "LEFT.K"


def is_one(document: dict[str, Any]) -> bool:
    """Whether a YAML file has intrinsics under ORB-SLAM's names."""
    return bool(_cameras(document))


def _cameras(document: dict[str, Any]) -> list[str]:
    """Camera, Camera1, Camera2: those that the file has."""
    matches = (_INTRINSIC.fullmatch(str(key)) for key in document)
    return sorted({match[1] for match in matches if match})


def read(path: Path, document: dict[str, Any]) -> tuple[FileCalibration, ...]:
    """Each camera, and where it is on the body; the size of its images is 0 where the file does not say it.

    Raises: InputError if a value is missing or malformed, or the model cannot be used.
    """
    names = _cameras(document)
    size = _size(path, document)
    notes: tuple[str, ...] = ()
    if _RECTIFYING in document:
        notes = (
            f"{path}: {names[0]}.fx and the like are of images that ORB-SLAM rectifies by {_RECTIFYING}.",
        )
    return tuple(
        FileCalibration(
            path=str(path),
            name=name if len(names) > 1 else "",
            camera=_camera(path, document, name, size),
            body_from_camera=_body_from_camera(path, document, second=name == "Camera2"),
            notes=notes,
        )
        for name in names
    )


def _size(path: Path, document: dict[str, Any]) -> tuple[float, float]:
    there = [key for key in (_WIDTH, _HEIGHT) if document.get(key) is not None]
    if not there:
        return 0.0, 0.0
    width, height = (values.number(path, key, values.need(path, document, key)) for key in (_WIDTH, _HEIGHT))
    return width, height


def _camera(path: Path, document: dict[str, Any], name: str, size: tuple[float, float]) -> Camera:
    lens = _lens(path, document)
    intrinsics = [
        values.number(path, f"{name}.{key}", values.need(path, document, f"{name}.{key}"))
        for key in ("fx", "fy", "cx", "cy")
    ]
    coefficients = {
        key: values.number(path, f"{name}.{key}", value)
        for key in _EVERY
        if (value := document.get(f"{name}.{key}")) is not None
    }
    used = _COEFFICIENTS[lens]
    foreign = next((key for key, value in coefficients.items() if value and key not in used), None)
    if foreign is not None:
        said = document.get(_TYPE, "PinHole")
        mend = f"give {' '.join(used)} alone, or correct {_TYPE}"
        raise InputError(path, f"{name}.{foreign} is not a parameter of a {str(said)[:40]} camera", mend)
    distortion = np.array([coefficients.get(key, 0.0) for key in used])
    return values.camera(path, lens, np.array(intrinsics), distortion, size)


def _lens(path: Path, document: dict[str, Any]) -> Lens:
    name = str(document.get(_TYPE) or "PinHole")
    known = _LENSES.get(name.strip().lower())
    return known or values.lens_of(path, name) or Lens.RADIAL_TANGENTIAL


def _body_from_camera(path: Path, document: dict[str, Any], second: bool) -> Pose | None:
    key = next((key for key in _BODY_FROM_FIRST if key in document), None)
    if key is None or (second and _FIRST_FROM_SECOND not in document):
        return None
    body_from_first = values.matrix(path, key, document[key])
    if not second:
        return body_from_first
    return np.asarray(body_from_first @ values.matrix(path, _FIRST_FROM_SECOND, document[_FIRST_FROM_SECOND]))
