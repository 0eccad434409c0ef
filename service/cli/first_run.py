"""The first run on a machine compiles the numerical kernels, which takes minutes: whoever waits is told so."""

from importlib import import_module
from pathlib import Path
from types import ModuleType

from numba.core.registry import CPUDispatcher

from service.cli.progress import Display

_LIDAR, _VISUAL = (
    ("voxel", "lidar", "map_entropy"),
    ("patches", "photometric", "visibility", "zbuffer", "colorize"),
)
"""Modules of `lvba.kernels` that every run needs, and every run with images."""
_NOTICE = (
    "the first run on this machine compiles the numerical kernels: 1 to 3 minutes more, once. "
    "The count may stand still meanwhile."
)


def announce(display: Display, *, images: bool) -> None:
    """Say that kernels are to be compiled, where the cache of compiled code does not have them.

    images: whether the run will need those that work on images
    """
    names = _LIDAR + _VISUAL if images else _LIDAR
    if not all(is_compiled(import_module(f"lvba.kernels.{name}")) for name in names):
        display.tell(_NOTICE)


def is_compiled(module: ModuleType) -> bool:
    """Whether numba's cache holds code of this module that is not older than its source.

    Code that was compiled for another processor counts, too: to tell them apart means to read the cache.
    """
    dispatcher = next(item for item in vars(module).values() if isinstance(item, CPUDispatcher))
    source = Path(str(module.__file__))
    indices = Path(str(dispatcher.stats.cache_path)).glob(f"{source.stem}.*.nbi")
    return any(index.stat().st_mtime >= source.stat().st_mtime for index in indices)
