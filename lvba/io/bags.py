"""Recordings of ROS, which are told from other files, and not read."""

import os
from pathlib import Path

from lvba.io import files

SUFFIXES = {".bag": "ROS 1 bag", ".db3": "ROS 2 bag", ".mcap": "MCAP file", ".active": "ROS 1 bag"}
MEND = (
    "run an odometry on it, such as FAST-LIVO2 with pcd_save and image_save on, and give the folder that it writes: "
    "scans, images, poses and config.yaml (docs/input.md)"
)


def kind(path: Path) -> str:
    """What bag a file or folder is, or "" if it is none."""
    if not os.path.isdir(path):
        return SUFFIXES.get(path.suffix.lower(), "")
    with files.as_input_error(path):
        inside = sorted(path.iterdir())
    if not any(inner.name == "metadata.yaml" or inner.suffix.lower() == ".bag" for inner in inside):
        return ""
    return next((name for inner in inside if (name := SUFFIXES.get(inner.suffix.lower()))), "")
