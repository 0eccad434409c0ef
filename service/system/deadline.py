"""A process that works for a service stops when the lease of the service has expired.

The service holds a pipe to stdin of the process. After every renewal of its lease it writes for how many seconds the
lease still holds, which extends the deadline. The process ends at once when the deadline has passed (the service is
frozen, or its database is away) or when the pipe is closed (the service is dead). What is finished is on disk, and
another service may continue with it.
"""

import ctypes
import os
import signal
import sys
import threading
import time

EXIT_LEASE_EXPIRED = 70
"""Exit code: the service did not extend the deadline."""
_DIE_WITH_PARENT = 1
"""PR_SET_PDEATHSIG of Linux."""
_NICE = 5
"""Who computes for an hour can wait a moment for who answers somebody; not for longer: others use the machine too."""


class _Pipe:
    def __init__(self) -> None:
        self.deadline = float("inf")
        self.closed = threading.Event()

    def listen(self) -> None:
        # not sys.stdin: a thread that waits for its lock would block the end of the process
        with os.fdopen(os.dup(0), "rb", buffering=0) as pipe:
            waiting = b""
            while data := pipe.read(256):
                *words, waiting = (waiting + data).split(b"\n")
                for word in words:
                    self.deadline = time.monotonic() + float(word)
        self.closed.set()

    def watch(self) -> None:
        while not self.closed.wait(0.25):
            if time.monotonic() > self.deadline:
                break
        os._exit(EXIT_LEASE_EXPIRED)


def watch() -> None:
    """End this process when its deadline has passed or its service is gone; leave processor time to the service first."""
    os.nice(_NICE)
    if sys.platform == "linux":
        # sooner than the threads below, which wait their turn while compiled code holds the interpreter
        ctypes.CDLL(None).prctl(_DIE_WITH_PARENT, signal.SIGKILL)
    pipe = _Pipe()
    for target in (pipe.listen, pipe.watch):
        threading.Thread(target=target, daemon=True).start()
