"""Events as they happen, for any number of listeners: one reader of the database, whoever wrote it."""

import asyncio
import json
import logging
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, NamedTuple

from sqlalchemy.exc import SQLAlchemyError
from starlette.concurrency import run_in_threadpool

from service.server import journal
from service.server.database import Database
from service.server.tables import Event

_log = logging.getLogger(__name__)
_LOOK_S = 0.25
_COMMENT_S = 15.0
_BEHIND = 100
"""Rounds of events that wait for a listener; one that is slower finds in the journal what it missed."""
_PAGE = 500


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
    owner: str | None
    queue: "asyncio.Queue[list[_Sent] | None]" = field(default_factory=lambda: asyncio.Queue(_BEHIND))

    def wants(self, event: _Sent) -> bool:
        return self.job_id in (None, event.job_id) and self.owner in (None, event.owner)


class Broadcaster:
    """Reads new events a few times a second while somebody listens."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._listeners: set[_Listener] = set()
        self._cursor: int | None = None
        self._closed = False

    @property
    def listeners(self) -> int:
        """How many there are."""
        return len(self._listeners)

    async def run(self) -> None:
        """Until it is closed."""
        while not self._closed:
            if self._listeners:
                await self._look()
            else:
                self._cursor = None
            await asyncio.sleep(_LOOK_S)

    def close(self) -> None:
        """End all streams."""
        self._closed = True
        for listener in self._listeners:
            _put(listener, None)

    async def _look(self) -> None:
        if self._cursor is None:
            return
        try:
            events = await run_in_threadpool(self._read, self._cursor, None, None)
        except SQLAlchemyError as error:
            _log.warning("events cannot be read: %s", str(error).splitlines()[0])
            return
        for listener in self._listeners if events else ():
            heard = [event for event in events if listener.wants(event)]
            if heard:
                _put(listener, heard)
        self._cursor = events[-1].id if events else self._cursor

    async def stream(self, after: int | None, job_id: str | None, owner: str | None) -> AsyncIterator[bytes]:
        """Events after a cursor as server-sent events, then those that come; None: from now on.

        Of one job it ends with the job, when there is nothing after that.
        """
        listener = _Listener(job_id, owner)
        self._listeners.add(listener)
        try:
            latest = await run_in_threadpool(self._latest)
            if self._cursor is None:
                # before anything is read below, so that nothing falls between the two
                self._cursor = latest
            cursor = latest if after is None else after
            yield b": lvba\n\n"
            over = False
            while events := await run_in_threadpool(self._read, cursor, job_id, owner):
                cursor, over = events[-1].id, _is_over(events, job_id)
                yield b"".join(event.data for event in events)
            while not over and not self._closed:
                heard = await self._next(listener)
                if heard is None and not self._closed:
                    heard = await run_in_threadpool(self._read, cursor, job_id, owner)
                # what was read before is not to be heard again
                fresh = [event for event in heard or () if event.id > cursor]
                yield b"".join(event.data for event in fresh) or b": \n\n"
                if fresh:
                    cursor, over = fresh[-1].id, _is_over(fresh, job_id)
        finally:
            self._listeners.discard(listener)

    async def _next(self, listener: _Listener) -> list[_Sent] | None:
        """The next events; None: nothing for a while, or something was missed, or the end."""
        try:
            return await asyncio.wait_for(listener.queue.get(), _COMMENT_S)
        except TimeoutError:
            return None

    def _read(self, cursor: int, job_id: str | None, owner: str | None) -> list[_Sent]:
        with self._database.read() as session:
            events = journal.after(session, cursor, job_id=job_id, owner=owner, limit=_PAGE)
            return [_Sent(each.id, each.kind, each.job_id, each.owner, encoded(each)) for each in events]

    def _latest(self) -> int:
        with self._database.read() as session:
            return journal.latest(session)


def _is_over(events: list[_Sent], job_id: str | None) -> bool:
    """Whether nothing follows, as after the end of the one job that is listened to."""
    return job_id is not None and events[-1].kind == journal.END


def _put(listener: _Listener, heard: list[_Sent] | None) -> None:
    try:
        listener.queue.put_nowait(heard)
    except asyncio.QueueFull:
        # it reads too slowly: what it missed it finds in the journal
        while not listener.queue.empty():
            listener.queue.get_nowait()
        listener.queue.put_nowait(None)


def shown(event: Event) -> dict[str, Any]:
    """The data of an event."""
    time = datetime.fromtimestamp(event.time, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
    return {"id": event.id, "job": event.job_id, "time": time, **event.data}


def encoded(event: Event) -> bytes:
    """An event as it is sent."""
    return f"id: {event.id}\nevent: {event.kind}\ndata: {json.dumps(shown(event))}\n\n".encode()
