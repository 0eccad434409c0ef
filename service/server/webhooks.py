"""Telling addresses that users gave when their jobs have ended: signed, a few times, and only where it does no harm.

An address is looked up, every answer must be public, and the connection goes to just the address that was checked: a
name that answers otherwise a moment later changes nothing. No redirects; the answer is not read beyond its status.
"""

import base64
import hashlib
import hmac
import http.client
import ipaddress
import json
import logging
import socket
import ssl
import threading
from datetime import UTC, datetime
from urllib.parse import SplitResult, urlsplit

from sqlalchemy import select
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from lvba.errors import InputError
from service.server.database import Database
from service.server.places import new_id, now
from service.server.settings import Settings
from service.server.tables import Delivery, Job

_log = logging.getLogger(__name__)
TRIES = 5
_WAITS_S = (10.0, 60.0, 300.0, 1800.0)
_TIMEOUT_S = 10.0
_CLAIM_S = 60.0
"""Seconds for which a delivery is left to the service that has begun it."""


def check_url(url: str, allow: tuple[str, ...]) -> SplitResult:
    """The parts of an address that may be told.

    allow: origins that need not be public
    Raises InputError: no https, credentials in it, or no host.
    """
    try:
        parts = urlsplit(url)
        origin, port = f"{parts.scheme}://{parts.netloc}", parts.port
    except ValueError:
        raise InputError("webhook.url", "is no URL", "give one such as https://example.org/hook") from None
    if origin in allow:
        return parts
    if parts.scheme != "https" or not parts.hostname or parts.username or parts.password or port == 0:
        raise InputError(
            "webhook.url", "is not a plain https address", "give one such as https://example.org/hook"
        )
    return parts


def public_address(host: str, port: int) -> str:
    """The address to connect to.

    Raises InputError: the name is not known, or any of its addresses is not public.
    """
    try:
        found = {info[4][0] for info in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)}
    except OSError:
        raise InputError("webhook.url", "its host is not known", "check the name") from None
    for address in found:
        plain = ipaddress.ip_address(str(address).partition("%")[0])
        mapped = getattr(plain, "ipv4_mapped", None) or plain
        if not mapped.is_global or mapped.is_multicast:
            raise InputError("webhook.url", "its host is not public", "give an address of the internet")
    return str(min(found))


def enqueue(session: Session, job: Job) -> None:
    """Have the end of a job told, if its user wants that."""
    if not job.webhook:
        return
    name = new_id("dlv")
    time = datetime.now(UTC).isoformat(timespec="seconds")
    body = {"job": job.id, "state": job.state, "time": time, "name": job.name, "delivery": name}
    session.add(Delivery(id=name, job_id=job.id, created=now(), body=json.dumps(body), next_try=now()))


class Messenger(threading.Thread):
    """Delivers what is due until it is stopped."""

    def __init__(self, database: Database, settings: Settings) -> None:
        super().__init__(name="webhooks", daemon=True)
        self._database, self._settings = database, settings
        self._ending = threading.Event()

    def stop(self) -> None:
        """End after the delivery at hand."""
        self._ending.set()

    def run(self) -> None:
        while not self._ending.wait(1.0):
            try:
                deliver_due(self._database, self._settings)
            except SQLAlchemyError as error:
                _log.warning("webhooks: %s", str(error).splitlines()[0])


def deliver_due(database: Database, settings: Settings) -> None:
    """Try every delivery whose time has come, once."""
    while (taken := _take_due(database)) is not None:
        delivery, webhook = taken
        try:
            status = _post(delivery, webhook, settings.webhook_allow)
            message = "" if 200 <= status < 300 else f"answered {status}"
        except InputError as error:
            message = error.problem
        except (OSError, http.client.HTTPException, ValueError) as error:
            message = type(error).__name__
        _write_down(database, delivery.id, message)


def _take_due(database: Database) -> tuple[Delivery, dict[str, str]] | None:
    with database.write() as session:
        database.order_claims(session)
        wanted = (
            select(Delivery)
            .where(Delivery.next_try.is_not(None), Delivery.next_try <= now())
            .order_by(Delivery.next_try)
            .limit(1)
        )
        delivery = session.scalars(wanted).one_or_none()
        if delivery is None:
            return None
        delivery.next_try, delivery.tries = now() + _CLAIM_S, delivery.tries + 1
        job = session.get_one(Job, delivery.job_id)
        return delivery, job.webhook or {"url": "", "secret": ""}


def _write_down(database: Database, delivery_id: str, message: str) -> None:
    with database.write() as session:
        delivery = session.get(Delivery, delivery_id)
        if delivery is None:
            return
        delivery.message = message
        if not message:
            delivery.status, delivery.next_try = "delivered", None
        elif delivery.tries >= TRIES:
            delivery.status, delivery.next_try = "given up", None
        else:
            delivery.status, delivery.next_try = "retrying", now() + _WAITS_S[delivery.tries - 1]


def signature(secret: str, name: str, timestamp: str, body: str) -> str:
    """`v1,` and the base64 of HMAC-SHA256 over `name.timestamp.body`."""
    mac = hmac.new(secret.encode(), f"{name}.{timestamp}.{body}".encode(), hashlib.sha256)
    return f"v1,{base64.b64encode(mac.digest()).decode()}"


def _post(delivery: Delivery, webhook: dict[str, str], allow: tuple[str, ...]) -> int:
    parts = check_url(webhook["url"], allow)
    timestamp = str(int(now()))
    headers = {
        "Content-Type": "application/json",
        "User-Agent": "lvba",
        "Webhook-Id": delivery.id,
        "Webhook-Timestamp": timestamp,
        "Webhook-Signature": signature(webhook["secret"], delivery.id, timestamp, delivery.body),
    }
    connection = _connect(parts, trusted=f"{parts.scheme}://{parts.netloc}" in allow)
    try:
        path = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
        connection.request("POST", path, delivery.body.encode(), headers)
        return connection.getresponse().status
    finally:
        connection.close()


def _connect(parts: SplitResult, *, trusted: bool) -> http.client.HTTPConnection:
    """A connection to the checked address; the name is still what TLS and the Host header say."""
    host = parts.hostname or ""
    port = parts.port or (443 if parts.scheme == "https" else 80)
    address = host if trusted else public_address(host, port)
    plain = socket.create_connection((address, port), _TIMEOUT_S)
    connection = http.client.HTTPConnection(host, port, timeout=_TIMEOUT_S)
    if parts.scheme == "https":
        connection.sock = ssl.create_default_context().wrap_socket(plain, server_hostname=host)
    else:
        connection.sock = plain
    return connection
