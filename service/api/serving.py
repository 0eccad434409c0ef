"""A service from its start to its end."""

import contextlib
import logging
import signal
import sys
from collections.abc import Iterator
from functools import partial
from socket import IPPROTO_TCP, TCP_NODELAY
from types import FrameType
from typing import Any, cast

import anyio.to_thread
import uvicorn

from lvba.errors import InputError
from service.api import app, context, startup_notices
from service.api.connection import Connection
from service.api.connection_slots import ConnectionSlots
from service.datasets import recording_roots
from service.db.data_folder import open_database
from service.jobs.broadcast import Broadcaster
from service.jobs.supervisor import Supervisor
from service.jobs.webhooks import Messenger
from service.settings import Settings
from service.system import descriptors
from service.system.descriptors import DescriptorLimits
from service.system.paths import Paths

_log = logging.getLogger(__name__)
_SWITCH_S = 0.001
"""How long a thread may keep the others of this process waiting; a request goes through some of them."""
_BACKLOG = 2048
"""Connections that may wait to be taken up."""
_OPEN_S = 5
"""Seconds that requests may take once the service is to end."""


class _Uvicorn(uvicorn.Server):
    """Ends on the first signal, after its streams; and does not send itself the signal again."""

    def __init__(
        self, config: uvicorn.Config, broadcaster: Broadcaster, banner: str, notes: list[str], threads: int
    ) -> None:
        super().__init__(config)
        self._broadcaster, self._banner, self._notes = broadcaster, banner, notes
        self._threads = threads

    async def startup(self, sockets: list[Any] | None = None) -> None:
        anyio.to_thread.current_default_thread_limiter().total_tokens = self._threads
        await super().startup(sockets)
        for socket in sockets or []:
            # asyncio takes up as many at once as may wait; here more may wait than are taken up at once
            socket.listen(_BACKLOG)
        sys.stderr.writelines(f"lvba: warning: {note}\n" for note in self._notes)
        for socket in sockets or []:
            host, port = socket.getsockname()[:2]
            shown = f"[{host}]" if ":" in host else host
            sys.stderr.write(f"lvba: serving http://{shown}:{port} {self._banner}\n")
        sys.stderr.flush()

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

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        self._broadcaster.close()
        super().handle_exit(sig, frame)


def serve(settings: Settings) -> None:
    """Serve until a signal comes.

    Raises LvbaError: the data folder, the database or the address cannot be used.
    """
    recording_roots.check(settings)
    limits = descriptors.raise_limits(settings.limits.connections)
    paths = Paths(settings.data.resolve())  # below it no link is followed
    database = open_database(settings, paths)
    supervisor = Supervisor(database, paths, settings)
    broadcaster = Broadcaster(database)
    secret = context.load_secret(paths.root / "secret")
    server = context.Server(database, paths, settings, supervisor, broadcaster, secret)
    keys = "with keys" if settings.asks_for_keys else "without keys: for this machine only"
    banner = f"({keys}); data in {settings.data}"
    notes = startup_notices.at_start(settings, database)
    served = configuration(app.create(server), settings, limits)
    web = _Uvicorn(served, broadcaster, banner, notes, limits.threads)
    messenger = Messenger(database, settings) if settings.webhooks else None
    sys.setswitchinterval(_SWITCH_S)
    with listening(web, settings) as sockets:
        supervisor.start()
        if messenger is not None:
            messenger.start()
        try:
            web.run(sockets=sockets)
        finally:
            supervisor.stop()
            if messenger is not None:
                messenger.stop()
            database.close()


def configuration(application: Any, settings: Settings, limits: DescriptorLimits) -> uvicorn.Config:
    """How an application is served."""
    slots = ConnectionSlots(limits.connections, settings.limits.connections_of_one, settings.proxies)
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
