"""A service from its start to its end."""

import contextlib
import logging
import signal
import sys
from collections.abc import Iterator
from types import FrameType
from typing import Any

import uvicorn
from sqlalchemy.exc import SQLAlchemyError

from lvba.errors import InputError, LvbaError
from service.server import app, context
from service.server.broadcast import Broadcaster
from service.server.database import Database
from service.server.places import Places
from service.server.settings import Settings
from service.server.supervisor import Supervisor
from service.server.webhooks import Messenger

_log = logging.getLogger(__name__)
_OPEN_S = 5
"""Seconds that requests may take once the service is to end."""


class _Uvicorn(uvicorn.Server):
    """Ends on the first signal, after its streams; and does not send itself the signal again."""

    def __init__(self, config: uvicorn.Config, broadcaster: Broadcaster) -> None:
        super().__init__(config)
        self._broadcaster = broadcaster

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
    places = Places(settings.data.absolute())
    database = open_database(settings, places)
    supervisor = Supervisor(database, places, settings)
    broadcaster = Broadcaster(database)
    secret = context.load_secret(places.root / "secret")
    server = context.Server(database, places, settings, supervisor, broadcaster, secret)
    web = _Uvicorn(_configuration(app.create(server), settings), broadcaster)
    messenger = Messenger(database, settings) if settings.webhooks else None
    with _listening(web, settings) as sockets:
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


def open_database(settings: Settings, places: Places) -> Database:
    """The database with its tables as this version needs them.

    Raises LvbaError: it cannot be reached or written.
    """
    try:
        places.make()
    except OSError as error:
        raise InputError(
            settings.data, f"cannot be used ({error.strerror})", "give --data another folder"
        ) from None
    database = Database(settings.database_url)
    try:
        database.migrate()
    except SQLAlchemyError as error:
        said = str(error).splitlines()[0]
        raise LvbaError(f"database: cannot be used ({said}); check --database") from None
    return database


def _configuration(application: Any, settings: Settings) -> uvicorn.Config:
    return uvicorn.Config(
        application,
        host=settings.host,
        port=settings.port,
        log_config=None,
        access_log=False,
        server_header=False,
        date_header=True,
        proxy_headers=False,
        timeout_keep_alive=30,
        timeout_graceful_shutdown=_OPEN_S,
        lifespan="on",
    )


@contextlib.contextmanager
def _listening(web: uvicorn.Server, settings: Settings) -> Iterator[list[Any]]:
    try:
        socket = web.config.bind_socket()
    except SystemExit:
        raise InputError(
            f"{settings.host}:{settings.port}", "cannot be listened on", "give another --port"
        ) from None
    host, port = socket.getsockname()[:2]
    shown = f"[{host}]" if ":" in host else host
    keys = "with keys" if settings.asks_for_keys else "without keys: for this machine only"
    sys.stderr.write(f"lvba: serving http://{shown}:{port} ({keys}); data in {settings.data}\n")
    sys.stderr.flush()
    try:
        yield [socket]
    finally:
        socket.close()
