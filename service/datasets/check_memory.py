"""Too little memory for the check of a dataset: how it shows, and what is said. The files are not to blame for it."""

import resource
import signal
from pathlib import Path

from service.settings import Limits
from service.system import disk_space

_SIGNS = (
    "memoryerror", "cannot allocate memory", "out of memory", "unable to allocate", "insufficient memory",
    "bad_alloc", "failed to map segment", "can't start new thread", "pthread_create",
)  # fmt: skip
_TAIL = 1 << 14
"""Bytes of a log in which they are looked for."""


def address_space(limits: Limits) -> int:
    """Bytes that a check may take: what is set, or less where the service itself was given less (`ulimit -v`)."""
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    most = limits.validation_memory_bytes
    return most if hard == resource.RLIM_INFINITY else min(most, hard)


def ended(code: int, log: Path, begin: int) -> bool:
    """Whether too little memory ended a process that could not say so itself.

    A check that lives says it by type. One that died in the loader or in a library left nothing but what that wrote into
    the log, from `begin` on.
    """
    if code == -signal.SIGKILL:  # what the system does when memory runs out
        return True
    try:
        with log.open("rb") as stream:
            stream.seek(max(log.stat().st_size - _TAIL, begin))
            said_last = stream.read().decode("utf-8", "replace").lower()
            return any(sign in said_last for sign in _SIGNS)
    except OSError:
        return False


def said(limits: Limits) -> dict[str, str]:
    """The error of the dataset."""
    return {
        "code": "too-much",
        "cause": f"the check ran out of memory: it may take {disk_space.size(address_space(limits))}",
        "hint": "unless a file is far too large, this is too little: whoever runs the server can give checks more "
        "(LVBA_LIMITS_VALIDATION_MEMORY_BYTES, ulimit -v, memory of the machine); then finish the dataset again",
    }
