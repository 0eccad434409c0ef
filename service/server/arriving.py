"""A file that is arriving: raw bytes with an offset, checked against digests. What is on disk is what has arrived."""

import base64
import binascii
import errno
import fcntl
import hashlib
import os
import re
import shutil
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from sqlalchemy import select
from sqlalchemy.orm import Session
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers
from starlette.requests import ClientDisconnect

from service.server import finding, quota
from service.server.context import Server
from service.server.keys import Principal
from service.server.places import new_id, now
from service.server.problems import Problem
from service.server.tables import INVALID, UPLOADING, Dataset, Upload

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
    found = _SHA256.search(text)
    try:
        digest = base64.b64decode(found.group(1), validate=True) if found else b""
    except binascii.Error:
        digest = b""
    if len(digest) != 32:
        raise Problem("invalid", f"{name} holds no sha-256", "write sha-256=:BASE64: (RFC 9530)")
    return digest


def admit(server: Server, principal: Principal, dataset_id: str, path: str, wanted: Piece) -> Upload:
    """The record of the file, made if it is new.

    Raises Problem: the dataset takes no files, a quota, no room.
    """
    limits = server.settings.limits
    if wanted.length > limits.upload_bytes:
        raise Problem("too-large", f"a file may have {limits.upload_bytes} bytes", limit=limits.upload_bytes)
    with server.database.write() as session:
        dataset = finding.one(session, Dataset, dataset_id, principal, lock=True)
        if dataset.state not in (UPLOADING, INVALID) or dataset.folder is not None:
            raise Problem(
                "conflict", f"the dataset is {dataset.state} and takes no files", "make another one"
            )
        upload = find(session, dataset_id, path)
        if upload is None:
            upload = Upload(id=new_id("up"), dataset_id=dataset_id, path=path, length=0)
            session.add(upload)
        _check_room(server, session, principal, wanted.length - upload.length, wanted)
        # only what is begun anew may change its length: the rest of an upload belongs to what is there
        if wanted.offset and upload.length != wanted.length:
            raise Problem(
                "conflict", f"the file was begun with {upload.length} bytes", "begin anew at offset 0"
            )
        upload.length, dataset.updated, dataset.state = wanted.length, now(), UPLOADING
        if wanted.offset == 0:
            upload.complete, upload.sha256 = False, None
        return upload


def find(session: Session, dataset_id: str, path: str) -> Upload | None:
    """The record of a file."""
    return session.scalars(
        select(Upload).where(Upload.dataset_id == dataset_id, Upload.path == path)
    ).one_or_none()


def _check_room(server: Server, session: Session, principal: Principal, more: int, wanted: Piece) -> None:
    if more > 0 and quota.used_bytes(session, principal.owner) + more > server.settings.limits.owner_bytes:
        raise Problem("quota", "the datasets and results of this owner would be too large", "remove some")
    free = shutil.disk_usage(server.places.root).free
    if free - (wanted.length - wanted.offset) < server.settings.limits.disk_reserve_bytes:
        raise Problem("disk-full", f"the disk has {free} bytes left")


async def receive(file: Path, wanted: Piece, body: AsyncIterator[bytes]) -> int:
    """Add the body to the file; how long it is then. When the connection breaks, what has arrived stays.

    Raises Problem: another request is at it, the offset is not its end, a digest that does not fit, a full disk.
    """
    stream = await run_in_threadpool(_open, file, wanted)
    try:
        return await _fill(stream, wanted, body)
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise Problem("disk-full", "the disk is full") from None
        raise
    finally:
        stream.close()


def _open(file: Path, wanted: Piece) -> BinaryIO:
    file.parent.mkdir(parents=True, exist_ok=True)
    stream = file.open("ab")
    try:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        stream.close()
        raise Problem(
            "locked", "another request for this file is being taken in", headers={"Retry-After": "1"}
        ) from None
    there = os.fstat(stream.fileno()).st_size
    if wanted.offset == 0:
        stream.truncate(0)
    elif wanted.offset != there:
        stream.close()
        raise Problem(
            "offset-mismatch",
            f"{there} bytes are there, the request begins at {wanted.offset}",
            headers={"Upload-Offset": str(there)},
            offset=there,
        )
    return stream


async def _fill(stream: BinaryIO, wanted: Piece, body: AsyncIterator[bytes]) -> int:
    digest, buffer, count = hashlib.sha256(), bytearray(), 0
    try:
        async for data in body:
            buffer += data
            count += len(data)
            if count > wanted.size:
                raise Problem("invalid", "the body is longer than Content-Length")
            if len(buffer) >= _PIECE:
                await run_in_threadpool(_write, stream, buffer, digest, wanted)
                buffer = bytearray()
    except ClientDisconnect:
        # nobody hears an answer; a piece that is checked as a whole counts as a whole
        await run_in_threadpool(_keep, stream, buffer, wanted)
        raise
    await run_in_threadpool(_write, stream, buffer, digest, wanted)
    if wanted.content_digest not in (None, digest.digest()):
        stream.truncate(wanted.offset)
        raise Problem(
            "digest-mismatch",
            "the body is not what Content-Digest says",
            headers={"Upload-Offset": str(wanted.offset)},
        )
    stream.flush()
    return wanted.offset + count


def _write(stream: BinaryIO, data: bytearray, digest: "hashlib._Hash", wanted: Piece) -> None:
    stream.write(data)
    stream.flush()
    if wanted.content_digest is not None:
        digest.update(data)


def _keep(stream: BinaryIO, data: bytearray, wanted: Piece) -> None:
    if wanted.content_digest is not None:
        stream.truncate(wanted.offset)
    else:
        stream.write(data)
        stream.flush()


def complete(server: Server, upload: Upload, wanted: Piece, file: Path) -> Upload:
    """The record of a file that is all there, once its digest is known to be right.

    Raises Problem: it is not; the file begins anew.
    """
    with file.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256")
        os.fsync(stream.fileno())
    right = wanted.repr_digest in (None, digest.digest())
    if not right:
        os.truncate(file, 0)
    with server.database.write() as session:
        found = session.get(Upload, upload.id)
        if found is None:
            raise Problem("not-found", "the upload was removed meanwhile")
        found.complete, found.sha256 = right, digest.hexdigest() if right else None
    if not right:
        raise Problem(
            "digest-mismatch",
            "the file is not what Repr-Digest says: it begins anew",
            headers={"Upload-Offset": "0"},
        )
    return found
