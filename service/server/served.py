"""Files as answers: Range, ETag, media types, and policies for what may hold scripts."""

import mimetypes
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

from starlette.datastructures import Headers
from starlette.responses import FileResponse
from starlette.types import Message, Receive, Scope, Send

from service.server import shown
from service.server.problems import Problem

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


def etag(found: os.stat_result) -> str:
    """Changes whenever the file does: files are replaced, never written into."""
    return f'"{found.st_ino:x}-{found.st_size:x}-{found.st_mtime_ns:x}"'


def quoted(name: str) -> str:
    """The name as a part of a URL."""
    return quote(name, safe="/")


class FileOf(FileResponse):
    """A file, whole or in parts, or that it has not changed."""

    def __init__(self, path: Path, name: str, *, strange: bool = False, download: bool = False) -> None:
        found = path.stat()
        kind = media_type(name, strange=strange)
        headers = {"ETag": etag(found), "Cache-Control": "private, no-cache"}
        if strange:
            headers["Content-Security-Policy"] = _STRANGE_POLICY
        elif kind == "text/html":
            headers["Content-Security-Policy"] = _REPORT_POLICY
        super().__init__(
            path,
            headers=headers,
            media_type=kind,
            stat_result=found,
            filename=Path(name).name if download else None,
        )

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
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


def result_names(out: Path) -> Iterator[str]:
    """Names of all files of a result, sorted; what stages made is not among them."""
    found: list[str] = []
    for folder, folders, files in os.walk(out):
        inside = os.path.relpath(folder, out)
        folders[:] = [name for name in folders if name[0] != "." and not (inside == "." and name == "stages")]
        found += [os.path.normpath(os.path.join(inside, name)) for name in files if name[0] != "."]
    yield from sorted(found)


def result_shown(job_id: str, out: Path, name: str) -> dict[str, Any]:
    """A result as in the list."""
    found = (out / name).stat()
    return {
        "name": name,
        "bytes": found.st_size,
        "media_type": media_type(name),
        "modified": shown.time(found.st_mtime),
        "etag": etag(found),
        "url": f"/v1/jobs/{job_id}/results/{quoted(name)}",
    }
