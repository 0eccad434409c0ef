"""Around every request: what is refused before it is looked at, and the headers of every answer."""

import asyncio
import time
from typing import Any

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service import problems
from service.api import metrics, request_bodies
from service.problems import Problem
from service.settings import LOOPBACK, Settings

HEADERS = {
    "Content-Security-Policy": (
        "default-src 'self'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
        "connect-src 'self'; worker-src 'self' blob:; frame-src 'self'; object-src 'none'; base-uri 'none'; "
        "form-action 'self'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), microphone=(), geolocation=()",
    "Cache-Control": "no-store",
}
"""Unless an answer has its own."""
_BATCHES, _CHECKS, _INSPECTIONS = "/v1/batches", "/v1/checks", "/v1/inspections"


class Guard:
    """ASGI middleware."""

    def __init__(self, app: ASGIApp, settings: Settings) -> None:
        self._app, self._settings = app, settings

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        began, started = time.perf_counter(), False

        async def answer(message: Message) -> None:
            nonlocal started
            if message["type"] == "http.response.start":
                started = True
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
                seconds = time.perf_counter() - began
                metrics.REQUESTS.answered(scope["method"], _route(scope), message["status"], seconds)
            await send(message)

        headers, timely = Headers(scope=scope), request_bodies.Timely(receive, self._settings.limits)
        problem = self._refused(scope, headers)
        inner: Receive = timely
        if problem is None and _is_small(scope, headers):
            # before anybody looks at it: what parses it cannot tell a client that is slow from one that sends nonsense
            body = await request_bodies.whole(timely)
            problem = problems.too_slow() if body is None else None
            inner = request_bodies.again(body or b"", timely)
        if problem is not None:
            await problem.response(scope["path"])(scope, receive, answer)
            return
        try:
            await self._app(scope, inner, answer)
        except asyncio.CancelledError:
            # the service has waited for this request as long as it waits when it ends
            if started:
                raise
            await problems.ending().response(scope["path"])(scope, receive, answer)

    def _refused(self, scope: Scope, headers: Headers) -> Problem | None:
        if "\x00" in scope["path"]:
            return Problem("not-found", "there is no such path")
        if not self._known_host(headers.get("host", "")):
            return Problem("forbidden", "the server is not known by this name", "see --host-name")
        if not self._same_origin(scope, headers):
            return Problem("forbidden", "requests from pages of others are refused")
        return self._body_refused(scope, headers)

    def _known_host(self, host: str) -> bool:
        name = host.rsplit(":", 1)[0] if not host.endswith("]") else host
        name = name.strip("[]").lower()
        if name in LOOPBACK or name in self._settings.hosts:
            return True
        # without keys, a page of anybody could give its own name our address
        return self._settings.asks_for_keys and not self._settings.hosts

    def _same_origin(self, scope: Scope, headers: Headers) -> bool:
        """Without keys, a browser could be made to ask by any page."""
        if self._settings.asks_for_keys:
            return True
        if headers.get("sec-fetch-site", "none") not in ("none", "same-origin"):
            return scope["method"] in ("GET", "HEAD") and headers.get("sec-fetch-mode") == "navigate"
        origin = headers.get("origin")
        return origin is None or origin.partition("://")[2] == headers.get("host")

    def _body_refused(self, scope: Scope, headers: Headers) -> Problem | None:
        """Bodies of uploads are counted where they are taken in; others are small, and say so."""
        if scope["method"] == "PUT":
            return None
        if "transfer-encoding" in headers:
            return Problem("length-required", "the request has no Content-Length")
        limits, length = self._settings.limits, headers.get("content-length", "0")
        larger = {_BATCHES: limits.batch_bytes, _CHECKS: limits.check_bytes}
        larger[_INSPECTIONS] = limits.inspection_bytes
        most = larger.get(scope["path"], limits.json_bytes)
        if not length.isascii() or not length.isdigit() or len(length) > 15 or int(length) > most:
            return Problem("too-large", f"the body of this request may have {most} bytes", limit=most)
        if headers.get("content-type", "").startswith(("multipart/", "application/x-www-form-urlencoded")):
            return Problem("unsupported", "forms are not taken")
        return None


def _is_small(scope: Scope, headers: Headers) -> bool:
    """Whether a request has a body that is taken in before the request is looked at."""
    return (
        scope["method"] != "PUT"
        and scope["path"] != _INSPECTIONS
        and headers.get("content-length", "0") != "0"
    )


def _route(scope: Scope) -> str:
    """The path's pattern: the paths themselves are without end."""
    route: Any = scope.get("route")
    return getattr(route, "path", "none")
