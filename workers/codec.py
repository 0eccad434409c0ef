"""Artifacts as JSON and named arrays, and back: the same value, the same types, the same bytes.

Handles None, bool, int, float, str, numpy scalars and arrays, lists, tuples, dicts, dataclasses and enums of lvba,
nested in any way.
"""

import base64
import dataclasses
import enum
import importlib
import math
from typing import Any

import numpy as np

from lvba.errors import ArtifactError

SMALL_BYTES = 2048
"""Arrays up to this size stand in the JSON: a file each, synced to disk, would take longer than the work they hold."""
PACKAGE = "lvba"
"""Only classes of this package are ever made from stored names."""


def encode(value: Any, arrays: dict[str, np.ndarray], name: str = "value") -> Any:
    """JSON data for the value; the arrays in it go into `arrays`, named by their place.

    Raises TypeError: a value that cannot be stored.
    """
    if isinstance(value, enum.Enum):
        return {"$enum": _name_of(value, name), "value": encode(value.value, arrays, name)}
    if value is None or (isinstance(value, bool | int | str) and not isinstance(value, np.generic)):
        return value
    if isinstance(value, np.ndarray):
        return _encode_array(value, arrays, name)
    if isinstance(value, np.generic):
        return {"$scalar": str(value.dtype), "value": encode(value.item(), arrays, name)}
    if isinstance(value, float):
        return value if math.isfinite(value) else {"$float": repr(value)}
    if isinstance(value, list):
        return [encode(item, arrays, f"{name}.{i}") for i, item in enumerate(value)]
    if isinstance(value, tuple) and type(value) is tuple:
        return {"$tuple": [encode(item, arrays, f"{name}.{i}") for i, item in enumerate(value)]}
    if isinstance(value, dict):
        return _encode_dict(value, arrays, name)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return _encode_object(value, arrays, name)
    raise TypeError(f"{name}: a {type(value).__qualname__} cannot be stored")


def decode(data: Any, arrays: Any) -> Any:
    """The value that `encode` was given.

    arrays: the named arrays, as a mapping
    Raises ArtifactError: not what `encode` writes, or a class that does not exist (any more).
    """
    if isinstance(data, list):
        return [decode(item, arrays) for item in data]
    if not isinstance(data, dict):
        return data
    if "$array" in data:
        return arrays[data["$array"]]
    if "$bytes" in data:
        flat = np.frombuffer(base64.b64decode(data["$bytes"]), data["dtype"])
        return flat.reshape(data["shape"]).copy()
    if "$strings" in data:
        return np.array(data["$strings"], dtype=data["dtype"])
    if "$scalar" in data:
        return np.dtype(data["$scalar"]).type(decode(data["value"], arrays))
    if "$float" in data:
        return float(data["$float"])
    if "$tuple" in data:
        return tuple(decode(item, arrays) for item in data["$tuple"])
    if "$dict" in data:
        return {decode(key, arrays): decode(item, arrays) for key, item in data["$dict"]}
    if "$enum" in data:
        return _member(find_class(data["$enum"]), decode(data["value"], arrays))
    if "$object" in data:
        fields = {key: decode(item, arrays) for key, item in data["fields"].items()}
        return _make(find_class(data["$object"]), fields)
    return {key: decode(item, arrays) for key, item in data.items()}


def find_class(name: str) -> type:
    """The dataclass or enum called `module:qualified.name`, inside lvba only.

    Raises ArtifactError: elsewhere, gone, or neither.
    """
    module, _, path = name.partition(":")
    if module != PACKAGE and not module.startswith(PACKAGE + "."):
        raise ArtifactError(f"{name} is no class of {PACKAGE}")
    try:
        target: Any = importlib.import_module(module)
        for part in path.split("."):
            target = getattr(target, part)
    except (ImportError, AttributeError):
        raise ArtifactError(f"{name} does not exist in this version") from None
    if not (isinstance(target, type) and (dataclasses.is_dataclass(target) or issubclass(target, enum.Enum))):
        raise ArtifactError(f"{name} is no dataclass")
    return target


def _encode_array(value: np.ndarray, arrays: dict[str, np.ndarray], name: str) -> Any:
    if value.dtype.kind in "US":
        return {"$strings": value.astype(str).tolist(), "dtype": value.dtype.str}
    if value.dtype.kind not in "biufc":
        raise TypeError(f"{name}: an array of {value.dtype} cannot be stored")
    if value.nbytes <= SMALL_BYTES:
        content = base64.b64encode(np.ascontiguousarray(value).tobytes()).decode()
        return {"$bytes": content, "dtype": value.dtype.str, "shape": list(value.shape)}
    arrays[name] = value
    return {"$array": name}


def _encode_dict(value: dict[Any, Any], arrays: dict[str, np.ndarray], name: str) -> Any:
    if all(isinstance(key, str) and key and key[0] != "$" and _is_path_safe(key) for key in value):
        return {key: encode(item, arrays, f"{name}.{key}") for key, item in value.items()}
    items = enumerate(value.items())
    return {"$dict": [[encode(k, {}, name), encode(item, arrays, f"{name}.{i}")] for i, (k, item) in items]}


def _encode_object(value: Any, arrays: dict[str, np.ndarray], name: str) -> Any:
    kind = _name_of(value, name)
    fields = {
        f.name: encode(getattr(value, f.name), arrays, f"{name}.{f.name}")
        for f in dataclasses.fields(value)
        if f.init
    }
    return {"$object": kind, "fields": fields}


def _name_of(value: Any, name: str) -> str:
    """`module:qualified.name` of the value's class, which is one of lvba."""
    kind = f"{type(value).__module__}:{type(value).__qualname__}"
    if not kind.startswith((PACKAGE + ".", PACKAGE + ":")):
        raise TypeError(f"{name}: a {type(value).__qualname__} of {type(value).__module__} cannot be stored")
    return kind


def _member(kind: type, value: Any) -> Any:
    try:
        return kind(value)
    except (TypeError, ValueError) as error:
        raise ArtifactError(f"{kind.__qualname__} has no {value!r}: {error}") from None


def _make(kind: type, fields: dict[str, Any]) -> Any:
    try:
        return kind(**fields)
    except (TypeError, ValueError) as error:
        raise ArtifactError(f"{kind.__qualname__} cannot be made from what was stored: {error}") from None


def _is_path_safe(name: str) -> bool:
    return all(c.isalnum() or c in "_- " for c in name) and name.isascii()
