"""How many threads numerical libraries use."""

import os


def limit_threads(threads: int | None) -> None:
    """BLAS gets one thread: its threads beside numba's slow both down many times. Must come before numpy is imported.

    Numba's threads sleep between two kernels: by default they spin, and take half a core from what runs meanwhile.
    """
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    if threads is not None:
        os.environ["NUMBA_NUM_THREADS"] = str(threads)
