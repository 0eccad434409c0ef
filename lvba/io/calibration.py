"""calibration.yaml of a result: the camera as it was found, in the keys that recordings have, with its uncertainty."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from lvba.arrays import Pose
from lvba.camera import Camera
from lvba.errors import InputError
from lvba.io import camera_config, files, yaml_files
from lvba.io.camera_keys import as_float
from lvba.lens import Lens

NAME = "calibration.yaml"


def write(
    folder: str | Path,
    camera: Camera,
    camera_from_scan: np.ndarray,
    time_offset_s: float,
    readout_s: float,
    sigma: dict[str, list[float]],
    vignetting: np.ndarray | None = None,
    response: np.ndarray | None = None,
    clock: tuple[float, float] | None = None,
) -> None:
    """Writes the calibration; its `cam_model` may be put in place of that of a recording.

    camera: of the raw images; camera_from_scan: (4, 4) float64
    sigma: standard deviations by parameter; empty: not refined
    vignetting: (5,) float64, numbers of a `visual.vignetting.Vignetting`; None: none was found
    response: (2, K) float64, grey values, and the slope of log light over log grey value there; None: none was found
    clock: rate of the camera's clock, s a second, and the stamp, s, that it counts from; None: none was found
    Raises InputError: it cannot be written.
    """
    facts: dict[str, Any] = {
        "cam_model": camera_keys(camera),
        "camera_from_scan": [float(value) for value in camera_from_scan.ravel()],
        "time_offset_s": float(time_offset_s),
        "rolling_shutter_readout_s": float(readout_s),
        "standard_deviations": sigma,
    }
    offset = "time_offset_s"
    if clock is not None:
        facts |= {"clock_rate": float(clock[0]), "clock_epoch_s": float(clock[1])}
        offset += " + clock_rate * (image time - clock_epoch_s)"
    if vignetting is not None:
        numbers = [float(value) for value in vignetting]
        facts["vignetting"] = {"coefficients": numbers[:3], "center": numbers[3:]}
    if response is not None:
        facts["response"] = dict(zip(("grey_values", "slopes"), response.tolist(), strict=True))
    head = f"# The camera as the run used it; px, m and s. Image time + {offset} = LiDAR time.\n"
    text = yaml.safe_dump(facts, sort_keys=False, default_flow_style=None, width=120)
    files.write_text(files.make_folder(folder) / NAME, head + text, durable=True)


def camera_keys(camera: Camera) -> dict[str, Any]:
    """A camera in the keys that recordings have, as FAST-LIVO2 names them."""
    keys: dict[str, Any] = {
        "cam_width": camera.width,
        "cam_height": camera.height,
        "scale": 1.0,
        "cam_fx": camera.fx,
        "cam_fy": camera.fy,
        "cam_cx": camera.cx,
        "cam_cy": camera.cy,
    }
    if camera.lens is Lens.EQUIDISTANT:
        keys["model"] = "EquidistantCamera"
        return keys | {f"k{index}": float(value) for index, value in enumerate(camera.distortion, 1)}
    return keys | {f"cam_d{index}": float(value) for index, value in enumerate(camera.distortion)}


def read_vignetting(folder: str | Path) -> np.ndarray | None:
    """(5,) float64, as of `write`; None where the result has none.

    Raises InputError: its calibration.yaml is damaged.
    """
    return _numbers(folder, "vignetting", {"coefficients": 3, "center": 2})


def read_slopes(folder: str | Path, count: int) -> np.ndarray | None:
    """(count,) float64, slopes of the response as of `write`; None where the result has none.

    Raises InputError: its calibration.yaml is damaged.
    """
    return _numbers(folder, "response", {"slopes": count})


def _numbers(folder: str | Path, name: str, lists: dict[str, int]) -> np.ndarray | None:
    """All numbers of a section, (N,) float64, list by list, each of a given length; None: there is no such section."""
    path = Path(folder) / NAME
    facts = yaml_files.read_yaml(path) if path.is_file() else None
    section = facts.get(name) if isinstance(facts, dict) else None
    if not isinstance(section, dict):
        return None
    values = [section.get(key) for key in lists]
    if [len(each) if isinstance(each, list) else 0 for each in values] == list(lists.values()):
        numbers = [as_float(value) for each in values for value in each or ()]
        if None not in numbers:
            return np.array(numbers, float)
    wanted = " and ".join(f"{count} numbers of {key}" for key, count in lists.items())
    raise InputError(path, f"{name} is not {wanted}", "run again")


def read_readout(folder: str | Path) -> float:
    """s, from the first to the last row of an image; 0 where the result has no calibration.yaml, or this says none.

    Raises InputError: its calibration.yaml is damaged.
    """
    path = Path(folder) / NAME
    facts = yaml_files.read_yaml(path) if path.is_file() else None
    value = facts.get("rolling_shutter_readout_s", 0.0) if isinstance(facts, dict) else 0.0
    seconds = as_float(value)
    if seconds is None or not np.isfinite(seconds):
        raise InputError(path, "rolling_shutter_readout_s is no number", "run again")
    return seconds


def read_camera(folder: str | Path) -> Camera | None:
    """The camera of a result, for its raw images; None where the result has no calibration.yaml.

    Raises InputError: it has one that is damaged.
    """
    path = Path(folder) / NAME
    return camera_config.read_camera(path) if path.is_file() else None


def recording_text(
    camera: Camera | None,
    body_from_lidar: Pose,
    camera_from_lidar: Pose | None,
    more: Mapping[str, str] | None = None,
    body_from_imu: Pose | None = None,
) -> str:
    """config.yaml of a recording, in FAST-LIVO2's keys.

    camera, camera_from_lidar: (4, 4), m; None without images; more: other keys at top level
    body_from_imu: (4, 4), m; None: not said, or the identity
    """
    lines = [] if camera is None else ["cam_model:"]
    if camera is not None:
        lines += [f"  {key}: {value}" for key, value in camera_keys(camera).items()]
    lines.append("extrin_calib:")
    for rotation, translation, transform in (
        ("extrinsic_R", "extrinsic_T", body_from_lidar),
        ("Rcl", "Pcl", camera_from_lidar),
    ):
        if transform is not None:
            lines.append(f"  {rotation}: {transform[:3, :3].ravel().tolist()}")
            lines.append(f"  {translation}: {transform[:3, 3].tolist()}")
    if body_from_imu is not None:
        lines.append(f"{camera_config.BODY_FROM_IMU}: {body_from_imu.ravel().tolist()}")
    lines += [f"{key}: {value}" for key, value in (more or {}).items()]
    return "\n".join(lines) + "\n"
