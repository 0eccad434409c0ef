"""calibration.yaml of a result: the camera as it was found, in the keys that recordings have, with its uncertainty."""

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from lvba.camera import Camera
from lvba.io import camera_config, files
from lvba.lens import Lens

NAME = "calibration.yaml"


def write(
    folder: str | Path,
    camera: Camera,
    camera_from_scan: np.ndarray,
    time_offset_s: float,
    readout_s: float,
    sigma: dict[str, list[float]],
) -> None:
    """Writes the calibration; its `cam_model` may be put in place of that of a recording.

    camera: of the raw images; camera_from_scan: (4, 4) float64
    sigma: standard deviations by parameter; empty: not refined
    Raises InputError: it cannot be written.
    """
    facts = {
        "cam_model": camera_keys(camera),
        "camera_from_scan": [float(value) for value in camera_from_scan.ravel()],
        "time_offset_s": float(time_offset_s),
        "rolling_shutter_readout_s": float(readout_s),
        "standard_deviations": sigma,
    }
    head = "# The camera as the run used it; px, m and s. Image time + time_offset_s = LiDAR time.\n"
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


def read_camera(folder: str | Path) -> Camera | None:
    """The camera of a result, for its raw images; None where the result has no calibration.yaml.

    Raises InputError: it has one that is damaged.
    """
    path = Path(folder) / NAME
    return camera_config.read_camera(path) if path.is_file() else None
