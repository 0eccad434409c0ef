"""A service from its start to its end."""

import sys
from types import FrameType
from typing import Any

import anyio.to_thread

from service.api import app, context, startup_notices
from service.api.web_server import WebServer, listening
from service.datasets import recording_roots
from service.db.data_folder import open_database
from service.jobs.broadcast import Broadcaster
from service.jobs.supervisor import Supervisor
from service.jobs.webhooks import Messenger
from service.settings import Settings
from service.system import descriptors
from service.system.descriptors import DescriptorLimits
from service.system.paths import Paths

_SWITCH_S = 0.001
"""How long a thread may keep the others of this process waiting; a request goes through some of them."""
_BACKLOG = 2048
"""Connections that may wait to be taken up."""


class _Service(WebServer):
    """Says where it listens and what is to be known, and ends its streams before all else."""

    def __init__(
        self, server: context.Server, limits: DescriptorLimits, banner: str, notes: list[str]
    ) -> None:
        super().__init__(app.create(server), server.settings, limits)
        self._broadcaster, self._banner, self._notes = server.broadcaster, banner, notes
        self._threads = limits.threads

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
    web = _Service(server, limits, banner, notes)
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
