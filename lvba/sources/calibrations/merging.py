"""One calibration of a rig from several files.

The rule: what one file says counts. What several files say must be the same (cameras to 6 digits, transforms to 0.1
degrees and 1 mm, time offsets to 1 ms); the file given first counts then. Of camera_from_lidar, body_from_lidar and
body_from_camera, the third follows from two; where all three are said they must close to 0.5 degrees and 1 cm, and stay
as they are said. All else is an error that names the files.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from lvba import geometry
from lvba.arrays import Pose
from lvba.errors import InputError
from lvba.io import yaml_files
from lvba.sources.calibrations import (
    agreement,
    colmap_cameras,
    dvlc,
    kalibr,
    lists_of_cameras,
    orb_slam,
    single_files,
)
from lvba.sources.calibrations.rig import FileCalibration, RigCalibration

_TRANSFORMS = ("camera_from_lidar", "body_from_lidar", "body_from_camera")
_MEND = "give one of the files, or correct one"
_ONE = "choose by --camera NAME, or give a file with the topic of its images, or with this camera alone"


def read(paths: Iterable[str | Path], camera: str = "") -> RigCalibration:
    """What calibration files of other programs say of one camera, merged; the formats are in docs/sources.md.

    camera: which one, where a file has several: its name in the file, or the topic of its images
    Raises: InputError: a file is of no known kind, malformed, of a camera model that cannot be used, has several cameras
    of which none is asked for, or contradicts another.
    """
    chosen = [_chosen(path, read_file(path), camera) for path in map(Path, paths)]
    merged: dict[str, Any] = {}
    origins: dict[str, str] = {}
    for file in chosen:
        _add(file, merged, origins)
    _complete(merged, origins)
    return RigCalibration(
        **merged,
        topic=next((file.topic for file in chosen if file.topic), ""),
        names=tuple(dict.fromkeys(file.name for file in chosen if file.name)),
        origins=origins,
        notes=tuple(note for file in chosen for note in file.notes),
    )


def read_file(path: Path) -> tuple[FileCalibration, ...]:
    """All cameras of one file; one without a name, where it is a file of one.

    Raises: InputError as `read`
    """
    suffix = path.suffix.lower()
    if suffix == ".json":
        return (dvlc.read(path),)
    if suffix == ".txt":
        return colmap_cameras.read(path)
    if suffix not in (".yaml", ".yml"):
        mend = "give a YAML file, calib.json of direct_visual_lidar_calibration, or cameras.txt of COLMAP"
        raise InputError(path, "is no calibration file of a known kind", mend)
    document = yaml_files.read_yaml(path)
    if not isinstance(document, dict):
        raise InputError(path, "holds no names with values", "give a calibration file")
    return _of_yaml(path, document)


def _of_yaml(path: Path, document: dict[str, Any]) -> tuple[FileCalibration, ...]:
    if lists_of_cameras.is_omni_livo(document):
        return lists_of_cameras.read_omni_livo(path, document)
    if lists_of_cameras.is_spires(document):
        return lists_of_cameras.read_spires(path, document)
    if kalibr.is_one(document):
        return kalibr.read(path, document)
    if orb_slam.is_one(document):
        return orb_slam.read(path, document)
    if single_files.is_result(document):
        return (single_files.read_result(path, document),)
    if single_files.is_m2mapping(document):
        return (single_files.read_m2mapping(path, document),)
    if single_files.is_camera_lidar(document):
        return (single_files.read_camera_lidar(path, document),)
    return (single_files.read_yaml(path, document),)


def _chosen(path: Path, cameras: tuple[FileCalibration, ...], wanted: str) -> FileCalibration:
    if len(cameras) == 1:
        return cameras[0]
    names = ", ".join(f"{each.name} ({each.topic})" if each.topic else each.name for each in cameras[:8])
    if not wanted:
        raise InputError(path, f"has {len(cameras)} cameras: {names}", _ONE)
    fitting = [each for each in cameras if each.name == wanted or _same_topic(each.topic, wanted)]
    if not fitting and not any(each.topic for each in cameras):
        fitting = [each for each in cameras if each.name in wanted.split("/")]
    if len(fitting) != 1:
        how = "has no camera" if not fitting else "has several cameras"
        raise InputError(path, f"{how} {wanted[:80]!r}: {names}", _ONE)
    return fitting[0]


def _same_topic(topic: str, wanted: str) -> bool:
    """Equal, or one is the other's compressed form."""
    first, second = (name.strip("/").removesuffix("/compressed") for name in (topic, wanted))
    return bool(first) and first == second


def _add(file: FileCalibration, merged: dict[str, Any], origins: dict[str, str]) -> None:
    """Takes what a file says that none has said before, and compares the rest."""
    for name in ("camera", *_TRANSFORMS, "camera_time_offset_s"):
        value = getattr(file, name)
        if value is None:
            continue
        if name not in merged:
            merged[name], origins[name] = value, file.path
            if name == "camera_time_offset_s":
                merged["clock"] = file.clock
        elif not _same(name, merged[name], value):
            problem = f"says another {name} than {origins[name]}{_how_far(name, merged[name], value)}"
            raise InputError(file.path, problem, _MEND)
        elif name == "camera":
            merged[name] = agreement.with_size(merged[name], value)


def _same(name: str, first: Any, second: Any) -> bool:
    if name == "camera":
        return agreement.same_camera(first, second)
    if name in _TRANSFORMS:
        return agreement.same_transform(first, second)
    return bool(abs(first - second) <= agreement.SAME_TIME_S)


def _how_far(name: str, first: Any, second: Any) -> str:
    if name == "camera":
        return ""
    if name not in _TRANSFORMS:
        return f": {second:g} s, not {first:g} s"
    degrees, meters = agreement.difference(first, second)
    inverse = agreement.same_transform(geometry.inverse(first), second)
    return f" ({degrees:.2f} degrees and {meters:.3f} m off)" + (": its inverse" if inverse else "")


def _complete(merged: dict[str, Any], origins: dict[str, str]) -> None:
    """The third of three transforms from two; where all are there, that they close."""
    missing = [name for name in _TRANSFORMS if name not in merged]
    if not missing:
        closed = merged["body_from_camera"] @ merged["camera_from_lidar"]
        if not agreement.same_transform(
            merged["body_from_lidar"], closed, agreement.CONSISTENT_DEG, agreement.CONSISTENT_M
        ):
            degrees, meters = agreement.difference(merged["body_from_lidar"], closed)
            problem = (
                f"body_from_camera and camera_from_lidar ({origins['camera_from_lidar']}) do not make body_from_lidar "
                f"({origins['body_from_lidar']}): {degrees:.2f} degrees and {meters:.3f} m off"
            )
            raise InputError(origins["body_from_camera"], problem, _MEND)
    elif len(missing) == 1:
        name = missing[0]
        merged[name] = _third(name, merged)
        origins[name] = " and ".join(dict.fromkeys(origins[each] for each in _TRANSFORMS if each != name))


def _third(name: str, merged: dict[str, Pose]) -> Pose:
    if name == "camera_from_lidar":
        return np.asarray(geometry.inverse(merged["body_from_camera"]) @ merged["body_from_lidar"])
    if name == "body_from_lidar":
        return np.asarray(merged["body_from_camera"] @ merged["camera_from_lidar"])
    return np.asarray(merged["body_from_lidar"] @ geometry.inverse(merged["camera_from_lidar"]))
