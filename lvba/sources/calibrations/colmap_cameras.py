"""cameras.txt of a COLMAP model: CAMERA_ID MODEL WIDTH HEIGHT PARAMS[], one camera a line.

COLMAP puts the center of the first pixel at (0.5, 0.5), lvba at (0, 0). Source: https://colmap.github.io/cameras.html
"""

from pathlib import Path

import numpy as np

from lvba.camera import Camera
from lvba.errors import InputError
from lvba.io import files
from lvba.io.camera_keys import as_float
from lvba.lens import Lens
from lvba.sources.calibrations import values
from lvba.sources.calibrations.rig import FileCalibration

_RADIAL, _ANGULAR = Lens.RADIAL_TANGENTIAL, Lens.EQUIDISTANT
_MODELS = {
    "SIMPLE_PINHOLE": (_RADIAL, 1, 0),
    "PINHOLE": (_RADIAL, 2, 0),
    "SIMPLE_RADIAL": (_RADIAL, 1, 1),
    "RADIAL": (_RADIAL, 1, 2),
    "OPENCV": (_RADIAL, 2, 4),
    "FULL_OPENCV": (_RADIAL, 2, 8),
    "OPENCV_FISHEYE": (_ANGULAR, 2, 4),
    "SIMPLE_RADIAL_FISHEYE": (_ANGULAR, 1, 1),
    "RADIAL_FISHEYE": (_ANGULAR, 1, 2),
}
"""Lens, number of focal lengths, and of coefficients: in the order k1 k2 p1 p2 k3 k4 k5 k6, or k1 k2 k3 k4."""
_LINE = "CAMERA_ID MODEL WIDTH HEIGHT PARAMS"


def read(path: Path) -> tuple[FileCalibration, ...]:
    """Each camera, named by its id.

    Raises: InputError with the line, if it is malformed or of a model that cannot be used.
    """
    cameras = []
    for number, line in enumerate(files.read_text(path).split("\n"), 1):
        words = line.split("#", 1)[0].split()
        if words:
            camera = _camera(f"{path}:{number}", words)
            cameras.append(FileCalibration(path=str(path), name=words[0], camera=camera))
    if not cameras:
        raise InputError(path, "holds no camera", f"write {_LINE} a line")
    return tuple(cameras)


def _camera(where: str, words: list[str]) -> Camera:
    if len(words) < 5:
        raise InputError(
            where, f"{len(words)} values", f"write {_LINE}, as cameras.txt of a COLMAP model has"
        )
    model = words[1].upper()
    if model not in _MODELS:
        values.lens_of(where, words[1])
        raise InputError(where, f"the camera model {words[1][:40]!r} is not known", values.MEND)
    lens, focals, count = _MODELS[model]
    parameters = [as_float(word) for word in words[4:]]
    size = [as_float(word) for word in words[2:4]]
    if len(parameters) != focals + 2 + count or None in parameters or None in size or 0 in size:
        mend = f"write {model} with {focals + 2 + count} parameters after width and height"
        raise InputError(where, "not as many finite numbers as the model has", mend)
    numbers = np.array(parameters, float)
    center = numbers[focals : focals + 2] - 0.5
    focal = np.repeat(numbers[:1], 2) if focals == 1 else numbers[:2]
    width, height = (float(side or 0) for side in size)
    return values.camera(where, lens, np.concatenate([focal, center]), numbers[focals + 2 :], (width, height))
