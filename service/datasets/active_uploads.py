"""Which files this service is taking in: a newer request of the same key takes over from an older one.

A client that vanished without a word leaves a request that waits for it; when the client comes back, that request would
be in its way.
"""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from service.problems import Problem

_PATIENCE_S = 10.0
"""Seconds that an older request may take to write down what it has."""


class ActiveUpload:
    """A request whose body is being taken in."""

    def __init__(self, key_id: str) -> None:
        self.key_id = key_id
        self.ended = asyncio.Event()
        self.taking = True
        """False: all of the body is there, and what became of it is being found out."""
        self._superseded = False
        self._waiting: asyncio.Timeout | None = None

    async def of(self, body: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
        """The body's pieces.

        Raises Problem: a newer request has come, also in the midst of waiting for a piece.
        """
        while (data := await self._next(body)) is not None:
            yield data
        self.taking = False

    async def _next(self, body: AsyncIterator[bytes]) -> bytes | None:
        if self._superseded:
            raise _superseded()
        try:
            async with asyncio.timeout(None) as self._waiting:
                return await anext(body, None)
        except TimeoutError:
            raise _superseded() from None
        finally:
            self._waiting = None

    def supersede(self) -> None:
        """Have it end as soon as it waits for its client."""
        self._superseded = True
        if self._waiting is not None:
            self._waiting.reschedule(0.0)


class ActiveUploads:
    """Those of one service, by the place they are for."""

    def __init__(self) -> None:
        self._present: dict[str, ActiveUpload] = {}

    @asynccontextmanager
    async def begin(self, place: str, key_id: str) -> AsyncIterator[ActiveUpload]:
        """A new one, once an older one of the same key has given way.

        Raises Problem: another key's is at it, or it does not give way.
        """
        while (older := self._present.get(place)) is not None:
            if older.key_id != key_id or not older.taking:
                raise locked()
            older.supersede()
            try:
                async with asyncio.timeout(_PATIENCE_S):
                    await older.ended.wait()
            except TimeoutError:
                raise locked() from None
        upload = self._present[place] = ActiveUpload(key_id)
        try:
            yield upload
        finally:
            del self._present[place]
            upload.ended.set()


def _superseded() -> Problem:
    return Problem("locked", "a newer request for this file came", headers={"Connection": "close"})


def locked() -> Problem:
    """What a request hears that comes while another one is at its file."""
    return Problem("locked", "another request for this file is being taken in", headers={"Retry-After": "1"})
