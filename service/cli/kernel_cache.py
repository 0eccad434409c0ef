"""Numba's cache of compiled kernels: where it lies, which kernels it lacks, and whether `lvba warm` has filled it."""

import hashlib
import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

from numba.core.registry import CPUDispatcher, cpu_target

from lvba import kernels
from lvba.errors import InputError
from lvba.io import files
from lvba.kernels import voxel
from workers import versions

_NOTE = "lvba-warm.json"


def folder() -> Path:
    """Where compiled kernels are kept. The modules of kernels lie in one folder, and so does their code.

    Raises InputError: NUMBA_CACHE_DIR names a folder that cannot be written.
    """
    kept, wanted = place(), os.environ.get("NUMBA_CACHE_DIR")
    if wanted and not kept.absolute().is_relative_to(Path(wanted).absolute()):
        raise InputError(
            f"NUMBA_CACHE_DIR={wanted}", "cannot be written", "set it to a folder that can be written"
        )
    return kept


def place() -> Path:
    """The same, where NUMBA_CACHE_DIR names a folder that cannot be written: another then."""
    return Path(str(_first(voxel).stats.cache_path))


def missing() -> int:
    """How many kernels of the modules that are imported have no code in the cache that is as new as their source.

    Code for another processor or other types of arguments counts, too: to tell them apart means to read the cache.
    """
    modules = [module for name, module in sys.modules.items() if name.startswith(f"{kernels.__name__}.")]
    return sum(not is_compiled(kernel, module) for module in modules for kernel in kernels_of(module))


def kernels_of(module: ModuleType) -> Iterator[CPUDispatcher]:
    """The kernels that are defined in a module, but for those that are put in place where they are called."""
    for item in vars(module).values():
        if not isinstance(item, CPUDispatcher) or item.py_func.__module__ != module.__name__:
            continue
        if item.targetoptions.get("inline") != "always":
            yield item


def is_compiled(kernel: CPUDispatcher, module: ModuleType) -> bool:
    """Whether the cache holds code of a kernel of this module that is not older than its source."""
    source, function = Path(str(module.__file__)), kernel.py_func
    name = f"{source.stem}.{function.__qualname__}-{function.__code__.co_firstlineno}.*.nbi"
    indices = Path(str(kernel.stats.cache_path)).glob(name)
    return any(index.stat().st_mtime >= source.stat().st_mtime for index in indices)


def compiled(folder: Path) -> list[str]:
    """Names of the files that are kept in the folder, in order; there may be none."""
    return sorted(path.name for path in folder.glob("*.nb[ic]"))


def is_warm(folder: Path) -> bool:
    """Whether `lvba warm` of this very program, on such a processor, has filled the folder, and all is still there."""
    try:
        note = json.loads((folder / _NOTE).read_text(encoding="utf-8"))
        return bool(note["of"] == _program()) and set(note["files"]) <= set(compiled(folder))
    except (OSError, ValueError, KeyError, TypeError):
        return False


def note_warm(folder: Path) -> None:
    """Note in the folder that all is there that a run of this program needs."""
    files.write_text(folder / _NOTE, json.dumps({"of": _program(), "files": compiled(folder)}))


def _program() -> str:
    """What compiled code depends on: sources and libraries, the times by which numba keeps code, and the processor."""
    root = Path(str(kernels.__file__)).parent
    times = [(path.name, path.stat().st_mtime) for path in sorted(root.glob("*.py"))]
    processor = cpu_target.target_context.codegen().magic_tuple()
    facts = repr((versions.key_version(), times, processor, os.fspath(root)))
    return hashlib.sha256(facts.encode()).hexdigest()


def _first(module: ModuleType) -> CPUDispatcher:
    return next(kernels_of(module))
