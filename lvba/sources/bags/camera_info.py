"""Cameras from sensor_msgs/CameraInfo."""

import contextlib
import math
from dataclasses import replace
from typing import Any

from lvba.camera import Camera
from lvba.lens import Lens
from lvba.sources.bags.definitions import Undecodable
from lvba.sources.source import CameraInfo

_BROWN = ("plumb_bob", "rational_polynomial", "radtan", "radial-tangential", "")
_FISHEYE = ("equidistant", "fisheye", "kannala_brandt")
_MOST = {"plumb_bob": 5, "radtan": 5, "radial-tangential": 5, "rational_polynomial": 8, "": 8}


def info(values: dict[str, Any], stamp: int, frame: str, *, rectified: bool) -> CameraInfo:
    """What a message says. stamp: ns; frame: of its header; rectified: what its images are, by their name

    Raises Undecodable: as `camera`; of the other camera, that is none.
    """
    usual, other = camera(values, rectified=rectified), None
    if usual is not None:
        with contextlib.suppress(Undecodable):
            other = camera(values, rectified=not rectified)
    return CameraInfo(stamp, frame, usual, None if other == usual else other, rectified)


def camera(values: dict[str, Any], *, rectified: bool = False) -> Camera | None:
    """The camera of the images that go with it, of the region and binning that it says; None where its matrix is empty.

    rectified: of image_rect topics: the camera is P, without distortion; else K and D
    Raises Undecodable: its lens is of another model, or its numbers are none.
    """
    matrix = (
        _of_projection(values["p"])
        if rectified
        else (values["k"][0], values["k"][4], values["k"][2], values["k"][5])
    )
    if not any(matrix):
        return None
    if not all(map(math.isfinite, matrix)) or matrix[0] <= 0 or matrix[1] <= 0:
        raise Undecodable("its matrix is not a camera matrix")
    fx, fy, cx, cy = map(float, matrix)
    lens, distortion = (Lens.RADIAL_TANGENTIAL, (0.0,) * 4) if rectified else _lens(values)
    whole = Camera(
        width=int(values["width"]),
        height=int(values["height"]),
        fx=fx,
        fy=fy,
        cx=cx,
        cy=cy,
        distortion=distortion,
        lens=lens,
    )
    return _of_images(whole, values)


def _of_projection(p: tuple[float, ...]) -> tuple[float, float, float, float]:
    return p[0], p[5], p[2], p[6]


def _lens(values: dict[str, Any]) -> tuple[Lens, tuple[float, ...]]:
    model = values["distortion_model"].strip().lower()
    coefficients = tuple(float(value) for value in values["d"][:20])
    if not all(map(math.isfinite, coefficients)):
        raise Undecodable("its distortion has values that are not finite numbers")
    if not any(coefficients):
        known = model in _FISHEYE
        return (Lens.EQUIDISTANT if known else Lens.RADIAL_TANGENTIAL), (0.0,) * 4
    if model in _FISHEYE:
        if any(coefficients[4:]) or len(coefficients) < 4:
            raise Undecodable(f"a fisheye with {len(coefficients)} coefficients")
        return Lens.EQUIDISTANT, coefficients[:4]
    if model not in _BROWN:
        raise Undecodable(f"a lens of the model {model[:40]!r}")
    most = _MOST[model]
    if any(coefficients[most:]):
        raise Undecodable(f"a lens with {len(coefficients)} coefficients")
    coefficients = (*coefficients[:most], *(0.0,) * max(0, 4 - len(coefficients)))
    while len(coefficients) not in (4, 5, 8):
        coefficients = (*coefficients, 0.0)
    return Lens.RADIAL_TANGENTIAL, coefficients


def _of_images(whole: Camera, values: dict[str, Any]) -> Camera:
    """The camera of images that show a region of the sensor, with so many of its pixels binned to one each.

    Source: sensor_msgs/CameraInfo; K is of the whole sensor at full resolution, and so is the region.
    """
    roi = {name: int(values[f"roi.{name}"]) for name in ("x_offset", "y_offset", "width", "height")}
    width, height = roi["width"] or whole.width, roi["height"] or whole.height
    binning = (max(1, int(values["binning_x"])), max(1, int(values["binning_y"])))
    cut = replace(
        whole, width=width, height=height, cx=whole.cx - roi["x_offset"], cy=whole.cy - roi["y_offset"]
    )
    if binning == (1, 1):
        return cut
    by_x, by_y = (1 / each for each in binning)
    return replace(
        cut,
        width=width // binning[0],
        height=height // binning[1],
        fx=cut.fx * by_x,
        fy=cut.fy * by_y,
        cx=(cut.cx + 0.5) * by_x - 0.5,
        cy=(cut.cy + 0.5) * by_y - 0.5,
    )
