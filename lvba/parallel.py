"""Work on many images in threads, with results in order and bounded memory."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from numba import get_num_threads, set_num_threads, threading_layer  # type: ignore[attr-defined]

Item = TypeVar("Item")
Result = TypeVar("Result")


def in_order(
    function: Callable[[Item], Result],
    items: Iterable[Item],
    threads: int | None = None,
    *,
    parallel_kernels: bool = False,
) -> Iterator[Result]:
    """Yields `function(item)` for each item, in order; as many at a time as the kernels have threads, and two ahead.

    Results cannot depend on the number of threads: each comes from its item alone.
    parallel_kernels: the function calls some, so that it runs in several threads only where these may; a kernel then has
        the one that it is called in
    """
    threads = threads or (1 if parallel_kernels and not _may_overlap() else get_num_threads())
    waiting: deque[Future[Result]] = deque()
    of_kernels = 1 if parallel_kernels and threads > 1 else get_num_threads()
    with ThreadPoolExecutor(threads, initializer=set_num_threads, initargs=(of_kernels,)) as pool:
        try:
            for item in items:
                waiting.append(pool.submit(function, item))
                if len(waiting) > threads + 1:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


def _may_overlap() -> bool:
    """Whether two threads may run parallel kernels at a time: where numba has only threads of its own, that would end the
    process."""
    try:
        return threading_layer() in ("omp", "tbb")
    except ValueError:  # none ran yet, so that it is not known
        return False
