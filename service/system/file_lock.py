"""A lock on a file: one process at a time works in a folder."""

import fcntl
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

EXIT_LOCKED = 75
"""Exit code: another process holds the folder."""
_LOCK_PATIENCE = 5.0
"""Seconds that the process before may take to let go."""


@contextmanager
def exclusive(lock: Path, patience: float = _LOCK_PATIENCE) -> Iterator[None]:
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
