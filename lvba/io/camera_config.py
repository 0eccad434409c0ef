"""The calibration of a recording: camera intrinsics and extrinsics from YAML, in one file or several.

Read are Global-LVBA's one file (`cam_model: {cam_width, ...}` and `extrin_calib: {...}`) and FAST-LIVO2's two (camera
keys at top level or below any other key, `extrin_calib` in another file; ROS 2 parameter files nest both deeper).

cam_width, cam_height and the intrinsics belong together. `scale` is the factor by which FAST-LIVO2 shrinks images before
it uses and saves them: it changes nothing here, since the image files show their size (`for_size`). FAST-LIVO2 and
Global-LVBA multiply the principal point by the scale; we map pixel centers, as their resizing does.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from lvba import geometry
from lvba.camera import Camera
from lvba.errors import InputError
from lvba.io import camera_keys as names
from lvba.io import image_poses, yaml_files
from lvba.io.camera_keys import as_float
from lvba.io.image_header import ImageSize
from lvba.io.image_poses import Statement
from lvba.lens import Lens

ROTATION_TOLERANCE = 1e-3
"""Largest entry of R R^T - I of a matrix that is taken for a rotation (four printed digits)."""

BODY_FROM_IMU = "body_from_imu"
"""Key of the transform from the axes of imu.csv to the body's, 16 numbers; without it, they are the same."""
_EXTRINSIC_KEYS = ("Rcl", "Pcl", "extrinsic_T", "extrinsic_R")
_MAX_SIDE = 100_000


@dataclass(frozen=True)
class Calibration:
    """What the YAML files of a recording say.

    camera: at cam_width x cam_height; None if no file has camera keys
    scale: the `scale` key
    camera_from_lidar: (4, 4), from Rcl and Pcl; None if no file has them
    body_from_lidar: (4, 4), from extrinsic_R and extrinsic_T; identity if no file has them
    camera_path, extrinsic_path: the files that said so (`config.yaml` if none did)
    warnings: one sentence about each default taken
    image_poses: the `image_poses` key of these files, `camera` or `body`, and its file
    body_from_imu: (4, 4), from `body_from_imu`; None if these files have it not
    """

    camera: Camera | None
    scale: float
    camera_from_lidar: np.ndarray | None
    body_from_lidar: np.ndarray
    camera_path: Path
    extrinsic_path: Path
    warnings: tuple[str, ...] = ()
    image_poses: Statement = field(default_factory=Statement)
    body_from_imu: np.ndarray | None = None


def read_calibration(folder: str | Path) -> Calibration:
    """The calibration in the YAML files of a folder or its `config` folder; `config.yaml` comes first.

    Raises: InputError if a file is no YAML, or a value is missing, malformed or no rotation.
    """
    folder = Path(folder)
    return _calibration(_Documents(yaml_files.find(folder)), folder)


def read_file(path: Path) -> Calibration:
    """The calibration in one YAML file, whatever its name.

    Raises: InputError as `read_calibration`
    """
    return _calibration(_Documents([path]), path.parent)


def _calibration(documents: "_Documents", folder: Path) -> Calibration:
    camera_path, camera_keys = _section(documents, names.native, folder)
    if not camera_keys:
        camera_path, camera_keys = _section(documents, names.foreign, folder)
    extrinsic_path, extrinsic_keys = _section(documents, _extrinsic_section, folder)
    has_camera = any(key in extrinsic_keys for key in ("Rcl", "Pcl"))
    return Calibration(
        camera=_camera(camera_path, camera_keys) if camera_keys else None,
        scale=_number(camera_path, camera_keys, "scale", 1.0, 1e-3, 1e3) if camera_keys else 1.0,
        camera_from_lidar=_transform(extrinsic_path, extrinsic_keys, "Rcl", "Pcl") if has_camera else None,
        body_from_lidar=_transform(
            extrinsic_path, extrinsic_keys, "extrinsic_R", "extrinsic_T", optional=True
        ),
        camera_path=camera_path,
        extrinsic_path=extrinsic_path,
        warnings=_defaults(extrinsic_path, extrinsic_keys) if has_camera else (),
        image_poses=_image_poses(documents),
        body_from_imu=_body_from_imu(documents),
    )


def read_camera(path: Path) -> Camera:
    """The camera in the `cam_model` section of one file.

    Raises InputError: there is none, or a value is missing or malformed.
    """
    document = yaml_files.read_yaml(path)
    section = document.get("cam_model") if isinstance(document, dict) else None
    keys = names.native(path, "cam_model", section) if isinstance(section, dict) else {}
    if not keys:
        raise InputError(path, "has no cam_model", "run again")
    return _camera(path, keys)


def _image_poses(documents: "_Documents") -> Statement:
    """What the files read so far say that image_poses.txt holds."""
    statement = Statement()
    for path, document in documents.read():
        for _, mapping in yaml_files.mappings(document):
            if image_poses.KEY not in mapping:
                continue
            value = mapping[image_poses.KEY]
            if value not in image_poses.KINDS:
                mend = "write body (as FAST-LIVO2 does) or camera (camera to world, z forward)"
                raise InputError(path, f"image_poses is {str(value)[:40]!r}", mend)
            if statement.kind not in ("", value):
                raise InputError(path, "image_poses is there twice with different values", "keep one")
            statement = Statement(value, path.name)
    return statement


def _body_from_imu(documents: "_Documents") -> np.ndarray | None:
    """(4, 4): what the files read so far say of it."""
    said: np.ndarray | None = None
    for path, document in documents.read():
        for _, mapping in yaml_files.mappings(document):
            if BODY_FROM_IMU not in mapping:
                continue
            matrix = _numbers(path, mapping, BODY_FROM_IMU, 16).reshape(4, 4)
            if not np.array_equal(matrix[3], [0, 0, 0, 1]):
                raise InputError(path, f"{BODY_FROM_IMU} does not end in 0, 0, 0, 1", "write it row by row")
            rotation = as_rotation(path, BODY_FROM_IMU, matrix[:3, :3])
            here = geometry.from_rotation_translation(rotation, matrix[:3, 3])
            if said is not None and not np.array_equal(said, here):
                raise InputError(path, f"{BODY_FROM_IMU} is there twice with different values", "keep one")
            said = here
    return said


def _defaults(path: Path, keys: dict[str, Any]) -> tuple[str, ...]:
    missing = [key for key in ("extrinsic_R", "extrinsic_T") if key not in keys]
    return (
        (f"{path}: {' and '.join(missing)} missing: scans are taken to be in the LiDAR's frame.",)
        if missing
        else ()
    )


def for_size(calibration: Calibration, size: ImageSize) -> Camera:
    """The camera of images of another size: they must be shrunk or enlarged by one factor in both directions.

    Raises: InputError if there is no such factor (images that were cropped, turned, or of another camera).
    """
    camera = calibration.camera
    if camera is None:
        raise InputError(
            calibration.camera_path,
            "cam_fx and other camera keys are missing",
            "add cam_model: {cam_fx, ...}",
        )
    return fitted(camera, size, calibration.camera_path, calibration.scale)


def fitted(camera: Camera, size: ImageSize, where: object, scale: float = 1.0) -> Camera:
    """As `for_size`, of a camera without its file. where: names it in errors; scale: a factor that is tried first.

    Raises: InputError as `for_size`
    """
    by = factor(camera, size, scale)
    if by is not None:
        return camera if by == 1 else replace(camera.scaled(by), width=size.width, height=size.height)
    raise InputError(
        where,
        f"cam_width x cam_height is {camera.width} x {camera.height}, but the images are {size.width} x {size.height}",
        "give the calibration of these images",
    )


def factor(camera: Camera, size: ImageSize, scale: float = 1.0) -> float | None:
    """By which images of the camera were shrunk or enlarged to a size, 1 where they have it; None: they were not.

    scale: what is tried first
    """
    if (size.width, size.height) == (camera.width, camera.height):
        return 1.0
    for by in (scale, size.width / camera.width, size.height / camera.height):
        off = max(abs(size.width - by * camera.width), abs(size.height - by * camera.height))
        if off < 1 and size.width != camera.width and size.height != camera.height:
            return by
    return None


class _Documents:
    """YAML files and their values; each is read once, and only if those before it did not say all."""

    def __init__(self, paths: list[Path]) -> None:
        self._paths = paths
        self._values: dict[Path, Any] = {}

    def read(self) -> Iterator[tuple[Path, Any]]:
        """Those that were needed so far."""
        yield from self._values.items()

    def __iter__(self) -> Iterator[tuple[Path, Any]]:
        for path in self._paths:
            if path not in self._values:
                self._values[path] = yaml_files.read_yaml(path)
            yield path, self._values[path]


def _section(
    documents: _Documents, pick: Callable[[Path, str, dict[str, Any]], dict[str, Any]], folder: Path
) -> tuple[Path, dict[str, Any]]:
    """The first file that has such keys, and all of them; `config.yaml` alone if it has some.

    Raises: InputError if they are there twice with different values: we cannot know which camera took the images.
    """
    first, section = folder / "config.yaml", dict[str, Any]()
    for path, document in documents:
        for name, mapping in yaml_files.mappings(document):
            for key, value in pick(path, name, mapping).items():
                before = section.setdefault(key, value)
                if before is not value and before != value:
                    problem = f"has another {key} than {'the same file' if path == first else first.name} has before"
                    raise InputError(path, problem, "keep one calibration, or name its file config.yaml")
                first = path if len(section) == 1 else first
        if section and path.stem.lower() == "config":
            break
    return first, section


def _extrinsic_section(path: Path, name: str, mapping: dict[str, Any]) -> dict[str, Any]:
    return {key: mapping[key] for key in _EXTRINSIC_KEYS if key in mapping}


def _camera(path: Path, keys: dict[str, Any]) -> Camera:
    width = _number(path, keys, "width", None, 1, _MAX_SIDE)
    height = _number(path, keys, "height", None, 1, _MAX_SIDE)
    if width != int(width) or height != int(height):
        raise InputError(path, "cam_width and cam_height are no whole numbers", "correct them")
    lens = Lens(keys.get("lens", Lens.RADIAL_TANGENTIAL))
    return Camera(
        width=int(width),
        height=int(height),
        fx=_number(path, keys, "fx", None, 1e-2 * width, 1e3 * width),
        fy=_number(path, keys, "fy", None, 1e-2 * height, 1e3 * height),
        cx=_number(path, keys, "cx", None, -width, 2 * width),
        cy=_number(path, keys, "cy", None, -height, 2 * height),
        distortion=_distortion(path, keys, lens),
        lens=lens,
    )


def _distortion(path: Path, keys: dict[str, Any], lens: Lens) -> tuple[float, ...]:
    """As few coefficients as hold all that are not zero."""
    values = [_number(path, keys, f"d{index}", 0.0) for index in range(8)]
    count = 4
    if lens is Lens.RADIAL_TANGENTIAL and any(values[4:]):
        count = 8 if any(values[5:]) else 5
    return tuple(values[:count])


def _number(
    path: Path, keys: dict[str, Any], key: str, default: float | None, least: float = -1e4, most: float = 1e4
) -> float:
    name = key if key == "scale" else f"cam_{key}"
    if key not in keys:
        if default is None:
            raise InputError(path, f"{name} is missing", f"add {name} of the camera calibration")
        return default
    value = as_float(keys[key])
    if value is None or not least <= value <= most:
        raise InputError(
            path, f"{name} is {str(keys[key])[:40]!r}", f"write a number from {least:g} to {most:g}"
        )
    return value


def _transform(
    path: Path, keys: dict[str, Any], rotation_key: str, translation_key: str, optional: bool = False
) -> np.ndarray:
    """(4, 4) from 9 and 3 numbers; optional ones are the identity where they are missing."""
    if optional and rotation_key not in keys:
        rotation = np.eye(3)
    else:
        rotation = as_rotation(path, rotation_key, _numbers(path, keys, rotation_key, 9).reshape(3, 3))
    if optional and translation_key not in keys:
        translation = np.zeros(3)
    else:
        translation = _numbers(path, keys, translation_key, 3)
    return geometry.from_rotation_translation(rotation, translation)


def as_rotation(path: Path, key: str, matrix: np.ndarray) -> np.ndarray:
    """The (3, 3) rotation that is nearest to a matrix that is one within what its digits show.

    matrix: (3, 3) float64; key: its name in the file
    Raises: InputError if it is none.
    """
    off = np.abs(matrix @ matrix.T - np.eye(3)).max()
    if not off <= ROTATION_TOLERANCE or np.linalg.det(matrix) < 0:
        reason = "a reflection" if off <= ROTATION_TOLERANCE else f"rows are off orthonormal by {off:.3g}"
        raise InputError(
            path, f"{key} is no rotation: {reason}", "write its 9 numbers row by row, with 6 digits"
        )
    u, _, vt = np.linalg.svd(matrix)
    return np.asarray(u @ vt)


def _numbers(path: Path, keys: dict[str, Any], key: str, count: int) -> np.ndarray:
    """(count,) float64 of a list, nested lists, or an OpenCV matrix."""
    if key not in keys:
        raise InputError(path, f"{key} is missing", f"add {key}: [{count} numbers] to extrin_calib")
    value = keys[key]
    if isinstance(value, dict):
        value = value.get("data")
    values = [as_float(item) for item in _flat(value)]
    if len(values) != count or any(item is None or abs(item) > 1e6 for item in values):
        raise InputError(path, f"{key} is not {count} numbers", f"write {key}: [{count} numbers]")
    return np.array(values, float)


def _flat(value: Any) -> list[Any]:
    if not isinstance(value, list):
        return [value]
    return [item for row in value for item in (row if isinstance(row, list) else [row])]
