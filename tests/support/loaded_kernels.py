"""Imported by the process that others are forked from: kernels that were compiled before are loaded once for all of them.

Not those that run in parallel: OpenMP refuses to continue in a process that was forked after it began.
"""

import contextlib
import importlib
import pkgutil

from numba.core.registry import CPUDispatcher

from lvba import kernels


def load():
    for found in pkgutil.iter_modules(kernels.__path__):
        for value in list(vars(importlib.import_module(f"{kernels.__name__}.{found.name}")).values()):
            if isinstance(value, CPUDispatcher) and not value.targetoptions.get("parallel"):
                _load(value)


def _load(dispatcher):
    # nothing is lost by what cannot be loaded: who calls it compiles it
    with contextlib.suppress(Exception):
        for signature, *_ in dispatcher._cache._cache_file._load_index():
            compiled = dispatcher._cache.load_overload(signature, dispatcher.targetctx)
            if compiled is not None and not dispatcher.overloads.get(signature):
                dispatcher.targetctx.insert_user_function(
                    compiled.entry_point, compiled.fndesc, [compiled.library]
                )
                dispatcher.add_overload(compiled)


load()
