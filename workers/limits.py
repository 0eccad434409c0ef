"""What a worker process may use: one step at a time, its share of the threads, its share of the memory."""

import contextlib
import logging
import signal
from typing import Any

import dask
from distributed import WorkerPlugin
from distributed.system import MEMORY_LIMIT

_CONFIG: dict[str, Any] = {
    # what is kept between steps is a few hundred bytes: there is nothing to spill, and a process that holds memory
    # after a large step must keep taking tasks; only the hard limit counts
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": 0.95,
    # giving memory back after every large array costs more time than it takes to compute some of them
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": None,
    # compiled code may hold the interpreter for minutes
    "distributed.scheduler.worker-ttl": "30 minutes",
    "distributed.scheduler.allowed-failures": 3,
    # on a busy machine a worker takes longer to begin anew than the 15 s after which its place would be given up for good
    "distributed.deploy.lost-worker-timeout": "1 hour",
    # samples the stack of the step a hundred times a second, for a dashboard that is not shown
    "distributed.worker.profile.enabled": False,
    # pages about what runs, for whoever reaches them, without any certificate
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
    "distributed.admin.tick.limit": "10 minutes",
    "distributed.logging.distributed": "critical",
}


def configure() -> None:
    """Set what the processes started from here, and this one, hold themselves to."""
    dask.config.set(_CONFIG)
    quiet()


def quiet() -> None:
    """Dask's own messages are not for people who run a recording; what matters is told by the driver."""
    for name in list(logging.root.manager.loggerDict):
        if name.partition(".")[0] in ("distributed", "tornado"):
            logging.getLogger(name).setLevel(logging.CRITICAL)


def memory_per_process(processes: int) -> int:
    """Bytes for each of so many worker processes on this machine (or within this container's limit)."""
    return int(MEMORY_LIMIT / processes)


class Limits(WorkerPlugin):
    """Threads of the libraries in a worker process: numba's limit (NUMBA_NUM_THREADS) for all."""

    name = "lvba-limits"
    idempotent = True

    def setup(self, worker: Any) -> None:
        """Called in the worker process when it joins."""
        import cv2
        import numba

        cv2.setNumThreads(numba.get_num_threads())
        quiet()
        # Ctrl-C reaches every process of a terminal: the driver alone decides what it means
        with contextlib.suppress(ValueError):
            signal.signal(signal.SIGINT, signal.SIG_IGN)
