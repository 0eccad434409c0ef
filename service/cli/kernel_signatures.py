"""The kernels that runs call from Python, with the types of their arguments: kept in a file beside the kernels, so that
several processes can compile them before the first is called.

`make signatures` writes the file anew, where a kernel that runs call has come, gone or changed its arguments.
"""

import importlib
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numba import from_dtype
from numba.core import types
from numba.core.registry import CPUDispatcher
from numba.np.numpy_support import as_dtype

from lvba import kernels
from service.cli import kernel_cache

FILE = Path(str(kernels.__file__)).parent / "signatures.json"


class Signature(NamedTuple):
    """name: of the kernel, with its module; arguments: their types as text, a NamedTuple as {its class: its fields}"""

    name: str
    arguments: list[Any]


def read() -> list[Signature]:
    """The kernels of the file, those with the most code first."""
    return [Signature(*each) for each in json.loads(FILE.read_text(encoding="utf-8"))]


def compile_kernel(signature: Signature) -> None:
    """Compile a kernel, or load it, if the cache has its code."""
    kernel: Any = _named(signature.name)
    kernel.compile(tuple(_type(each) for each in signature.arguments))


def called() -> list[Signature]:
    """The kernels that this process has called, or compiled for others."""
    return [
        Signature(_name_of(kernel.py_func), [_text(each) for each in arguments])
        for kernel in _imported()
        for arguments in {*kernel.stats.cache_hits, *kernel.stats.cache_misses}
    ]


def _imported() -> Iterator[CPUDispatcher]:
    for name, module in sorted(sys.modules.items()):
        if name.startswith(f"{kernels.__name__}."):
            yield from kernel_cache.kernels_of(module)


def _name_of(item: Any) -> str:
    return f"{item.__module__.removeprefix(f'{kernels.__name__}.')}.{item.__name__}"


def _named(name: str) -> Any:
    """A kernel, or the class of a NamedTuple."""
    module, _, item = name.rpartition(".")
    return getattr(importlib.import_module(f"{kernels.__name__}.{module}"), item)


def _text(kind: Any) -> Any:
    if isinstance(kind, (types.NamedTuple, types.NamedUniTuple)):
        return {_name_of(kind.instance_class): [_text(each) for each in kind.types]}
    if isinstance(kind, types.Array):
        return f"{as_dtype(kind.dtype)} {kind.ndim} {kind.layout}"
    return str(as_dtype(kind))


def _type(text: Any) -> Any:
    if isinstance(text, dict):
        ((name, fields),) = text.items()
        of_fields: Any = types.BaseTuple.from_types
        return of_fields([_type(each) for each in fields], _named(name))
    dtype, *shape = text.split()
    scalar = from_dtype(np.dtype(dtype))
    return types.Array(scalar, int(shape[0]), shape[1]) if shape else scalar


def _code_size(signature: Signature) -> int:
    """Bytes of compiled code: the longer it is, the longer it takes."""
    kernel = _named(signature.name)
    places = Path(kernel.stats.cache_path).glob(f"{signature.name}-*.nbc")
    return sum(place.stat().st_size for place in places)


def _write() -> None:
    """Write the file by what runs call; where the cache holds all of it, kernels that others call are not loaded."""
    from service.cli import progress, warm_command

    if warm_command.fill(progress.Display()):
        subprocess.run([sys.executable, "-m", __spec__.name], check=True)
        return
    kept = sorted(called(), key=lambda each: (-_code_size(each), each))
    lines = ",\n".join(json.dumps(each) for each in kept)
    FILE.write_text(f"[\n{lines}\n]\n", encoding="utf-8")


if __name__ == "__main__":
    _write()
