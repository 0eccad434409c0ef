"""A worker process that outlives its schedulers: it joins the next one that answers at the address."""

import asyncio
import contextlib
import logging
import os
import signal
from collections.abc import Callable
from typing import Any

from distributed import Nanny
from distributed.comm.addressing import get_address_host
from distributed.security import Security
from distributed.utils import get_ip

from workers import limits

_log = logging.getLogger(__name__)
_PAUSE_SECONDS = 1.0


def serve(address: str, security: Security, memory_bytes: int | None, say: Callable[[str], None]) -> None:
    """Work for the scheduler at the address until SIGTERM or SIGINT.

    memory_bytes: above it the worker process is ended and begins anew; None: all that this machine or container has
    A worker that loses its scheduler ends; here a new one then waits for a scheduler to come back.
    """
    limits.configure()
    asyncio.run(_serve(address, security, memory_bytes or limits.memory_per_process(1), say))


async def _serve(address: str, security: Security, memory_bytes: int, say: Callable[[str], None]) -> None:
    stop_requested = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop_requested.set)
    stop = asyncio.create_task(stop_requested.wait())
    say(f"waiting for the scheduler at {address}")
    while not stop_requested.is_set():
        await _one_life(address, security, memory_bytes, stop, say)
        await asyncio.wait([stop], timeout=_PAUSE_SECONDS)
    # a nanny that was just starting a process would wait for it, and this process for the nanny
    os._exit(0)


async def _one_life(
    address: str,
    security: Security,
    memory_bytes: int,
    stop: "asyncio.Task[bool]",
    say: Callable[[str], None],
) -> None:
    """Until the scheduler is lost, or somebody says stop."""
    try:
        nanny = _nanny(address, security, memory_bytes)
    except OSError as error:  # a name that is not known (yet)
        _log.info("%s", error)
        return
    try:
        if not await _first(asyncio.ensure_future(nanny.start()), stop):
            return
        say(f"working for {address}, with at most {memory_bytes / 1e9:.1f} GB")
        await _first(asyncio.ensure_future(nanny.finished()), stop)
        say(f"{'stopped' if stop.done() else 'lost the scheduler'}")
    except (OSError, RuntimeError) as error:
        if not _is_about_connections(error):
            raise
        _log.info("%s", error)
    finally:
        await _end(nanny)


def _is_about_connections(error: BaseException | None) -> bool:
    """A nanny that finds no scheduler for a while says only that it failed to start, and this is its reason."""
    while error is not None and not isinstance(error, OSError):
        error = error.__cause__
    return error is not None


def _nanny(address: str, security: Security, memory_bytes: int) -> Nanny:
    return Nanny(
        address,
        nthreads=1,
        # the interface that leads to the scheduler, not every one
        host=get_ip(get_address_host(address)),
        memory_limit=memory_bytes,
        security=security,
        # it cannot be left away; there is nothing behind it
        dashboard_address="127.0.0.1:0",
        plugins=[limits.Limits()],
        silence_logs=logging.CRITICAL,
    )


async def _end(nanny: Nanny) -> None:
    if nanny.pid:
        # asked gently, it would first finish its step, which nobody waits for
        with contextlib.suppress(ProcessLookupError):
            os.kill(nanny.pid, signal.SIGKILL)
    with contextlib.suppress(OSError):
        await asyncio.wait_for(nanny.close(timeout=1), _PAUSE_SECONDS)


async def _first(work: "asyncio.Future[Any]", stop: "asyncio.Task[bool]") -> bool:
    """Whether the work ended before the stop; its error goes through."""
    both: set[asyncio.Future[Any]] = {work, stop}
    await asyncio.wait(both, return_when=asyncio.FIRST_COMPLETED)
    if not work.done():
        work.cancel()
        await asyncio.wait({work}, timeout=_PAUSE_SECONDS)
        return False
    work.result()
    return True
