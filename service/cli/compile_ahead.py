"""Several processes compile the kernels that a run will call, side by side, before it begins: one process, that compiles
each when it is called first, takes minutes.

A kernel that is not compiled so, whatever the reason, is compiled when it is called.
"""

import contextlib
import multiprocessing
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess

from service.cli import first_run, kernel_cache, kernel_signatures, memory_estimate
from service.cli.kernel_signatures import Signature
from service.cli.progress import Display

_FEW = 10
"""Kernels that lack code: fewer are compiled sooner than processes start."""
_MOST_PROCESSES = 8
"""Each compiles anew what numba itself has as kernels: more than so many are hardly faster."""
_PROCESS_BYTES = 1_000_000_000
_TICK_S = 0.25


def run(display: Display, threads: int | None = None) -> int:
    """Compile what the cache lacks of the kernels that runs call; how many these were.

    threads: how many processes at most; None: as the machine has cores
    """
    needed = missing()
    processes = min(
        threads or os.cpu_count() or 1, _MOST_PROCESSES, memory_estimate.machine_bytes() // _PROCESS_BYTES
    )
    if len(needed) < _FEW or processes < 2:
        return 0
    display.tell(first_run.NOTICE)
    done = 0
    with _compiling(needed, processes) as open_ends:
        while open_ends:
            ready = wait(open_ends, _TICK_S)
            for end in [each for each in open_ends if each in ready]:
                try:
                    end.recv()
                    done += 1
                except EOFError:
                    open_ends.remove(end)
            display.progress(first_run.COUNT, done, len(needed))
    return done


def missing() -> list[Signature]:
    """The kernels that runs call of which the cache has no code for this Python; code that is older than the sources is
    removed when a kernel is imported."""
    ours = f".py{sys.version_info.major}{sys.version_info.minor}."
    files = kernel_cache.compiled(kernel_cache.place())
    names = {name.rpartition("-")[0] for name in files if ours in name}
    return [each for each in kernel_signatures.read() if each.name not in names]


@contextlib.contextmanager
def _compiling(needed: Sequence[Signature], processes: int) -> Iterator[list[Connection]]:
    """Processes that compile so many kernels; from each comes something for each kernel, until it ends."""
    context = multiprocessing.get_context("spawn")
    started: list[SpawnProcess] = []
    ends: list[Connection] = []
    try:
        for number in range(processes):
            ours, theirs = context.Pipe(duplex=False)
            # the kernels with the most code come first: each process has as many of them
            process = context.Process(target=_compile, args=(needed[number::processes], theirs), daemon=True)
            process.start()
            theirs.close()
            started.append(process)
            ends.append(ours)
        yield ends
    finally:
        for process in started:
            process.kill()
            process.join()


def _compile(needed: Sequence[Signature], done: Connection) -> None:
    """In a process of its own."""
    # who interrupts the run ends this process as well
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # the long ones among the others: the first of them tell how long all will take
    for each in sorted(needed, key=lambda each: each.name):
        # what cannot be compiled here is an error where it is called, and told there
        with contextlib.suppress(Exception):
            kernel_signatures.compile_kernel(each)
        done.send(None)
