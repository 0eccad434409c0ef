"""API keys: made, looked up, revoked. Only a hash of the secret is kept."""

import hashlib
import hmac
import secrets
from collections.abc import Collection
from dataclasses import dataclass

from sqlalchemy import select

from lvba.errors import InputError
from service.db.database import Database
from service.db.tables import Key
from service.system.paths import now

READ, SUBMIT, METRICS, ADMIN = "read", "submit", "metrics", "admin"
SCOPES = (READ, SUBMIT, METRICS, ADMIN)
_PREFIX = "lvba_"


@dataclass(frozen=True)
class Principal:
    """Who asks."""

    owner: str
    scopes: frozenset[str]
    key_id: str

    def may(self, scope: str) -> bool:
        """Whether it has this scope, or all of them."""
        return scope in self.scopes or ADMIN in self.scopes


LOCAL = Principal("local", frozenset(SCOPES), "local")
"""Whoever reaches a server that asks for no keys."""


def create(
    database: Database, owner: str, scopes: tuple[str, ...], note: str = "", days: float | None = None
) -> str:
    """A new key, to be shown once.

    days: after which it expires; None: never
    Raises InputError: a scope that does not exist, an owner without a name.
    """
    unknown = set(scopes) - set(SCOPES)
    if unknown or not scopes:
        raise InputError(f"scopes {','.join(scopes)}", "are not known", f"choose from {', '.join(SCOPES)}")
    if not owner.strip() or len(owner) > 100:
        raise InputError("owner", "is no name", "give one of at most 100 letters")
    name, secret = secrets.token_hex(6), secrets.token_urlsafe(32)
    key = Key(id=name, owner=owner, hash=_hash(secret), scopes=list(scopes), note=note, created=now())
    key.expires = None if days is None else now() + days * 86400.0
    with database.write() as session:
        session.add(key)
    return f"{_PREFIX}{name}_{secret}"


def find(database: Database, token: str) -> Principal | None:
    """Who a key belongs to; None: it is wrong, expired or revoked."""
    name, _, secret = token.removeprefix(_PREFIX).partition("_")
    if not token.startswith(_PREFIX) or not secret:
        return None
    with database.read() as session:
        key = session.get(Key, name)
    # compared also where there is no such key, so that the answer takes as long
    same = hmac.compare_digest(_hash(secret), key.hash if key else _hash(""))
    if key is None or not same or not _good(key):
        return None
    return Principal(key.owner, frozenset(key.scopes), key.id)


def known(database: Database, name: str) -> tuple[Principal, str] | None:
    """Who the key of this name belongs to, and its hash; None: there is none, or it is expired or revoked."""
    with database.read() as session:
        key = session.get(Key, name)
    return (
        None
        if key is None or not _good(key)
        else (Principal(key.owner, frozenset(key.scopes), name), key.hash)
    )


def readers(database: Database, names: Collection[str]) -> dict[str, str]:
    """The owner of each key of these that may read at this moment."""
    with database.read() as session:
        rows = session.scalars(select(Key).where(Key.id.in_(names))).all()
    return {key.id: key.owner for key in rows if _good(key) and {READ, ADMIN} & set(key.scopes)}


def _good(key: Key) -> bool:
    return key.revoked is None and (key.expires is None or key.expires > now())


def revoke(database: Database, name: str) -> None:
    """Revoke a key, with effect from now on.

    Raises InputError: there is no such key.
    """
    with database.write() as session:
        key = session.get(Key, name.removeprefix(_PREFIX).partition("_")[0])
        if key is None:
            raise InputError(f"key {name}", "there is none of this name", "see lvba admin key list")
        key.revoked = key.revoked or now()


def every(database: Database) -> list[Key]:
    """All keys, oldest first."""
    with database.read() as session:
        return list(session.scalars(select(Key).order_by(Key.created)))


def _hash(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()
