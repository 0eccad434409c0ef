"""The two decorators of kernels, `kernel` and `parallel_kernel`, and why each option of the compiler is as it is.

cache: compiled code is kept beside the source, so that a machine compiles once. Numba compiles a kernel anew when its own
    file has changed, not when that of a kernel that it calls has: code that is older than any source beside its own is
    forgotten first
nogil: other threads run meanwhile; kernels touch no Python object
error_model "numpy": a division by zero gives inf or NaN as in numpy. Checks for zero in loops keep the compiler from
    vectorizing them, and an exception would leave a parallel loop half done
boundscheck: off, numba's default; callers hand over arrays whose indices are right, and tests compare with plain twins
fastmath: off, because it changes bytes. A kernel may name the rules that it can do without, with its reason beside it
inline: for a few lines of innermost loops that take arrays: numba puts them in place before it compiles. Left to LLVM,
    finding planes took 1.4 times as long
parallel: loops over `prange`, and nothing else, are shared among threads. Numba would also make a parallel region of
    every `np.zeros` and every expression of arrays. Each waits for all threads, which takes long where others use the
    machine too, and these have next to nothing to do
"""

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, overload

from numba import njit

P = ParamSpec("P")
R = TypeVar("R")

_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}
_PARALLEL = dict.fromkeys(
    ("comprehension", "reduction", "inplace_binop", "setitem", "numpy", "stencil", "fusion"), False
)


_looked_into: set[str] = set()
"""Folders of compiled code, of which none is older than the sources."""


def _forget_older(compiled: Any) -> None:
    """Removes the indices of compiled code that is older than a source beside the one of this kernel."""
    kept = compiled.stats.cache_path
    if kept in _looked_into:
        return
    _looked_into.add(kept)
    sources = Path(compiled.py_func.__code__.co_filename).parent.glob("*.py")
    # another process may remove them, too; a folder that cannot be written holds what was installed with its sources
    with contextlib.suppress(OSError):
        newest = max(source.stat().st_mtime for source in sources)
        for index in Path(kept).glob("*.nbi"):
            if index.stat().st_mtime < newest:
                index.unlink(missing_ok=True)


@overload
def kernel(function: Callable[P, R]) -> Callable[P, R]: ...
@overload
def kernel(
    *, fastmath: set[str] | None = None, inline: bool = False
) -> Callable[[Callable[P, R]], Callable[P, R]]: ...
def kernel(
    function: Callable[..., Any] | None = None, *, fastmath: set[str] | None = None, inline: bool = False
) -> Any:
    """Compiles a kernel that runs in the thread that calls it.

    fastmath: names of LLVM's fast-math flags that hold in this kernel; inline: as above
    """
    options = {**_OPTIONS, "fastmath": fastmath or False, "inline": "always" if inline else "never"}

    def compiled(function: Callable[..., Any]) -> Any:
        return _cached(njit(**options), function)

    return compiled if function is None else compiled(function)


def parallel_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compiles a kernel whose loops over `prange` are shared among threads; no two write to one output.

    A NamedTuple that such a loop reads must be an argument of the kernel, or made inside the loop.
    """
    compiler: Any = njit  # its type knows no choice of what runs in parallel
    compiled: Callable[P, R] = _cached(compiler(**_OPTIONS, parallel=_PARALLEL), function)
    return compiled


def _cached(compiler: Any, function: Callable[..., Any]) -> Any:
    compiled = compiler(function)
    _forget_older(compiled)
    return compiled
