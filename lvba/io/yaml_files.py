"""YAML files of a recording, and the mappings in them."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from lvba.io import files, plain_yaml

MAX_BYTES = 64 * 1024
"""Longest configuration file read; real ones have some kilobytes."""
MAX_DEPTH = 20


def find(folder: Path) -> list[Path]:
    """YAML files of a folder and of its `config` folder, `config.yaml` first.

    Raises: InputError if the folder cannot be read.
    """
    paths: list[Path] = []
    for place in (folder, folder / "config"):
        if os.path.isdir(place):
            names = [
                place / name
                for name in files.names_in(place)
                if Path(name).suffix.lower() in (".yaml", ".yml")
            ]
            paths += sorted(names, key=lambda path: path.stem.lower() != "config")
    return paths


def read_yaml(path: str | Path) -> Any:
    """The value of a YAML file; OpenCV's header (%YAML:1.0) and matrices are understood.

    Raises: InputError if it is too long, no YAML, nested too deep or uses aliases.
    """
    return plain_yaml.load(files.read_text(path, MAX_BYTES), path)


def mappings(value: Any, name: str = "", depth: int = 0) -> Iterator[tuple[str, dict[str, Any]]]:
    """All mappings in a value with the key they lie under, outer ones first."""
    if isinstance(value, dict) and depth < MAX_DEPTH:
        yield name, value
        for key, inner in value.items():
            yield from mappings(inner, str(key), depth + 1)
