"""Datasets for nerfstudio: transforms.json beside the undistorted images and the points."""

import json
from pathlib import Path

import numpy as np

from lvba.arrays import Poses
from lvba.camera import Camera
from lvba.io import files

_OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


def write_transforms(
    folder: str | Path, camera: Camera, names: tuple[str, ...], world_from_camera: Poses, ply_name: str
) -> None:
    """Writes transforms.json.

    camera: pinhole, of the images; names: of the images, below images/; world_from_camera: (I, 4, 4), z forward (turned
    here to nerfstudio's y up, z backward); ply_name: the points to start from, in the same folder.
    Raises: InputError if the file cannot be written.
    """
    frames = [
        {"file_path": f"images/{name}", "transform_matrix": (pose @ _OPENGL_FROM_OPENCV).tolist()}
        for name, pose in zip(names, world_from_camera, strict=True)
    ]
    content = {
        "camera_model": "OPENCV",
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx + 0.5,
        "cy": camera.cy + 0.5,
        "k1": 0.0,
        "k2": 0.0,
        "p1": 0.0,
        "p2": 0.0,
        "ply_file_path": ply_name,
        "frames": frames,
    }
    files.write_text(files.make_folder(folder) / "transforms.json", json.dumps(content, indent=1) + "\n")
