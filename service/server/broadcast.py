"""Events as they happen, for any number of listeners: one reader of the database, whoever wrote it."""

import asyncio
import json
import logging
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from sqlalchemy.exc import SQLAlchemyError
from starlette.concurrency import run_in_threadpool

from service.server import journal
from service.server.database import Database
from service.server.tables import Event

_log = logging.getLogger(__name__)
_LOOK_S = 0.25
_COMMENT_S = 15.0
_BEHIND = 2000
"""Events that wait for a listener before it is dropped; it may come back and go on where it was."""
_PAGE = 500


@dataclass(eq=False)
class _Listener:
    job_id: str | None
    owner: str | None
    queue: "asyncio.Queue[Event | None]" = field(default_factory=lambda: asyncio.Queue(_BEHIND))

    def wants(self, event: Event) -> bool:
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
        for event in events:
            self._cursor = event.id
            for listener in [each for each in self._listeners if each.wants(event)]:
                _put(listener, event)

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
            last: Event | None = None
            while events := await run_in_threadpool(self._read, cursor, job_id, owner):
                for event in events:
                    cursor, last = event.id, event
                    yield encoded(event)
            over = job_id is not None and last is not None and last.kind == journal.END
            while not over and not self._closed:
                waiting = await self._next(listener)
                if waiting is None and self._closed:
                    break
                # between what was read and what was heard nothing may be missing, and nothing twice
                missed = (
                    await run_in_threadpool(self._read, cursor, job_id, owner)
                    if waiting is None
                    else [waiting]
                )
                for event in missed:
                    if event.id > cursor:
                        cursor = event.id
                        yield encoded(event)
                        over = job_id is not None and event.kind == journal.END
                if not missed:
                    yield b": \n\n"
        finally:
            self._listeners.discard(listener)

    async def _next(self, listener: _Listener) -> Event | None:
        """The next event; None: nothing for a while, or the end."""
        try:
            return await asyncio.wait_for(listener.queue.get(), _COMMENT_S)
        except TimeoutError:
            return None

    def _read(self, cursor: int, job_id: str | None, owner: str | None) -> list[Event]:
        with self._database.read() as session:
            return list(journal.after(session, cursor, job_id=job_id, owner=owner, limit=_PAGE))

    def _latest(self) -> int:
        with self._database.read() as session:
            return journal.latest(session)


def _put(listener: _Listener, event: Event | None) -> None:
    try:
        listener.queue.put_nowait(event)
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
