"""The end of a child's lifeline: a process that works for a service, and stops when nobody answers for it any more.

The service holds the other end, a pipe to stdin, and writes after every renewal of its lease for how many seconds
the lease still holds. When these have passed (the service is frozen, or its database is away) or the pipe is closed
(it is dead), the process ends at once: what is finished is on disk, and another service may go on with it.
"""

import ctypes
import fcntl
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

STRANDED, BUSY = 70, 75
"""Exit codes: nobody answers for the process any more; the folder is still held by another one."""
_DIE_WITH_PARENT = 1
"""PR_SET_PDEATHSIG of Linux."""
_NICE = 5
"""Who computes for an hour can wait a moment for who answers somebody; not for longer: others use the machine too."""
_LOCK_PATIENCE = 5.0
"""Seconds that the process before may take to let go."""


class _Line:
    def __init__(self) -> None:
        self.deadline = float("inf")
        self.torn = threading.Event()

    def listen(self) -> None:
        # not sys.stdin: a thread that waits for its lock would block the end of the process
        with os.fdopen(os.dup(0), "rb", buffering=0) as pipe:
            waiting = b""
            while data := pipe.read(256):
                *words, waiting = (waiting + data).split(b"\n")
                for word in words:
                    self.deadline = time.monotonic() + float(word)
        self.torn.set()

    def watch(self) -> None:
        while not self.torn.wait(0.25):
            if time.monotonic() > self.deadline:
                break
        os._exit(STRANDED)


def hold() -> None:
    """From now on this process lives only as long as its service does, and lets that go first."""
    os.nice(_NICE)
    if sys.platform == "linux":
        # sooner than the threads below, which wait their turn while compiled code holds the interpreter
        ctypes.CDLL(None).prctl(_DIE_WITH_PARENT, signal.SIGKILL)
    line = _Line()
    for target in (line.listen, line.watch):
        threading.Thread(target=target, daemon=True).start()


@contextmanager
def alone(lock: Path, patience: float = _LOCK_PATIENCE) -> Iterator[None]:
    """Hold a lock file, which is let go by the system however the process ends.

    patience: seconds that another process may take to let go
    Raises BlockingIOError: another process holds it, and keeps it.
    """
    deadline = time.monotonic() + patience
    with lock.open("a") as handle:
        while True:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.05)
        yield
