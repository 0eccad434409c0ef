"""The settings of a run as JSON Schema and as a flat list: from the dataclasses that the command line uses too."""

import ast
import dataclasses
import functools
import inspect
import textwrap
import types
from itertools import pairwise
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from lvba import config
from lvba.pipeline import Config

_PLAIN = {int: "integer", float: "number", bool: "boolean", str: "string", type(None): "null"}


@functools.cache
def describe() -> dict[str, Any]:
    """What `GET /v1/options` answers."""
    defaults = config.to_dict(Config())
    return {
        "schema": {"$schema": "https://json-schema.org/draft/2020-12/schema", **_group(Config, defaults)},
        "defaults": defaults,
        "options": _flat(Config, "", defaults),
    }


def _group(kind: Any, defaults: dict[str, Any]) -> dict[str, Any]:
    """defaults: of the group in its place, which may be others than the class has alone"""
    return {
        "type": "object",
        "title": kind.__name__,
        "description": _summary(kind),
        "additionalProperties": False,
        "properties": {
            name: _described(hint, help_text, defaults[name]) for name, hint, help_text in _fields(kind)
        },
    }


def _described(hint: Any, help_text: str, default: Any) -> dict[str, Any]:
    if dataclasses.is_dataclass(hint):
        return {**_group(hint, default), "description": help_text}
    return {**_type(hint), "default": default, "description": help_text}


def _type(hint: Any) -> dict[str, Any]:
    origin, inner = get_origin(hint), get_args(hint)
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return _group(hint, config.to_dict(hint()))
    if origin is Literal:
        return {"enum": list(inner)}
    if origin in (Union, types.UnionType):
        return {"anyOf": [_type(one) for one in inner]}
    if origin in (tuple, list):
        fixed = origin is tuple and inner and inner[-1] is not Ellipsis
        length = {"minItems": len(inner), "maxItems": len(inner)} if fixed else {}
        return {"type": "array", "items": _type(inner[0]) if inner else {}, **length}
    return {"type": _PLAIN[hint]} if hint in _PLAIN else {}


def _flat(kind: Any, prefix: str, defaults: dict[str, Any]) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = []
    for name, hint, help_text in _fields(kind):
        if dataclasses.is_dataclass(hint):
            found += _flat(hint, f"{prefix}{name}.", defaults[name])
            continue
        described = _type(hint)
        option = {"name": prefix + name, "group": prefix.rstrip("."), "default": defaults[name]}
        option |= {"type": described.get("type", "any"), "help": help_text}
        if "enum" in described:
            option |= {"type": "choice", "choices": described["enum"]}
        elif "anyOf" in described:
            option["type"] = " or ".join(str(one.get("type", "choice")) for one in described["anyOf"])
        found.append(option)
    return found


def _fields(kind: Any) -> list[tuple[str, Any, str]]:
    hints, helps = get_type_hints(kind), field_helps(kind)
    return [(item.name, hints[item.name], helps.get(item.name, "")) for item in dataclasses.fields(kind)]


def _summary(kind: Any) -> str:
    return (inspect.getdoc(kind) or "").split("\n\n")[0].replace("\n", " ")


@functools.cache
def field_helps(kind: Any) -> dict[str, str]:
    """The docstring under each field of a dataclass, by the field's name."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        body = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0]
        statements = body.body if isinstance(body, ast.ClassDef) else []
        for field, text in pairwise(statements):
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
                words = _text(text)
                if words:
                    found[field.target.id] = " ".join(words.split())
    return found


def _text(statement: ast.stmt) -> str:
    if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant):
        return str(statement.value.value)
    return ""
