"""Events as they happen, for any number of listeners: one reader of the database, whoever wrote it.

The reader keeps the newest events in memory, as they are sent. A listener is a place in them: it is woken when there
may be something for it, and takes what comes after its place. So a slow one holds up nobody and takes no memory.
"""

import asyncio
import json
import logging
import time
from bisect import bisect_right
from collections.abc import AsyncIterator, Callable, Iterable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, NamedTuple, TypeVar

import anyio.to_thread
from sqlalchemy.exc import SQLAlchemyError

from service.db import journal, keys
from service.db.database import Database
from service.db.tables import Event

_log = logging.getLogger(__name__)
_LOOK_S = 0.25
_COMMENT_S = 15.0
_KEYS_S = 1.0
"""Seconds between looks at whether those who listen still may."""
_PAGE = 500
"""Events read, or sent, at a time."""
_KEPT = 20_000
"""Events in memory; some 300 bytes each."""
_PAGES = 32
"""Pages of older events in memory: many who listen from the beginning ask for the same ones."""
_WOKEN = 20
"""Listeners woken at a time; others' requests get their turn between."""
_TIME_FRACTION = 0.3
"""Part of the time that waking may take where there are many listeners."""
_THREADS = 3
"""Of those that requests share."""
T = TypeVar("T")


class _Sent(NamedTuple):
    """An event as it is sent, made once for all who hear it."""

    id: int
    kind: str
    job_id: str
    owner: str
    data: bytes


@dataclass(eq=False)
class _Listener:
    job_id: str | None
    owner: str
    key_id: str | None = None
    """Of whoever listens; None: no key is asked for."""
    ended: bool = False
    """The key was revoked or has expired."""
    cursor: int = 0
    """Up to which it has heard everything."""
    wake: asyncio.Event = field(default_factory=asyncio.Event)
    heard: float = field(default_factory=time.monotonic)

    def wants(self, event: _Sent) -> bool:
        return self.job_id in (None, event.job_id) and self.owner == event.owner


class Broadcaster:
    """Reads new events a few times a second while somebody listens."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._listeners: set[_Listener] = set()
        self._recent: list[_Sent] = []
        """Every event after `_floor` and up to `_cursor`, but for progress of jobs that have ended."""
        self._floor = 0
        self._cursor: int | None = None
        self._pages: dict[tuple[int, str], asyncio.Task[tuple[list[_Sent], int]]] = {}
        self._limiter = anyio.CapacityLimiter(_THREADS)
        self._closed = False
        self._keys_due = 0.0

    @property
    def listeners(self) -> int:
        """How many there are."""
        return len(self._listeners)

    async def run(self) -> None:
        """Until it is closed."""
        while not self._closed:
            began = time.monotonic()
            try:
                if began > self._keys_due:
                    await self._check_keys()
                    self._keys_due = time.monotonic() + _KEYS_S
                await self._look()
            except SQLAlchemyError as error:
                _log.warning("events cannot be read: %s", str(error).splitlines()[0])
            except Exception:
                _log.exception("events cannot be told")
            await asyncio.sleep(max(_LOOK_S, (time.monotonic() - began) * (1 / _TIME_FRACTION - 1)))

    def close(self) -> None:
        """End all streams."""
        self._closed = True
        for listener in self._listeners:
            listener.wake.set()

    async def ask(self, question: Callable[..., T], *words: Any) -> T:
        """The answer to a question to the database. Few are asked at a time, however many listeners come at once."""
        return await anyio.to_thread.run_sync(lambda: question(*words), limiter=self._limiter)

    async def _check_keys(self) -> None:
        """End the streams of keys that were revoked, have expired, or may not read any more."""
        # who begins to listen while the database answers was not asked about
        asked = {listener: listener.key_id for listener in self._listeners if listener.key_id is not None}
        if not asked:
            return
        readers = await self.ask(keys.readers, self._database, set(asked.values()))
        for listener, key_id in asked.items():
            if readers.get(key_id) != listener.owner:
                listener.ended = True
                listener.wake.set()

    async def _look(self) -> None:
        if not self._listeners:
            self._cursor, self._recent = None, []
            self._pages.clear()
        if self._cursor is None:
            return
        fresh = await self.ask(self._read, self._cursor, None, None, None)
        self._keep(fresh)
        jobs, owners = {event.job_id for event in fresh}, {event.owner for event in fresh}
        still = time.monotonic() - _COMMENT_S
        await self._wake(
            listener
            for listener in list(self._listeners)
            if listener.heard < still
            or (listener.owner in owners and listener.job_id is None)
            or listener.job_id in jobs
        )

    def _keep(self, fresh: list[_Sent]) -> None:
        self._recent += fresh
        self._cursor = fresh[-1].id if fresh else self._cursor
        ends = {event.job_id: event.id for event in fresh if event.kind == journal.END}
        if ends:
            self._recent = [
                event
                for event in self._recent
                if event.kind not in journal.PASSING or event.id > ends.get(event.job_id, 0)
            ]
        if len(self._recent) > _KEPT:
            self._floor = self._recent[_KEPT // 2 - 1].id
            self._recent = self._recent[_KEPT // 2 :]

    async def _wake(self, listeners: Iterable[_Listener]) -> None:
        for number, listener in enumerate(listeners, 1):
            listener.wake.set()
            if number % _WOKEN == 0:
                await asyncio.sleep(0)

    async def stream(
        self, after: int | None, job_id: str | None, owner: str, key_id: str | None = None
    ) -> AsyncIterator[bytes]:
        """Events after a cursor as server-sent events, then those that come; None: from now on.

        Of one job it ends with the job, when there is nothing after that.
        key_id: the stream ends when this key may not read what is the owner's any more
        """
        listener = _Listener(job_id, owner, key_id)
        self._listeners.add(listener)
        try:
            now = await self._begin()
            listener.cursor = now if after is None else after
            yield b": lvba\n\n"
            over = False
            if job_id is not None:
                # as the database has it at this moment: a job that was begun again just now is not over
                while page := await self.ask(self._read, listener.cursor, job_id, owner, None):
                    listener.cursor, over = page[-1].id, page[-1].kind == journal.END
                    yield _joined(page)
            while not over and not listener.ended:
                listener.wake.clear()
                if self._closed:  # asked after clearing: a signal closes at any moment, and wakes only once
                    break
                async for heard in self._new(listener):
                    if listener.ended:
                        break
                    over = job_id is not None and heard[-1].kind == journal.END
                    yield _joined(heard)
                if not over and not listener.ended:
                    await listener.wake.wait()
                if listener.heard < time.monotonic() - _COMMENT_S:
                    listener.heard = time.monotonic()
                    yield b": \n\n"
        finally:
            self._listeners.discard(listener)

    async def _begin(self) -> int:
        """The newest event that is known; of the first listener, from where on events are kept."""
        if self._cursor is None:
            latest = await self.ask(self._latest)
            if self._cursor is None:  # nobody was faster
                self._cursor = self._floor = latest
        return self._cursor

    async def _new(self, listener: _Listener) -> AsyncIterator[list[_Sent]]:
        """What a listener has not heard yet, page by page."""
        while True:
            if listener.cursor < self._floor:
                heard, listener.cursor = await self._older(listener)
            else:
                begin = bisect_right(self._recent, listener.cursor, key=lambda event: event.id)
                page = self._recent[begin : begin + _PAGE]
                if not page:
                    return
                heard, listener.cursor = [event for event in page if listener.wants(event)], page[-1].id
            if heard:
                listener.heard = time.monotonic()
                yield heard
            await asyncio.sleep(0)

    async def _older(self, listener: _Listener) -> tuple[list[_Sent], int]:
        """A page of events that are not in memory any more, and up to where it goes."""
        if listener.job_id is not None:
            return await self.ask(self._page, listener.cursor, listener.job_id, listener.owner, self._floor)
        key = listener.cursor, listener.owner
        if key not in self._pages:
            if len(self._pages) >= _PAGES:
                self._pages.pop(next(iter(self._pages)))
            reading = self.ask(self._page, listener.cursor, None, listener.owner, self._floor)
            self._pages[key] = asyncio.create_task(reading)
        try:
            return await asyncio.shield(self._pages[key])
        except SQLAlchemyError:
            self._pages.pop(key, None)
            raise

    def _page(self, cursor: int, job_id: str | None, owner: str | None, upto: int) -> tuple[list[_Sent], int]:
        events = self._read(cursor, job_id, owner, upto)
        return events, events[-1].id if len(events) == _PAGE else upto

    def _read(self, cursor: int, job_id: str | None, owner: str | None, upto: int | None) -> list[_Sent]:
        with self._database.read() as session:
            events = journal.after(session, cursor, job_id=job_id, owner=owner, upto=upto, limit=_PAGE)
            return [_Sent(each.id, each.kind, each.job_id, each.owner, encoded(each)) for each in events]

    def _latest(self) -> int:
        with self._database.read() as session:
            return journal.latest(session)


def _joined(events: list[_Sent]) -> bytes:
    return b"".join(event.data for event in events)


def shown(event: Event) -> dict[str, Any]:
    """The data of an event."""
    time = datetime.fromtimestamp(event.time, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
    return {"id": event.id, "job": event.job_id, "time": time, **event.data}


def encoded(event: Event) -> bytes:
    """An event as it is sent."""
    return f"id: {event.id}\nevent: {event.kind}\ndata: {json.dumps(shown(event))}\n\n".encode()
