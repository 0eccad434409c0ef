"""A connection with an end: to the time that its client may take for a request, and for taking an answer.

uvicorn waits for ever for the rest of a head, for the rest of a body that nobody wants any more, and for a client that
does not read. Bodies that somebody wants have `bodies.Timely`.
"""

import asyncio
import json
import socket
from collections.abc import Callable
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from service.api.connection_slots import ConnectionSlots
from service.problems import Problem, ending, too_slow
from service.settings import Limits

_DISMISSAL_S = 1.0
"""For so long what a client still sends is thrown away, so that it can read why it has to go."""
_MOST_DISMISSALS = 32
"""Connections for which that is done at a time."""
_KEEPALIVE = {"TCP_KEEPIDLE": 30, "TCP_KEEPINTVL": 10, "TCP_KEEPCNT": 3}


class Connection(H11Protocol):
    """One, as uvicorn makes it."""

    _dismissals = 0

    def __init__(self, *, slots: ConnectionSlots, limits: Limits, **words: Any) -> None:
        super().__init__(**words)
        self._slots, self._limits = slots, limits
        self._owed: asyncio.TimerHandle | None = None
        """Ends the connection unless the client sends what it owes."""
        self._unread: asyncio.TimerHandle | None = None
        """Ends the connection unless the client takes what it is sent."""
        self._dismissed = False

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """A client has come."""
        super().connection_made(transport)
        _notice_who_vanishes(transport.get_extra_info("socket"), self._limits.stall_s)
        if self._slots.closed:
            # it was waiting to be taken up when uvicorn asked all connections to end, so nobody would ask this one
            self._dismiss(ending())
        elif self._slots.take(self, self.client[0] if self.client else ""):
            self._await(self._limits.head_s, self._too_slow)
        else:
            words = "there are too many connections"
            self._dismiss(Problem("unavailable", words, headers={"Retry-After": "5"}))

    def connection_lost(self, exc: Exception | None) -> None:
        """It has ended, whoever ended it."""
        self._slots.release(self)
        self._owe_nothing()
        if self._unread is not None:
            self._unread.cancel()
        if self._dismissed:
            Connection._dismissals -= 1
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Something has come."""
        if not self._dismissed:
            super().data_received(data)
            self._look()

    def on_response_complete(self) -> None:
        """A request is answered."""
        super().on_response_complete()
        self._look()

    def _look(self) -> None:
        """What the client owes now."""
        if self.transport.is_closing():
            self._owe_nothing()
        elif self.cycle is not None and not self.cycle.response_complete:
            self._owe_nothing()
            self._slots.mark_busy(self)
        else:
            self._slots.mark_idle(self)
            if self.timeout_keep_alive_task is None and self._owed is None:
                # the rest of a head, or of a body whose request was answered without it
                begins = self.conn.their_state is h11.IDLE
                self._await(self._limits.head_s if begins else self._limits.stall_s, self._too_slow)

    def _await(self, seconds: float, otherwise: Callable[[], None]) -> None:
        self._owed = self.loop.call_later(seconds, otherwise)

    def _owe_nothing(self) -> None:
        if self._owed is not None:
            self._owed.cancel()
            self._owed = None

    def _too_slow(self) -> None:
        if self.conn.our_state is h11.IDLE:
            self._dismiss(too_slow())
        else:
            self.abort()

    def pause_writing(self) -> None:
        """The client does not take what it is sent."""
        super().pause_writing()
        self._unread = self.loop.call_later(self._limits.stall_s, self.abort)

    def resume_writing(self) -> None:
        """It does again."""
        super().resume_writing()
        if self._unread is not None:
            self._unread.cancel()
            self._unread = None

    def abort(self) -> None:
        """Break it off at once."""
        self.transport.abort()

    def _dismiss(self, problem: Problem) -> None:
        """End it with a word."""
        self._owe_nothing()
        self._slots.release(self)
        if self._dismissed or Connection._dismissals >= _MOST_DISMISSALS:
            self.abort()
            return
        self._dismissed = True
        Connection._dismissals += 1
        self.transport.write(_answer(problem))
        self.transport.write_eof()
        self.loop.call_later(_DISMISSAL_S, self.abort)


def _answer(problem: Problem) -> bytes:
    """A whole answer, after which there is no other."""
    body = json.dumps(problem.body("/")).encode()
    headers = {
        **problem.headers,
        "Content-Type": "application/problem+json",
        "Content-Length": str(len(body)),
        "Cache-Control": "no-store",
        "Connection": "close",
    }
    lines = [
        f"HTTP/1.1 {problem.status} {problem.title}",
        *(f"{name}: {text}" for name, text in headers.items()),
    ]
    return "\r\n".join([*lines, "", ""]).encode() + body


def _notice_who_vanishes(line: Any, seconds: float) -> None:
    """Have the system end a connection whose other end does not answer any more."""
    if line is None or line.family not in (socket.AF_INET, socket.AF_INET6):
        return
    line.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in {**_KEEPALIVE, "TCP_USER_TIMEOUT": int(seconds * 1000)}.items():
        if hasattr(socket, name):
            line.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
