"""Around every request: what is refused before it is looked at, and the headers of every answer."""

import time
from typing import Any

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.server import metrics
from service.server.problems import Problem
from service.server.settings import LOOPBACK, Settings

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
_BODY_BYTES = 4 << 20
"""Of a request that is no upload."""


class Guard:
    """ASGI middleware."""

    def __init__(self, app: ASGIApp, settings: Settings) -> None:
        self._app, self._settings = app, settings

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        began = time.perf_counter()

        async def answer(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
                seconds = time.perf_counter() - began
                metrics.REQUESTS.answered(scope["method"], _route(scope), message["status"], seconds)
            await send(message)

        problem = self._refused(scope, Headers(scope=scope))
        if problem is not None:
            await problem.response(scope["path"])(scope, receive, answer)
            return
        await self._app(scope, receive, answer)

    def _refused(self, scope: Scope, headers: Headers) -> Problem | None:
        if "\x00" in scope["path"]:
            return Problem("not-found", "there is no such path")
        if not self._known_host(headers.get("host", "")):
            return Problem("forbidden", "the server is not known by this name", "see --host-name")
        if not self._same_origin(scope, headers):
            return Problem("forbidden", "requests from pages of others are refused")
        return _body_refused(scope, headers)

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


def _body_refused(scope: Scope, headers: Headers) -> Problem | None:
    """Bodies of uploads are counted where they are taken in; others are small, and say so."""
    if scope["method"] == "PUT":
        return None
    if "transfer-encoding" in headers:
        return Problem("length-required", "the request has no Content-Length")
    length = headers.get("content-length", "0")
    if not length.isascii() or not length.isdigit() or int(length[:15]) > _BODY_BYTES or len(length) > 15:
        return Problem("too-large", f"a request may have {_BODY_BYTES} bytes")
    if headers.get("content-type", "").startswith(("multipart/", "application/x-www-form-urlencoded")):
        return Problem("unsupported", "forms are not taken")
    return None


def _route(scope: Scope) -> str:
    """The path's pattern: the paths themselves are without end."""
    route: Any = scope.get("route")
    return getattr(route, "path", "none")
