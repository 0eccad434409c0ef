"""Telling addresses that users gave when their jobs have ended: signed, a few times, several at once."""

import base64
import hashlib
import hmac
import http.client
import json
import logging
import threading
from datetime import UTC, datetime
from urllib.parse import SplitResult, urlsplit

from sqlalchemy import select
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from lvba.errors import InputError
from service.db.database import Database
from service.db.tables import Delivery, DeliveryStatus, Job
from service.jobs import webhook_delivery
from service.settings import Settings
from service.system.paths import new_id, now

_log = logging.getLogger(__name__)
TRIES = 5
_WAITS_S = (10.0, 60.0, 300.0, 1800.0)
_AT_ONCE, _OF_ONE_OWNER, _TO_ONE = 16, 6, 2
"""Deliveries at a time: in all, of one owner, and of these to one receiver."""
_CLAIM_S = 120.0
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


def enqueue(session: Session, job: Job) -> None:
    """Have the end of a job told, if its user wants that."""
    if not job.webhook:
        return
    name = new_id("dlv")
    time = datetime.now(UTC).isoformat(timespec="seconds")
    body = {"job": job.id, "state": job.state, "time": time, "name": job.name, "delivery": name}
    session.add(Delivery(id=name, job_id=job.id, created=now(), body=json.dumps(body), next_try=now()))


class _UnderWay:
    """Deliveries that this service is at: some of each owner, few to each receiver; slow ones leave room for others."""

    def __init__(self) -> None:
        self._taken: dict[str, tuple[str, str]] = {}

    def add(self, delivery_id: str, owner: str, receiver: str) -> None:
        """Begin one."""
        self._taken[delivery_id] = owner, receiver

    def remove(self, delivery_id: str) -> None:
        """It has ended."""
        self._taken.pop(delivery_id, None)

    def has_room(self, owner: str, receiver: str) -> bool:
        """Whether one more may begin."""
        taken = list(self._taken.values())
        mine = [each for each in taken if each[0] == owner]
        return len(taken) < _AT_ONCE and len(mine) < _OF_ONE_OWNER and mine.count((owner, receiver)) < _TO_ONE


class Messenger(threading.Thread):
    """Delivers what is due until it is stopped."""

    def __init__(self, database: Database, settings: Settings) -> None:
        super().__init__(name="webhooks", daemon=True)
        self._database, self._settings = database, settings
        self._ending = threading.Event()

    def stop(self) -> None:
        """Begin nothing more. What is under way ends with the process, and is tried again."""
        self._ending.set()

    def run(self) -> None:
        under_way = _UnderWay()
        while not self._ending.wait(1.0):
            try:
                self._begin_due(under_way)
            except SQLAlchemyError as error:
                _log.warning("webhooks: %s", str(error).splitlines()[0])
            except RuntimeError as error:  # no thread can be started
                _log.warning("webhooks: %s", error)

    def _begin_due(self, under_way: _UnderWay) -> None:
        while not self._ending.is_set() and (taken := _take_due(self._database, under_way)) is not None:
            threading.Thread(target=self._deliver, args=(*taken, under_way), daemon=True).start()

    def _deliver(self, delivery: Delivery, webhook: dict[str, str], under_way: _UnderWay) -> None:
        try:
            deliver(self._database, self._settings, delivery, webhook)
        except SQLAlchemyError as error:
            _log.warning("webhooks: %s", str(error).splitlines()[0])
        finally:
            under_way.remove(delivery.id)


def deliver_due(database: Database, settings: Settings) -> None:
    """Try every delivery whose time has come, once, one after another."""
    under_way = _UnderWay()
    while (taken := _take_due(database, under_way)) is not None:
        deliver(database, settings, *taken)
        under_way.remove(taken[0].id)


def deliver(database: Database, settings: Settings, delivery: Delivery, webhook: dict[str, str]) -> None:
    """Try one delivery, and write down what became of it."""
    delivered = False
    try:
        status = _post(delivery, webhook, settings)
        delivered = 200 <= status < 300
        message = "" if delivered else f"answered {status}"
    except InputError as error:
        message = error.problem
    except TimeoutError:
        message = "took too long"
    except (OSError, http.client.HTTPException, ValueError) as error:
        message = type(error).__name__
    _write_down(database, delivery.id, delivered, message)


def _take_due(database: Database, under_way: _UnderWay) -> tuple[Delivery, dict[str, str]] | None:
    due = (
        select(Delivery.id, Job.owner, Job.webhook)
        .join(Job, Job.id == Delivery.job_id)
        .where(Delivery.next_try.is_not(None), Delivery.next_try <= now())
        .order_by(Delivery.next_try)
    )
    with database.read() as session:  # mostly there is none
        if session.execute(due.limit(1)).first() is None:
            return None
    with database.write() as session:
        database.order_claims(session)
        for delivery_id, owner, webhook in session.execute(due):
            webhook = webhook or {"url": "", "secret": ""}
            receiver = "/".join(webhook["url"].split("/", 3)[:3])
            if under_way.has_room(owner, receiver):
                delivery = session.get_one(Delivery, delivery_id)
                delivery.next_try, delivery.tries = now() + _CLAIM_S, delivery.tries + 1
                under_way.add(delivery.id, owner, receiver)
                return delivery, webhook
        return None


def _write_down(database: Database, delivery_id: str, delivered: bool, message: str) -> None:
    with database.write() as session:
        delivery = session.get(Delivery, delivery_id)
        if delivery is None:
            return
        delivery.message = message
        if delivered:
            delivery.status, delivery.next_try = DeliveryStatus.DELIVERED, None
        elif delivery.tries >= TRIES:
            delivery.status, delivery.next_try = DeliveryStatus.GIVEN_UP, None
        else:
            delivery.status, delivery.next_try = DeliveryStatus.RETRYING, now() + _WAITS_S[delivery.tries - 1]


def signature(secret: str, name: str, timestamp: str, body: str) -> str:
    """`v1,` and the base64 of HMAC-SHA256 over `name.timestamp.body`."""
    mac = hmac.new(secret.encode(), f"{name}.{timestamp}.{body}".encode(), hashlib.sha256)
    return f"v1,{base64.b64encode(mac.digest()).decode()}"


def _post(delivery: Delivery, webhook: dict[str, str], settings: Settings) -> int:
    parts = check_url(webhook["url"], settings.webhook_allow)
    timestamp = str(int(now()))
    headers = {
        "Content-Type": "application/json",
        "User-Agent": "lvba",
        "Webhook-Id": delivery.id,
        "Webhook-Timestamp": timestamp,
        "Webhook-Signature": signature(webhook["secret"], delivery.id, timestamp, delivery.body),
    }
    trusted = f"{parts.scheme}://{parts.netloc}" in settings.webhook_allow
    return webhook_delivery.post(
        parts, delivery.body.encode(), headers, settings.webhook_timeout_s, trusted=trusted
    )
