"""What every request needs of the server, and who asks."""

import base64
import hashlib
import hmac
import json
import os
import secrets
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, cast

from fastapi import Depends, Request
from starlette.concurrency import run_in_threadpool

from lvba.errors import InputError
from lvba.io import files, no_links
from service.api.rate_limits import Rates
from service.datasets.active_uploads import ActiveUploads
from service.db import keys
from service.db.database import Database
from service.db.keys import Principal
from service.jobs.broadcast import Broadcaster
from service.jobs.results import Checker
from service.jobs.supervisor import Supervisor
from service.problems import Problem
from service.settings import Settings
from service.system.paths import Paths, now

TICKET_S = 900
_SECRET_BYTES = 32
_FAILURES_PER_S, _FAILURES_AT_ONCE = 1.0, 30


@dataclass
class Server:
    """The parts of one service."""

    database: Database
    paths: Paths
    settings: Settings
    supervisor: Supervisor
    broadcaster: Broadcaster
    secret: bytes
    """Signs tickets; derived from the one on disk."""
    results: Checker = field(default_factory=Checker)
    rates: Rates = field(default_factory=Rates)
    active_uploads: ActiveUploads = field(default_factory=ActiveUploads)


async def of(request: Request) -> Server:
    """The server that a request came to."""
    return cast(Server, request.app.state.server)


Context = Annotated[Server, Depends(of)]


def load_secret(file: Path) -> bytes:
    """The secret of this data folder, made if there is none.

    Raises InputError: what is there is too short to keep anything secret, or a link.
    """
    if not os.path.lexists(file):
        partial = file.with_name(f".{secrets.token_hex(4)}")
        with os.fdopen(os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as stream:
            stream.write(secrets.token_bytes(_SECRET_BYTES))
            stream.flush()
            os.fsync(stream.fileno())
        with suppress(FileExistsError):  # of two services that begin together, one is first
            file.hardlink_to(partial)
        partial.unlink()
        files.sync(file.parent)
    with files.as_input_error(file), os.fdopen(no_links.descriptor(file), "rb") as stream:
        secret = stream.read(1 << 16)
    if len(secret) < _SECRET_BYTES or len(set(secret)) < _SECRET_BYTES // 4:
        raise InputError(
            file, "is no secret: it is empty, short or all the same", "remove it: a new one is made at start"
        )
    return hmac.new(secret, b"lvba tickets", hashlib.sha256).digest()


async def who(request: Request, server: Context) -> Principal:
    """Whoever sent the request.

    Raises Problem: no key, or an invalid one; too many requests.
    """
    # only what may have to wait goes to another thread: going there takes as long as many a request
    return await run_in_threadpool(_known, request, server) if server.settings.asks_for_keys else keys.LOCAL


def _known(request: Request, server: Server) -> Principal:
    principal = _by_key(request, server) or _by_ticket(request, server)
    if principal is None:
        client = request.client.host if request.client else ""
        server.rates.take(f"failures {client}", _FAILURES_PER_S, _FAILURES_AT_ONCE)
        raise Problem("unauthorized", "the request has no valid key", headers={"WWW-Authenticate": "Bearer"})
    limits = server.settings.limits
    server.rates.take(principal.key_id, limits.requests_per_s, limits.requests_burst)
    return principal


def _by_key(request: Request, server: Server) -> Principal | None:
    kind, _, token = request.headers.get("authorization", "").partition(" ")
    return keys.find(server.database, token.strip()) if kind.lower() == "bearer" else None


def _by_ticket(request: Request, server: Server) -> Principal | None:
    """Whoever a ticket was given to, if it is good for this path and its key still is.

    A ticket names a key and no owner: owner, scopes and hash are those of the database.
    """
    text, _, mark = request.query_params.get("ticket", "").partition(".")
    said = _said(text)
    if said is None or request.method not in ("GET", "HEAD"):
        return None
    key, path, until = said
    known = keys.known(server.database, key)
    right = _mark(server, text, known[1] if known else "")  # compared also where there is no such key
    if (
        known is None
        or not known[0].may(keys.READ)
        or not hmac.compare_digest(mark.encode(), right.encode())
        or until < now()
    ):
        return None
    fits = request.url.path == path or (path.endswith("/") and request.url.path.startswith(path))
    return Principal(known[0].owner, frozenset([keys.READ]), key) if fits else None


def _said(text: str) -> tuple[str, str, float] | None:
    """Key, path and end of a ticket, whoever wrote it."""
    try:
        said = json.loads(base64.urlsafe_b64decode(text))
        return str(said["key"]), str(said["path"]), float(said["until"])
    except (ValueError, KeyError, TypeError, RecursionError):
        return None


def ticket(server: Server, principal: Principal, path: str) -> str:
    """Stands for the key in GET requests of a path, for a while, and for as long as the key is good."""
    known = keys.known(server.database, principal.key_id)
    said = {"key": principal.key_id, "path": path, "until": now() + TICKET_S}
    text = base64.urlsafe_b64encode(json.dumps(said).encode()).decode()
    return f"{text}.{_mark(server, text, known[1] if known else '')}"


def _mark(server: Server, text: str, key_hash: str) -> str:
    return hmac.new(server.secret, f"{key_hash} {text}".encode(), hashlib.sha256).hexdigest()


def needs(scope: str) -> Any:
    """A dependency: whoever asks, if it has this scope."""

    async def check(principal: Annotated[Principal, Depends(who)]) -> Principal:
        if not principal.may(scope):
            raise Problem("forbidden", f"the key does not have the scope {scope!r}")
        return principal

    return Depends(check)


Reader = Annotated[Principal, needs(keys.READ)]
Submitter = Annotated[Principal, needs(keys.SUBMIT)]
