"""File descriptors: how many this process has, for what, and what is kept back so that work can always begin."""

import errno
import os
import resource
from contextlib import suppress
from dataclasses import dataclass

from lvba.errors import InputError

LEAST = 64
"""Fewer do not do for the service itself."""
_MOST = 1 << 16
_KEPT_LEAST, _KEPT_MOST = 40, 1024
"""Kept back for the database, files at hand and the processes of jobs."""
_THREADS = 40
_LACKS = {
    getattr(errno, name) for name in ("EMFILE", "ENFILE", "ENOMEM", "EAGAIN", "ENOSPC", "EDQUOT", "ENOBUFS")
}
_FOR_A_PROCESS = 12
"""To start a process and to follow it."""


@dataclass(frozen=True)
class DescriptorLimits:
    """What each may take, so that together they never take all."""

    connections: int
    """Each with a file at most, besides itself."""
    threads: int
    """That answer requests; each may hold a connection to the database, which is several files."""
    accepts: int
    """Connections that are taken up at once, before anybody counts them."""


def raise_limits(connections: int) -> DescriptorLimits:
    """Raise the number of this process to what the system allows, and share it out.

    connections: as many as are wanted
    Raises InputError: there are too few to serve with.
    """
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    count = _MOST if most == resource.RLIM_INFINITY else min(most, _MOST)
    with suppress(OSError, ValueError):  # some systems have a limit below the one that they tell
        resource.setrlimit(resource.RLIMIT_NOFILE, (max(count, _soft()), most))
    return _of(_soft(), connections)


def _soft() -> int:
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return _MOST if soft == resource.RLIM_INFINITY else soft


def _of(count: int, connections: int) -> DescriptorLimits:
    if count < LEAST:
        raise InputError(
            f"ulimit -n {count}", "is too few open files for a service", f"allow {LEAST} or more"
        )
    kept = min(max(_KEPT_LEAST, count // 4), _KEPT_MOST)
    return DescriptorLimits(
        connections=min(connections, (count - kept) // 2),
        threads=min(_THREADS, kept // 8),
        accepts=min(100, kept // 4),
    )


def lacking() -> str | None:
    """What this process lacks to start another one, in words; None: nothing."""
    opened: list[int] = []
    try:
        for _ in range(_FOR_A_PROCESS):
            opened.append(os.open(os.devnull, os.O_RDONLY))  # noqa: PERF401  # what is open must be known if one fails
    except OSError as error:
        return f"no more files can be opened ({os.strerror(error.errno or 0)})"
    finally:
        for each in opened:
            os.close(each)
    return None


def is_lack(error: BaseException) -> bool:
    """Whether something failed for want of files, processes, memory or room, which is not its own fault."""
    return isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno in _LACKS)
