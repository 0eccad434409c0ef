"""How many threads numerical libraries use, and how many heaps these share."""

import contextlib
import ctypes
import os

_M_ARENA_MAX = -8
"""Of mallopt(3)."""
_FEWEST_HEAPS = 2


def limit_blas() -> None:
    """BLAS gets one thread, whatever the environment says. Must come before numpy is imported.

    Its threads beside numba's slow both down many times, and with several of them sums depend on how many there are:
    a recording would have other results where a shell sets `OMP_NUM_THREADS`.
    """
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"


def limit_threads(threads: int | None) -> None:
    """So many threads for numba, one for BLAS. Must come before numpy is imported.

    Numba's threads sleep between two kernels: by default they spin, and take half a core from what runs meanwhile.
    """
    limit_blas()
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    if threads is not None:
        os.environ["NUMBA_NUM_THREADS"] = str(threads)
    _limit_heaps(threads or os.cpu_count() or 1)


def _limit_heaps(count: int) -> None:
    """So many at most, here and in processes begun from here, where the C library has several (glibc).

    It would give each of eight threads a core its own, and what one has freed no other takes: on two cores that is a
    seventh of a run's memory.
    """
    if "MALLOC_ARENA_MAX" in os.environ:
        return
    count = max(count, _FEWEST_HEAPS)
    os.environ["MALLOC_ARENA_MAX"] = str(count)
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, count)
