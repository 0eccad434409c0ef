"""Recordings of ROS, which are told from other files by their names, and imported before they are opened."""

import os
from pathlib import Path

from lvba.io import files

ROS1, ROS2, MCAP = "ROS 1 bag", "ROS 2 bag", "MCAP file"
_SUFFIXES = {".bag": ROS1, ".bag.active": ROS1, ".mcap": MCAP, ".mcap.active": MCAP, ".db3": ROS2}
METADATA = "metadata.yaml"
"""Of the folder of a ROS 2 bag, which says what its files are."""
_PACKED = (".zst", ".zstd")
MEND = "import it first: lvba import BAG --out RECORDING (docs/import.md)"


def kind_of_name(name: str) -> str:
    """What bag a file of this name is, as it is or compressed as a whole; "": none."""
    plain = name.lower()
    for packed in _PACKED:
        plain = plain.removesuffix(packed)
    return next((kind for suffix, kind in _SUFFIXES.items() if plain.endswith(suffix)), "")


def is_packed(name: str) -> bool:
    """Whether a file of this name is a bag that is compressed as a whole."""
    return name.lower().endswith(_PACKED) and bool(kind_of_name(name))


def kind(path: Path) -> str:
    """What bag a file or folder is, or "" if it is none."""
    if not os.path.isdir(path):
        return kind_of_name(path.name)
    with files.as_input_error(path):
        inside = sorted(path.iterdir())
    if not any(inner.name == METADATA or inner.suffix.lower() == ".bag" for inner in inside):
        return ""
    return next((name for inner in inside if (name := kind_of_name(inner.name))), "")
