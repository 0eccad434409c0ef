"""Bodies of requests: in time, and no longer than they may be."""

import asyncio
import time

from starlette.types import Message, Receive

from service.settings import Limits


class Timely:
    """An ASGI `receive` for which a client that is too slow has gone.

    Only the time that the server waits for the client counts: one pause may last `stall_s`, and all of them together as
    much more as the bytes that came take at `slowest_bytes_per_s`.
    """

    def __init__(self, receive: Receive, limits: Limits) -> None:
        self._receive, self._limits = receive, limits
        self._waited, self._bytes = 0.0, 0
        self._whole = False
        self.late = False
        """Whether the client was too slow."""

    async def __call__(self) -> Message:
        if self._whole:
            return await self._receive()  # which tells when the client goes
        began = time.monotonic()
        try:
            async with asyncio.timeout(self._patience()):
                message = await self._receive()
        except TimeoutError:
            self.late = True
            return {"type": "http.disconnect"}
        self._waited += time.monotonic() - began
        self._bytes += len(message.get("body", b""))
        self._whole = message["type"] != "http.request" or not message.get("more_body", False)
        return message

    def _patience(self) -> float:
        limits = self._limits
        return min(limits.stall_s, limits.stall_s + self._bytes / limits.slowest_bytes_per_s - self._waited)


async def whole(receive: Receive) -> bytes | None:
    """All of a body; None: the client has gone, or is too slow."""
    body = bytearray()
    while True:
        message = await receive()
        if message["type"] != "http.request":
            return None
        body += message.get("body", b"")
        if not message.get("more_body", False):
            return bytes(body)


def again(body: bytes, receive: Receive) -> Receive:
    """A `receive` that begins with this body, and continues with what comes after it."""
    given = False

    async def replay() -> Message:
        nonlocal given
        if given:
            return await receive()
        given = True
        return {"type": "http.request", "body": body, "more_body": False}

    return replay
