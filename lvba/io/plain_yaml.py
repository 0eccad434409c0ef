"""YAML text as plain values: no code, no expansion, no surprise in size."""

import re
from typing import Any

import yaml

from lvba.errors import InputError


class _Loader(yaml.SafeLoader):
    """Plain values only: aliases are refused (they let a short text stand for a huge value)."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            event = yaml.parser.Parser.peek_event(self)
            raise yaml.composer.ComposerError(None, None, "aliases (*name) are not read", event.start_mark)
        return super().compose_node(parent, index)


def _opencv_matrix(loader: yaml.SafeLoader, node: yaml.Node) -> Any:
    if not isinstance(node, yaml.MappingNode):
        raise yaml.constructor.ConstructorError(None, None, "a matrix must be a mapping", node.start_mark)
    return loader.construct_mapping(node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _opencv_matrix)


class _RepeatedName(yaml.constructor.ConstructorError):
    """A name that is twice in one mapping."""


class _UniqueLoader(_Loader):
    """Names are in a mapping once: of two values, nobody knows which one is meant."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for name, _ in node.value:
            if isinstance(name, yaml.ScalarNode) and name.value in seen:
                raise _RepeatedName(None, None, f"{name.value} is there twice", name.start_mark)
            seen.add(str(name.value))
        return super().construct_mapping(node, deep)


_OPENCV_HEADER = "%YAML:"
_CLOSE = re.compile(r"^([ \t]*[A-Za-z_][\w.]*):(?=[-+.\d\"])", re.MULTILINE)
"""A name and its value without a space in between, which OpenCV reads and YAML does not (`Viewer.PointSize:2`)."""


def load(text: str, where: object, mend: str = "correct the YAML", unique: bool = False) -> Any:
    """The value that the text holds; OpenCV's header (%YAML:1.0) and matrices are understood.

    where, mend: for the error; unique: whether a name that is twice in a mapping is an error, or the last one counts
    Raises: InputError if it is no YAML, nested too deep or uses aliases.
    """
    if text.startswith(_OPENCV_HEADER):  # OpenCV's own spelling; '#' keeps the line numbers
        text = "#" + _CLOSE.sub(r"\1: ", text)
    try:
        return yaml.load(text, _UniqueLoader if unique else _Loader)
    except yaml.MarkedYAMLError as error:
        place = f"{where}:{error.problem_mark.line + 1}" if error.problem_mark else where
        if isinstance(error, _RepeatedName):
            raise InputError(place, _shown(error.problem), "keep one") from error
        raise InputError(place, f"not YAML ({_shown(error.problem)})", mend) from error
    except yaml.YAMLError as error:
        raise InputError(where, f"not YAML ({_shown(error)})", mend) from error
    except RecursionError as error:
        raise InputError(where, "nested too deep", mend) from error
    except (ValueError, ArithmeticError, TypeError, LookupError, AttributeError) as error:
        # the constructors of values let these pass: a date of month 13
        raise InputError(where, f"invalid value: {_shown(error)}", mend) from error


def _shown(problem: object) -> str:
    return " ".join(str(problem).split())[:200]
