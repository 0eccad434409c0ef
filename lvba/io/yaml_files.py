"""YAML files as plain values: no code, no expansion, no surprise in size."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from lvba.errors import InputError
from lvba.io import files

MAX_BYTES = 64 * 1024
"""Longest configuration file read; real ones have some kilobytes."""
MAX_DEPTH = 20
_CORRECT = "correct the YAML"


class _Loader(yaml.SafeLoader):
    """Plain values only: aliases are refused (they let a short file stand for a huge value)."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            event = self.peek_event()
            raise yaml.composer.ComposerError(None, None, "aliases (*name) are not read", event.start_mark)
        return super().compose_node(parent, index)


def _opencv_matrix(loader: yaml.SafeLoader, node: yaml.Node) -> Any:
    if not isinstance(node, yaml.MappingNode):
        raise yaml.constructor.ConstructorError(None, None, "a matrix must be a mapping", node.start_mark)
    return loader.construct_mapping(node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _opencv_matrix)


def find(folder: Path) -> list[Path]:
    """YAML files of a folder and of its `config` folder, `config.yaml` first.

    Raises: InputError if the folder cannot be read.
    """
    found: list[Path] = []
    for place in (folder, folder / "config"):
        if os.path.isdir(place):
            with files.as_input_error(place):
                names = sorted(path for path in place.iterdir() if path.suffix.lower() in (".yaml", ".yml"))
            found += sorted(names, key=lambda path: path.stem.lower() != "config")
    return found


def read_yaml(path: str | Path) -> Any:
    """The value of a YAML file; OpenCV's header (%YAML:1.0) and matrices are understood.

    Raises: InputError if it is too long, no YAML, nested too deep or uses aliases.
    """
    text = files.read_text(path, MAX_BYTES)
    if text.startswith("%YAML:"):  # OpenCV's own spelling; '#' keeps the line numbers
        text = "#" + text
    try:
        return yaml.load(text, _Loader)
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        raise InputError(f"{path}:{line}", " ".join(str(error.problem).split())[:200], _CORRECT) from error
    except yaml.YAMLError as error:
        raise InputError(path, " ".join(str(error).split())[:200], _CORRECT) from error
    except RecursionError as error:
        raise InputError(path, "nested too deep", _CORRECT) from error
    except (
        ValueError,
        ArithmeticError,
        TypeError,
        LookupError,
        AttributeError,
    ) as error:  # a date of month 13
        raise InputError(path, f"a value that is none: {str(error)[:100]}", _CORRECT) from error


def mappings(value: Any, name: str = "", depth: int = 0) -> Iterator[tuple[str, dict[str, Any]]]:
    """All mappings in a value with the key they lie under, outer ones first."""
    if isinstance(value, dict) and depth < MAX_DEPTH:
        yield name, value
        for key, inner in value.items():
            yield from mappings(inner, str(key), depth + 1)
