"""A file that is arriving: raw bytes with an offset, checked against digests. What is on disk is what has arrived."""

import base64
import binascii
import fcntl
import hashlib
import os
import re
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers
from starlette.requests import ClientDisconnect

from lvba.io.files import sync
from service.datasets import active_uploads
from service.problems import Problem
from service.system import disk_space, durable

_PIECE = 1 << 20
_SHA256 = re.compile(r"(?:^|,)\s*sha-256=:([A-Za-z0-9+/=]*):")
_NUMBER = re.compile(r"[0-9]{1,15}")


@dataclass(frozen=True)
class Piece:
    """What the headers of an upload say."""

    offset: int
    size: int
    """Bytes of this body."""
    length: int
    """Bytes of the whole file."""
    content_digest: bytes | None
    repr_digest: bytes | None


def piece(headers: Headers) -> Piece:
    """The piece that a request holds.

    Raises Problem: no length, or headers that do not fit together.
    """
    if "content-length" not in headers:
        raise Problem("length-required", "the request has no Content-Length")
    size, offset = _number(headers, "content-length", 0), _number(headers, "upload-offset", 0)
    length = _number(headers, "upload-length", offset + size)
    if offset + size > length:
        raise Problem("invalid", "Upload-Offset and Content-Length go beyond Upload-Length")
    return Piece(
        offset, size, length, *(_digest(headers, name) for name in ("content-digest", "repr-digest"))
    )


def _number(headers: Headers, name: str, default: int) -> int:
    text = headers.get(name)
    if text is None:
        return default
    if not _NUMBER.fullmatch(text):
        raise Problem("invalid", f"{name} is not a number of bytes")
    return int(text)


def _digest(headers: Headers, name: str) -> bytes | None:
    text = headers.get(name)
    if text is None:
        return None
    match = _SHA256.search(text)
    try:
        digest = base64.b64decode(match.group(1), validate=True) if match else b""
    except binascii.Error:
        digest = b""
    if len(digest) != 32:
        raise Problem("invalid", f"{name} holds no sha-256", "write sha-256=:BASE64: (RFC 9530)")
    return digest


def opened(file: Path, wanted: Piece) -> BinaryIO:
    """The file, held for one request until it is closed. Nothing of it has changed.

    Raises Problem: another request is at it, the piece does not begin at its end, a full disk.
    """
    if wanted.offset and not file.exists():
        raise _elsewhere(0, wanted)
    with _disk_that_may_be_full():
        durable.make_folder(file.parent)
        stream = file.open("ab")
    try:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        stream.close()
        raise active_uploads.locked() from None
    there = os.fstat(stream.fileno()).st_size
    if wanted.offset not in (0, there):
        stream.close()
        raise _elsewhere(there, wanted)
    return stream


def _elsewhere(there: int, wanted: Piece) -> Problem:
    return Problem(
        "offset-mismatch",
        f"{there} bytes are there, the request begins at {wanted.offset}",
        headers={"Upload-Offset": str(there)},
        offset=there,
    )


async def receive(stream: BinaryIO, wanted: Piece, body: AsyncIterator[bytes], reserve: int) -> int:
    """Add the body to an open file; how long it is then. When the connection breaks, what has arrived stays.

    What stays is on the disk by then.
    reserve: bytes that the disk must have left
    Raises Problem: a digest that does not fit, a full disk.
    """
    taken = _Taken(stream, wanted, reserve)
    with _disk_that_may_be_full():
        try:
            async for data in body:
                if taken.add(data):
                    await run_in_threadpool(taken.write)
            await run_in_threadpool(taken.end)
        except (ClientDisconnect, OSError, Problem):
            await run_in_threadpool(taken.keep)
            raise
    return wanted.offset + taken.count


class _Taken:
    """What has come of a body so far."""

    def __init__(self, stream: BinaryIO, wanted: Piece, reserve: int) -> None:
        self._stream, self._wanted, self._reserve = stream, wanted, reserve
        self._digest, self._buffer = hashlib.sha256(), bytearray()
        self.count = 0

    def add(self, data: bytes) -> bool:
        """Take a piece into memory; True: it is time to write."""
        self._buffer += data
        self.count += len(data)
        if self.count > self._wanted.size:
            raise Problem("invalid", "the body is longer than Content-Length")
        return len(self._buffer) >= _PIECE

    def write(self) -> None:
        """Have the file hold what is in memory."""
        data, self._buffer = self._buffer, bytearray()
        # looked at when the request came, too; but many come at once, and each was granted what is free
        if data and (lack := disk_space.lacking(self._stream.fileno(), self._reserve + len(data))):
            raise Problem("disk-full", f"the disk is full: {lack}")
        self._stream.write(data)
        self._stream.flush()
        if self._wanted.content_digest is not None:
            self._digest.update(data)

    def end(self) -> None:
        """All has come."""
        self.write()
        if self._wanted.content_digest not in (None, self._digest.digest()):
            raise Problem(
                "digest-mismatch",
                "the body is not what Content-Digest says",
                headers={"Upload-Offset": str(self._wanted.offset)},
            )
        _sync(self._stream)

    def keep(self) -> None:
        """It was cut short: what has come stays, but for a piece that is checked as a whole."""
        with suppress(OSError, Problem):
            if self._wanted.content_digest is not None:
                cut(self._stream, self._wanted.offset)
                return
            self.write()
        with suppress(OSError):
            _sync(self._stream)


def cut(stream: BinaryIO, length: int) -> None:
    """Shorten a file, also on the disk."""
    stream.truncate(length)
    _sync(stream)


def _sync(stream: BinaryIO) -> None:
    """Have the file, and that it is there, on the disk."""
    os.fsync(stream.fileno())
    with suppress(FileNotFoundError):  # removed meanwhile: its record tells
        sync(Path(stream.name).parent)


@contextmanager
def _disk_that_may_be_full() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if disk_space.says_full(error):
            raise Problem("disk-full", "the disk is full") from None
        raise


def sha256(file: Path) -> bytes:
    """Of a file that is all there."""
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").digest()
