"""The two decorators of kernels, `kernel` and `parallel_kernel`, and why each option of the compiler is as it is.

cache: compiled code is kept beside the source, so that a machine compiles once. Numba compiles a kernel anew when its own
    file is newer than the code, not when a kernel of another file that it calls is: after a change there, remove
    `lvba/kernels/__pycache__`
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

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar, overload

from numba import njit

P = ParamSpec("P")
R = TypeVar("R")

_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}
_PARALLEL = dict.fromkeys(
    ("comprehension", "reduction", "inplace_binop", "setitem", "numpy", "stencil", "fusion"), False
)


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
    compiler: Any = njit(**options)
    return compiler if function is None else compiler(function)


def parallel_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compiles a kernel whose loops over `prange` are shared among threads; no two write to one output.

    A NamedTuple that such a loop reads must be an argument of the kernel, or made inside the loop.
    """
    compiler: Any = njit  # its type knows no choice of what runs in parallel
    compiled: Callable[P, R] = compiler(**_OPTIONS, parallel=_PARALLEL)(function)
    return compiled
