"""What every request needs of the server, and who asks."""

import base64
import hashlib
import hmac
import json
import secrets
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, cast

from fastapi import Depends, Request
from starlette.concurrency import run_in_threadpool

from service.server import keys
from service.server.broadcast import Broadcaster
from service.server.database import Database
from service.server.keys import Principal
from service.server.places import Places, now
from service.server.problems import Problem
from service.server.rates import Rates
from service.server.settings import Settings
from service.server.supervisor import Supervisor

TICKET_S = 900
_FAILURES_PER_S, _FAILURES_AT_ONCE = 1.0, 30


@dataclass
class Server:
    """The parts of one service."""

    database: Database
    places: Places
    settings: Settings
    supervisor: Supervisor
    broadcaster: Broadcaster
    secret: bytes
    """Signs tickets."""
    rates: Rates = field(default_factory=Rates)


async def of(request: Request) -> Server:
    """The server that a request came to."""
    return cast(Server, request.app.state.server)


Context = Annotated[Server, Depends(of)]


def load_secret(file: Path) -> bytes:
    """The secret of this data folder, made if there is none."""
    if not file.exists():
        partial = file.with_name(f".{secrets.token_hex(4)}")
        partial.touch(mode=0o600)
        partial.write_bytes(secrets.token_bytes(32))
        with suppress(FileExistsError):  # of two services that begin together, one is first
            file.hardlink_to(partial)
        partial.unlink()
    return file.read_bytes()


async def who(request: Request, server: Context) -> Principal:
    """Whoever sent the request.

    Raises Problem: no key, or one that is worth nothing; too many requests.
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
    """Whoever a ticket was given to, if it is good for this path."""
    ticket = request.query_params.get("ticket", "")
    text, _, mark = ticket.partition(".")
    if request.method not in ("GET", "HEAD") or not hmac.compare_digest(
        mark.encode(), _mark(server, text).encode()
    ):
        return None
    said = json.loads(base64.urlsafe_b64decode(text))
    path = request.url.path
    fits = path == said["path"] or (said["path"].endswith("/") and path.startswith(said["path"]))
    if not fits or said["until"] < now() or not keys.is_good(server.database, said["key"]):
        return None
    return Principal(said["owner"], frozenset([keys.READ]), said["key"])


def ticket(server: Server, principal: Principal, path: str) -> str:
    """Stands for the key in GET requests of a path, for a while."""
    said = {"owner": principal.owner, "key": principal.key_id, "path": path, "until": now() + TICKET_S}
    text = base64.urlsafe_b64encode(json.dumps(said).encode()).decode()
    return f"{text}.{_mark(server, text)}"


def _mark(server: Server, text: str) -> str:
    return hmac.new(server.secret, text.encode(), hashlib.sha256).hexdigest()


def needs(scope: str) -> Any:
    """A dependency: whoever asks, if it has this scope."""

    async def check(principal: Annotated[Principal, Depends(who)]) -> Principal:
        if not principal.may(scope):
            raise Problem("forbidden", f"the key has not the scope {scope!r}")
        return principal

    return Depends(check)


Reader = Annotated[Principal, needs(keys.READ)]
Submitter = Annotated[Principal, needs(keys.SUBMIT)]
