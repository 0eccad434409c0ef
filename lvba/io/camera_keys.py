"""The names under which YAML files give a camera, and what they mean: FAST-LIVO2's, ROS's, Kalibr's, OpenCV's, VINS's.

All become width, height, fx, fy, cx, cy, scale, lens, and d0 d1 ... = k1 k2 p1 p2 k3 k4 k5 k6, or k1 k2 k3 k4 where the
lens is equidistant. What no name here means is an error in a section that holds a camera alone: a coefficient that is
passed over bends every image. Beside other settings (a file that has everything at top level), names that cannot be of a
camera are passed over.
"""

import difflib
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from lvba.errors import InputError
from lvba.lens import Lens

SECTIONS = ("camera", "cam_model")
"""Names of sections that hold a camera alone."""
_DECIDING = ("cam_width", "cam_height", "cam_fx", "cam_fy")
"""What marks a mapping as one with FAST-LIVO2's camera keys."""
_FOREIGN = (
    ("image_width", "camera_matrix"),
    ("resolution", "intrinsics"),
    ("image_width", "camera_intrinsic"),
    ("image_width", "projection_parameters"),
)
"""What marks a mapping as a camera of ROS, Kalibr, R3LIVE or VINS."""

_MOST = 14
"""Distortion coefficients of OpenCV's largest model."""
_SCALARS = {
    **{name: name for name in ("width", "height", "fx", "fy", "cx", "cy", "scale", "model")},
    **{f"d{i}": f"d{i}" for i in range(_MOST)},
    **dict(zip(("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), (f"d{i}" for i in range(8)), strict=True)),
    **{"image_width": "width", "image_height": "height", "img_width": "width", "img_height": "height"},
    **{"camera_model": "model", "model_type": "model", "camera_type": "model", "type": "model"},
    **{"distortion_model": "distortion_model", "distortion_type": "distortion_model", "xi": "xi"},
}
_SIZES = ("resolution", "image_size", "size")
_FOCALS = ("intrinsics", "intrinsic")
_MATRICES = ("camera_matrix", "K", "camera_intrinsic", "intrinsic_matrix")
_COEFFICIENTS = (
    *("distortion_coefficients", "distortion_coeffs", "distortion", "dist_coeffs", "dist_coeff"),
    *("camera_dist_coeffs", "D"),
)
_AMBIGUOUS = ("type", "size", "resolution", "image_size")
"""Names that mean a camera's only in its own section."""
_NESTED = ("projection_parameters", "distortion_parameters", "mirror_parameters")
_VINS_FISHEYE = {
    **{"mu": "fx", "mv": "fy", "u0": "cx", "v0": "cy"},
    **{"k2": "d0", "k3": "d1", "k4": "d2", "k5": "d3"},
}
"""Names of VINS for an equidistant lens: the coefficient of the angle itself, k1 there, is 1."""
_EXPLAINED = re.compile(
    r"(camera_|cam_)?(name|id|label|frame|frame_id|topic|fps|rate|hz|description|note|comment)|"
    r"(img|image)_topic|rostopic|T_.*|timeshift_.*|cam_overlaps|(rectification|projection)_matrix|R|P|"
    r"rmse.*|.*reproj.*|Rcl|Pcl|extrinsic_[TR]|image_poses|img_time_offset|exposure_time_init|"
    r"ros__parameters|use_sim_time|crs"
)
"""Names in a camera's section that say nothing of how it projects."""
_CAMERA_LIKE = re.compile(
    r"[kpd]\d+|xi|alpha|beta|[KD]|(dist|intrinsic|camera_matrix|projection_param|mirror_param).*"
)
"""Names that are of a camera wherever they stand beside one."""
_KNOWN_DISTORTION = (
    *("plumb_bob", "radtan", "radial-tangential", "radial_tangential", "brown", "brown_conrady"),
    *("rational_polynomial", "opencv", "pinhole", "none", "no", ""),
)
"""Those of k1 k2 p1 p2, and k3 or k3 k4 k5 k6."""
_EQUIDISTANT = (
    *("equidistant", "equidistantcamera", "equi", "fisheye", "opencv_fisheye"),
    *("kannala_brandt", "kannalabrandt", "kannala_brandt4", "kannalabrandt4", "kb4"),
)
"""Those of k1 k2 k3 k4 of the angle off the axis."""
_MODELS = ("distortion_model", "xi", "model")
_RADIAL_TANGENTIAL, _ANGULAR = 8, 4
"""How many coefficients the models have."""
_MEND = "undistort the images to a pinhole, or calibrate k1 k2 p1 p2 (k3 to k6), or an equidistant fisheye"


def native(path: Path, name: str, mapping: dict[str, Any]) -> dict[str, Any]:
    """The camera in one mapping of FAST-LIVO2's or Global-LVBA's; empty if there is none.

    name: the key that the mapping lies under
    Raises: InputError if the mapping says something of the camera that is not known here.
    """
    names = [str(key) for key in mapping]
    mixed = any(key in _DECIDING for key in names)
    alone = name in SECTIONS and any(_canonical(key) or key in _LISTS for key in names)
    return _read(path, name, mapping, alone=name in SECTIONS) if mixed or alone else {}


def foreign(path: Path, name: str, mapping: dict[str, Any]) -> dict[str, Any]:
    """The camera in one mapping as ROS, Kalibr, R3LIVE and VINS write it; empty if there is none.

    Raises: InputError as `native`
    """
    if not any(all(key in mapping for key in keys) for keys in _FOREIGN):
        return {}
    if as_float(mapping.get("fisheye_model")):  # OpenCV's calibration program says a fisheye so
        mapping = {**mapping, "distortion_model": "fisheye"}
    sizes = [key for key in _SIZES if key in mapping]
    return _read(path, name, {**mapping, **{f"cam_{key}": mapping[key] for key in sizes}}, alone=False)


_LISTS = (*_SIZES, *_FOCALS, *_MATRICES, *_COEFFICIENTS, *_NESTED)


def _canonical(key: str) -> str:
    """What a name means, or "": width, ..., d0."""
    return _SCALARS.get(key) or _SCALARS.get(key.removeprefix("cam_"), "")


def _read(path: Path, name: str, mapping: dict[str, Any], *, alone: bool) -> dict[str, Any]:
    _check_model(path, mapping, alone)
    mapping = _without_names_of_vins(mapping)
    values: dict[str, Any] = {}
    source: dict[str, str] = {}
    for key, meaning, value in _meanings(path, name, mapping, alone):
        before = values.setdefault(meaning, value)
        if before is not value and before != value:
            raise InputError(path, f"{source[meaning]} and {key} say different things", "keep one of them")
        source.setdefault(meaning, key)
    kinds = [str(values.get(key, "")).lower() for key in ("model", "distortion_model")]
    if any(kind in _EQUIDISTANT for kind in kinds):
        values = _equidistant(path, values, source)
    _check_distortion(path, values, source)
    return {key: value for key, value in values.items() if key not in _MODELS}


def _without_names_of_vins(mapping: dict[str, Any]) -> dict[str, Any]:
    """The same, where VINS's names of an equidistant lens stand in its sections, with ours."""
    sections = {key: mapping[key] for key in _NESTED if isinstance(mapping.get(key), dict)}
    model = str(mapping.get("model_type", "")).lower()
    if model not in _EQUIDISTANT or not any("mu" in section for section in sections.values()):
        return mapping
    renamed = {
        key: {_VINS_FISHEYE.get(name, name): value for name, value in section.items()}
        for key, section in sections.items()
    }
    return {**mapping, **renamed}


def _equidistant(path: Path, values: dict[str, Any], source: dict[str, str]) -> dict[str, Any]:
    """The same with d0 to d3 = k1 to k4: k3 and k4 have other places where there are p1 and p2."""
    placed = {"lens": Lens.EQUIDISTANT, **values}
    for name, place, target in (("k3", "d4", "d2"), ("k4", "d5", "d3")):
        if source.get(place, "").removeprefix("cam_") == name:
            if target in values:
                raise InputError(path, f"{source[target]} and {source[place]} say different things", _MEND)
            placed[target] = placed.pop(place)
            source[target] = source[place]
    if any(source.get(f"d{index}", "").removeprefix("cam_") in ("p1", "p2") for index in (2, 3)):
        raise InputError(path, "an equidistant lens has no p1 and p2", "give k1 k2 k3 k4")
    return placed


def _meanings(path: Path, name: str, mapping: dict[str, Any], alone: bool) -> Iterator[tuple[str, str, Any]]:
    """Key, what it means, and the value, one number at a time."""
    for raw, value in mapping.items():
        key = str(raw)
        bare = key if key in _LISTS else key.removeprefix("cam_")
        inner = isinstance(value, dict)
        if not alone and key in _AMBIGUOUS:
            continue
        if inner and "data" not in value and bare in _LISTS:
            yield from _meanings(path, key, value, True)
        elif bare in _LISTS:
            yield from _listed(path, key, bare, value)
        elif (meaning := _canonical(key)) and not inner:
            yield key, meaning, value
        elif not _EXPLAINED.fullmatch(key) and _is_camera_s(key, alone and not inner):
            raise _unknown(path, name if alone else "", key)


def _is_camera_s(key: str, alone: bool) -> bool:
    """Whether an unknown name must be taken for one of the camera's."""
    return key not in SECTIONS and (alone or key.startswith("cam_") or bool(_CAMERA_LIKE.fullmatch(key)))


def _listed(path: Path, key: str, bare: str, value: Any) -> Iterator[tuple[str, str, Any]]:
    numbers = _numbers(value)
    if bare in _SIZES and len(numbers) == 2:
        meanings = ["width", "height"]
    elif bare in _FOCALS and len(numbers) == 4:
        meanings = ["fx", "fy", "cx", "cy"]
    elif bare in (*_MATRICES, *_FOCALS) and len(numbers) == 9:
        if any(as_float(numbers[i]) != 0 for i in (1, 3, 6, 7)) or as_float(numbers[8]) != 1:
            raise InputError(
                path, f"{key} is no matrix of fx, fy, cx, cy alone", "write fx 0 cx 0 fy cy 0 0 1"
            )
        meanings, numbers = ["fx", "fy", "cx", "cy"], [numbers[i] for i in (0, 4, 2, 5)]
    elif bare in _COEFFICIENTS and (not numbers or 4 <= len(numbers) <= _MOST):
        meanings = [f"d{i}" for i in range(len(numbers))]
    else:
        mend = "write cam_fx, cam_fy, cam_cx, cam_cy, and cam_d0 to cam_d3 for k1 k2 p1 p2"
        raise InputError(path, f"{key} has {len(numbers)} numbers", mend)
    for meaning, number in zip(meanings, numbers, strict=True):
        yield key, meaning, number


def _numbers(value: Any) -> list[Any]:
    if isinstance(value, dict):
        value = value.get("data")
    if value is None:
        return []
    rows = value if isinstance(value, list) else [value]
    return [item for row in rows for item in (row if isinstance(row, list) else [row])]


def _check_model(path: Path, mapping: dict[str, Any], alone: bool) -> None:
    """That the camera has a model that is known here, as far as names tell."""
    for raw, value in mapping.items():
        key = str(raw)
        meaning = "" if not alone and key in _AMBIGUOUS else _canonical(key)
        if isinstance(value, dict):
            if key in _NESTED:
                _check_model(path, value, True)
        elif meaning == "model" and not _is_model(value):
            problem = f"the camera model {str(value)[:40]!r} is not known"
            raise InputError(path, problem, "undistort the images to a pinhole")
        elif meaning == "xi":
            problem = f"{key} is of an omnidirectional (Mei) camera, which is not known"
            raise InputError(path, problem, "undistort the images to a pinhole")
        elif meaning == "distortion_model" and str(value).lower() not in (*_KNOWN_DISTORTION, *_EQUIDISTANT):
            raise InputError(path, f"the distortion model {str(value)[:40]!r} is not known", _MEND)


def _is_model(value: Any) -> bool:
    text = str(value).lower()
    return "pinhole" in text or text in _EQUIDISTANT


def _check_distortion(path: Path, values: dict[str, Any], source: dict[str, str]) -> None:
    """That coefficients beyond those of the model are zero, and drops them."""
    for index in range(_ANGULAR if "lens" in values else _RADIAL_TANGENTIAL, _MOST):
        value = values.pop(f"d{index}", 0)
        if as_float(value) != 0:
            kind = " (of a thin prism or a tilted sensor)" if index >= _RADIAL_TANGENTIAL else ""
            known = f"a model with such a coefficient is not known{kind}"
            problem = f"{source[f'd{index}']} is {str(value)[:40]!r}: {known}"
            raise InputError(path, problem, _MEND)


def as_float(value: Any) -> float | None:
    """The finite number, also where YAML 1.1 takes it for text (1e-3), or None."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return None
    try:
        number = float(value)
    except (ValueError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def _unknown(path: Path, section: str, key: str) -> InputError:
    names = [*_SCALARS, *_LISTS, *(f"cam_{name}" for name in _SCALARS)]
    close = difflib.get_close_matches(key, names, 1, 0.75)
    mend = f"did you mean {close[0]}?" if close else "remove it, or name it as docs/input.md does"
    place = f"{section}.{key}" if section else key
    return InputError(path, f"the camera key {place[:80]} is not known", mend)
