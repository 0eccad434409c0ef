"""The settings of a run as JSON Schema and as a flat list: made by pydantic from the dataclasses of the settings."""

import functools
from collections.abc import Iterator, Mapping
from typing import Any

from lvba import config
from lvba.pipeline import Config
from lvba.sources.importing.options import ImportOptions
from service.api.schemas import NewJob

_FACTS = ("level", "unit", "meaning", "range", "change_when", "minimum", "maximum")
"""Of a setting, where its declaration has them."""


@functools.cache
def describe() -> dict[str, Any]:
    """What `GET /v1/options` answers."""
    defaults = config.to_dict(Config())
    whole = NewJob.model_json_schema()
    described = _described(whole["properties"]["config"], whole["$defs"], defaults)
    chosen = config.to_dict(ImportOptions())
    given = whole["properties"]["import"]["anyOf"][0]
    return {**described, "import": _described(given, whole["$defs"], chosen)}


def _described(schema: Mapping[str, Any], groups: Mapping[str, Any], defaults: Any) -> dict[str, Any]:
    whole = _in_place(dict(schema), groups, defaults)
    return {
        "schema": {"$schema": "https://json-schema.org/draft/2020-12/schema", **whole},
        "defaults": defaults,
        "options": list(_flat(whole, "")),
    }


def _in_place(schema: dict[str, Any], groups: Mapping[str, Any], default: Any) -> dict[str, Any]:
    """The schema of a setting or group without references, with the default that it has in this place.

    A group may have another default in its place than it has alone.
    """
    if "$ref" in schema:
        rest = {name: value for name, value in schema.items() if name != "$ref"}
        schema = {**groups[schema["$ref"].rsplit("/", 1)[1]], **rest}
    if "description" in schema:
        schema = {**schema, "description": " ".join(schema["description"].split())}
    if "properties" in schema:
        inner = {
            name: _in_place(one, groups, (default or {}).get(name, one.get("default")))
            for name, one in schema["properties"].items()
        }
        return {**schema, "properties": inner}
    if "items" in schema:
        schema = {**schema, "items": _in_place(schema["items"], groups, None)}
    return {**schema, "default": default}


def _flat(schema: Mapping[str, Any], prefix: str) -> Iterator[dict[str, Any]]:
    for name, one in schema["properties"].items():
        if "properties" in one:
            yield from _flat(one, f"{prefix}{name}.")
            continue
        option = {"name": prefix + name, "group": prefix.rstrip("."), "default": one["default"]}
        option |= {"type": _kind(one), "help": one.get("description", "")}
        option |= {fact: one[fact] for fact in _FACTS if fact in one}
        yield option | ({"choices": one["enum"]} if "enum" in one else {})


def _kind(schema: Mapping[str, Any]) -> str:
    if "enum" in schema:
        return "choice"
    if "anyOf" in schema:
        return " or ".join(map(_kind, schema["anyOf"]))
    return str(schema.get("type", "any"))
