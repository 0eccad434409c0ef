"""The record of a file that arrives: whether a request may add to it, and what it is when all is there."""

import os
from pathlib import Path
from typing import BinaryIO

from sqlalchemy import select, update
from sqlalchemy.orm import Session

from service.api import queries
from service.api.context import Server
from service.datasets import file_upload, quota
from service.datasets.file_upload import Piece
from service.db.keys import Principal
from service.db.tables import INVALID, UPLOADING, Dataset, Upload
from service.problems import Problem
from service.system import disk_space
from service.system.paths import new_id, now


def find(session: Session, dataset_id: str, path: str) -> Upload | None:
    """The record of a file."""
    return session.scalars(
        select(Upload).where(Upload.dataset_id == dataset_id, Upload.path == path)
    ).one_or_none()


def begin(
    server: Server, principal: Principal, dataset_id: str, path: str, wanted: Piece
) -> tuple[Upload, BinaryIO]:
    """The record of the file, made if it is new, and the file, held for this request until it is closed.

    Raises Problem: the dataset takes no files, a quota, no room, another request is at it. Then nothing has changed.
    """
    streams: list[BinaryIO] = []
    try:
        # `end` makes it last together with what has come: one wait for the disk in place of two
        with server.database.write(lasting=False) as session:
            dataset = queries.one(session, Dataset, dataset_id, principal, lock=True)
            if dataset.state not in (UPLOADING, INVALID) or dataset.folder is not None:
                raise Problem(
                    "conflict", f"the dataset is {dataset.state} and takes no files", "make another one"
                )
            upload = find(session, dataset_id, path)
            _check_room(server, session, principal, wanted, upload)
            if upload is None:
                upload = Upload(id=new_id("up"), dataset_id=dataset_id, path=path, length=wanted.length)
                session.add(upload)
            streams = _open(server, upload, wanted)
            upload.length, dataset.updated, dataset.state = wanted.length, now(), UPLOADING
            if wanted.offset == 0:
                upload.complete, upload.sha256 = False, None
    except BaseException:
        for stream in streams:
            stream.close()
        raise
    *replaced, stream = streams
    for old in replaced:
        Path(old.name).unlink(missing_ok=True)
        old.close()
    return upload, stream


def _check_room(
    server: Server, session: Session, principal: Principal, wanted: Piece, upload: Upload | None
) -> None:
    limits = server.settings.limits
    if wanted.length > limits.upload_bytes:
        raise Problem("too-large", f"a file may have {limits.upload_bytes} bytes", limit=limits.upload_bytes)
    known = 0 if upload is None else upload.length
    quota.check(server.database, session, principal.owner, limits, wanted.length - known, upload is None)
    if lack := disk_space.lacking(
        server.paths.root, limits.disk_reserve_bytes + wanted.length - wanted.offset
    ):
        raise Problem("disk-full", f"the disk cannot hold the file: {lack}")


def _open(server: Server, upload: Upload, wanted: Piece) -> list[BinaryIO]:
    """The file; before it, if the request begins anew, the one that it replaces. Nobody else adds to either."""
    # only what is begun anew may change its length: the rest of an upload belongs to what is there
    if wanted.offset and upload.length != wanted.length:
        raise Problem("conflict", f"the file was begun with {upload.length} bytes", "begin anew at offset 0")
    stream = file_upload.opened(server.paths.upload(upload.dataset_id, upload.id), wanted)
    if wanted.offset or not os.fstat(stream.fileno()).st_size:
        return [stream]
    # another content is another file: the old one stays whole until the record names the new one, power cut or not
    upload.id = new_id("up")
    try:
        return [stream, file_upload.opened(server.paths.upload(upload.dataset_id, upload.id), wanted)]
    except BaseException:
        stream.close()
        raise


def end(server: Server, upload: Upload, wanted: Piece, stream: BinaryIO, received: int) -> Upload:
    """The record of a file after a piece of it has come; complete if that was the last, and all of it is right.

    Raises Problem: it is not what Repr-Digest says: it begins anew; it was removed meanwhile.
    """
    digest = None
    if received == wanted.length:
        digest = file_upload.sha256(Path(stream.name))
        if wanted.repr_digest not in (None, digest):
            file_upload.cut(stream, 0)
            raise Problem(
                "digest-mismatch",
                "the file is not what Repr-Digest says: it begins anew",
                headers={"Upload-Offset": "0"},
            )
    with server.database.write() as session:
        record = _settled(session, upload)
        if digest:
            record.complete, record.sha256 = True, digest.hex()
    return record


def settle(server: Server, upload: Upload) -> None:
    """Have the record of an upload, which a client is about to be told of, on the disk.

    Raises Problem: it was removed meanwhile.
    """
    with server.database.write() as session:
        _settled(session, upload)


def _settled(session: Session, upload: Upload) -> Upload:
    record = session.get(Upload, upload.id)
    if record is None:
        raise Problem("not-found", "the upload was removed meanwhile")
    # a transaction waits for the disk only if it changes something
    session.execute(update(Dataset).where(Dataset.id == record.dataset_id).values(updated=now()))
    return record
