"""How kernels are compiled that run in parallel."""

from collections.abc import Callable
from typing import Any

from numba import njit


def parallel(kernel: Callable[..., Any]) -> Any:
    """Compiles a kernel whose loops over `prange`, and nothing else, are shared among threads.

    Numba would also make a parallel region of every `np.zeros` and every expression of arrays. Each waits for all
    threads, which takes long where others use the machine too, and these have next to nothing to do.
    """
    words_of_arrays = ("comprehension", "reduction", "inplace_binop", "setitem", "numpy", "stencil", "fusion")
    compiled: Any = njit  # its type knows no choice of what runs in parallel
    return compiled(cache=True, nogil=True, parallel=dict.fromkeys(words_of_arrays, False))(kernel)
