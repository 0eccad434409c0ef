"""Files as answers: Range, ETag, media types, and policies for what may hold scripts."""

import base64
import mimetypes
import os
from collections.abc import Collection
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import quote

from starlette.datastructures import Headers
from starlette.responses import FileResponse
from starlette.types import Message, Receive, Scope, Send

from service.api import serializers
from service.db.tables import Result
from service.problems import Problem

_TYPES = {
    ".ply": "application/octet-stream",
    ".bin": "application/octet-stream",
    ".yaml": "application/yaml",
    ".csv": "text/csv",
    ".json": "application/json",
    ".html": "text/html",
    ".txt": "text/plain",
}
_PICTURES = {".png": "image/png", ".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".webp": "image/webp"}
# a report brings its own script and style, and must not reach anything else with them: not even its own origin
_REPORT_POLICY = (
    "sandbox allow-scripts; default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "img-src data:; frame-ancestors 'self'"
)
_STRANGE_POLICY = "sandbox; default-src 'none'"


def media_type(name: str, *, strange: bool = False) -> str:
    """Of a file by its name; strange: of a stranger's, which must not be shown as a page."""
    suffix = Path(name).suffix.lower()
    if strange:
        return _PICTURES.get(suffix, "application/octet-stream")
    guessed = _TYPES.get(suffix) or _PICTURES.get(suffix) or mimetypes.guess_type(name)[0]
    return guessed or "application/octet-stream"


def etag(status: os.stat_result) -> str:
    """Changes whenever the file does: files are replaced, never written into."""
    return f'"{status.st_ino:x}-{status.st_size:x}-{status.st_mtime_ns:x}"'


def quoted(name: str) -> str:
    """The name as a part of a URL."""
    return quote(name, safe="/")


def attachment(name: str) -> str:
    """The Content-Disposition of a file that is saved under this name (RFC 6266)."""
    plain = "".join(letter if " " <= letter <= "~" and letter not in '"\\%' else "_" for letter in name)
    return f"attachment; filename=\"{plain}\"; filename*=UTF-8''{quote(name, safe='')}"


class FileOf(FileResponse):
    """An open file, whole or in parts, or that it has not changed."""

    def __init__(
        self,
        file: BinaryIO,
        name: str,
        *,
        strange: bool = False,
        download: bool = False,
        sha256: str | None = None,
    ) -> None:
        self._file = file
        """Held, and with it the very file that was checked, until this answer is gone."""
        status = os.fstat(file.fileno())
        kind = media_type(name, strange=strange)
        headers = {"ETag": etag(status), "Cache-Control": "private, no-cache"}
        if sha256 is not None:  # of the whole file, also where a part is sent (RFC 9530)
            headers["Repr-Digest"] = f"sha-256=:{base64.b64encode(bytes.fromhex(sha256)).decode()}:"
        if strange:
            headers["Content-Security-Policy"] = _STRANGE_POLICY
        elif kind == "text/html":
            headers["Content-Security-Policy"] = _REPORT_POLICY
        super().__init__(
            f"/dev/fd/{file.fileno()}",  # each reader has a position of its own
            headers=headers,
            media_type=kind,
            stat_result=status,
            filename=Path(name).name if download else None,
        )

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        with self._file:
            await self._answer(scope, receive, send)

    async def _answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        wanted = Headers(scope=scope).get("if-none-match", "")
        if self.headers["etag"] in [mark.strip().removeprefix("W/") for mark in wanted.split(",")] or (
            wanted.strip() == "*"
        ):
            kept = {name: self.headers[name] for name in ("etag", "cache-control")}
            raw = [(name.encode(), value.encode()) for name, value in kept.items()]
            await send({"type": "http.response.start", "status": 304, "headers": raw})
            await send({"type": "http.response.body", "body": b""})
            return
        problem: Problem | None = None

        async def answer(message: Message) -> None:
            nonlocal problem
            if message["type"] == "http.response.start" and message["status"] >= 400:
                size = f"bytes */{self.headers['content-length']}"
                problem = Problem("range", "the file has no such part", headers={"Content-Range": size})
            if problem is None:
                await send(message)

        await super().__call__(scope, receive, answer)
        if problem is not None:
            await problem.response(scope["path"])(scope, receive, send)


def pictures(base: str, names: Collection[str], index: int) -> dict[str, str | None]:
    """URLs of the pictures of an image, by kind; None where there is none among the names of a result."""
    made = {kind: f"frames/{kind}/{index:06}.jpg" for kind in ("photo", "before", "after")}
    return {kind: base + name if name in names else None for kind, name in made.items()}


def result_shown(base: str, out: Path, name: str, row: Result | None = None) -> dict[str, Any]:
    """A result as in the list; of one that is damaged or gone, what it was.

    base: path of all of them, with / at its end
    """
    try:
        status: os.stat_result | None = os.lstat(out / name)
    except OSError:
        status = None
    return {
        "name": name,
        "bytes": row.bytes if row else status.st_size if status else 0,
        "sha256": row.sha256 if row else None,
        "media_type": media_type(name),
        "modified": serializers.time(status.st_mtime) if status else None,
        "etag": etag(status) if status else None,
        "url": base + quoted(name),
    }
