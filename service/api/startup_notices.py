"""What whoever starts a server should know about it, said at its start."""

from service.db import keys
from service.db.database import Database
from service.settings import Settings


def at_start(settings: Settings, database: Database) -> list[str]:
    """Sentences for the administrator; none where nothing is left to do."""
    return [notice for notice in (_about_tls(settings), _about_keys(settings, database)) if notice]


def _about_tls(settings: Settings) -> str:
    if settings.loopback or settings.proxies:
        return ""
    return (
        f"{settings.host} is served without TLS: keys and recordings cross the network as plain text. Listen on "
        "127.0.0.1 behind a reverse proxy that has a certificate, or name the proxy with --proxy (docs/deployment.md)."
    )


def _about_keys(settings: Settings, database: Database) -> str:
    if not settings.asks_for_keys or any(keys.known(database, key.id) for key in keys.every(database)):
        return ""
    # a database is not named: its URL may hold a password
    place = "--database URL" if settings.database else f"--data {settings.data}"
    return f"every request needs a key, and there is no valid one yet. Make one: lvba admin key create NAME {place}"
