"""An application over HTTP, from the first connection to the last."""

import contextlib
import signal
from collections.abc import Iterator
from functools import partial
from socket import IPPROTO_TCP, TCP_NODELAY
from typing import Any, cast

import uvicorn

from lvba.errors import InputError
from service.api.connection import Connection
from service.api.connection_slots import ConnectionSlots
from service.settings import Settings
from service.system.descriptors import DescriptorLimits

_OPEN_S = 5
"""Seconds that requests may take once the server is to end."""


class WebServer(uvicorn.Server):
    """Ends on the first signal, and does not send itself the signal again. Nobody is let in any more from then on."""

    def __init__(self, application: Any, settings: Settings, limits: DescriptorLimits) -> None:
        """limits: connections that may be open"""
        self._slots = ConnectionSlots(
            limits.connections, settings.limits.connections_of_one, settings.proxies
        )
        super().__init__(_configuration(application, settings, limits, self._slots))

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        before = {
            number: signal.signal(number, self.handle_exit) for number in (signal.SIGINT, signal.SIGTERM)
        }
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    async def shutdown(self, sockets: list[Any] | None = None) -> None:
        self._slots.close()
        await super().shutdown(sockets)


def _configuration(
    application: Any, settings: Settings, limits: DescriptorLimits, slots: ConnectionSlots
) -> uvicorn.Config:
    """How an application is served."""
    return uvicorn.Config(
        application,
        http=cast(Any, partial(Connection, slots=slots, limits=settings.limits)),
        ws="none",
        backlog=limits.accepts,
        host=settings.host,
        port=settings.port,
        log_config=None,
        access_log=False,
        server_header=False,
        date_header=True,
        # nobody else is believed, not even on this machine: whoever could name any address could guess keys for ever
        proxy_headers=bool(settings.proxies),
        forwarded_allow_ips=list(settings.proxies),
        timeout_keep_alive=30,
        timeout_graceful_shutdown=_OPEN_S,
        lifespan="on",
    )


@contextlib.contextmanager
def listening(web: uvicorn.Server, settings: Settings) -> Iterator[list[Any]]:
    """The sockets to serve on.

    Raises InputError: the address is taken, or not this machine's.
    """
    try:
        socket = web.config.bind_socket()
    except SystemExit:
        raise InputError(
            f"{settings.host}:{settings.port}", "cannot be listened on", "give another --port"
        ) from None
    # what it accepts inherits this; asyncio does it only for sockets that were made in another way. Else every answer
    # of two pieces waits for the client's acknowledgment of the first, 40 ms on most systems
    socket.setsockopt(IPPROTO_TCP, TCP_NODELAY, 1)
    try:
        yield [socket]
    finally:
        socket.close()
