"""Imported by the process that others are forked from: kernels that were compiled before are loaded once for all of them.

Those that run in parallel need a library of threads. Of OpenMP's, a process that was forked after it began refuses to
continue: it begins in those that are forked.
"""

import contextlib
import ctypes
import importlib
import os
import pkgutil

from numba.core.registry import CPUDispatcher
from numba.np.ufunc import omppool, parallel

from lvba import kernels
from service.cli import kernel_signatures

_BEGIN = ctypes.CFUNCTYPE(None, ctypes.c_int)
_begin = _BEGIN(omppool.launch_threads)
_later = _BEGIN(lambda threads: None)


def load():
    """Those that Python calls: one that only kernels call has been compiled into each of these, in another way than by
    itself, and where it is loaded first, they call it instead, with other roundings."""
    called = {signature.name for signature in kernel_signatures.read()}
    omppool.launch_threads = ctypes.cast(_later, ctypes.c_void_p).value
    for found in pkgutil.iter_modules(kernels.__path__):
        for value in list(vars(importlib.import_module(f"{kernels.__name__}.{found.name}")).values()):
            if isinstance(value, CPUDispatcher) and f"{found.name}.{value.__name__}" in called:
                _load(value)
    os.register_at_fork(after_in_child=lambda: _begin(parallel.NUM_THREADS))


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
