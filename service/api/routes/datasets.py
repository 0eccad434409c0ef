"""Datasets: made, listed, looked into, removed."""

import json
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Query, Response
from sqlalchemy import func, select
from sqlalchemy.orm import Session
from starlette.responses import FileResponse

from lvba.errors import InputError
from lvba.io import bags
from service.api import file_responses, queries, serializers
from service.api.context import Context, Reader, Server, Submitter
from service.api.schemas import NewDataset
from service.datasets import file_names, inspections, quota, recording_roots
from service.db.tables import ENDED, INVALID, READY, UPLOADING, VALIDATING, Dataset, Job, Upload
from service.problems import Problem
from service.system import store_urls
from service.system.paths import new_id, now

router = APIRouter(prefix="/v1/datasets", tags=["datasets"])
Limit = Annotated[int, Query(ge=1, le=500)]
Cursor = Annotated[str | None, Query(max_length=200, pattern=r"^[^\x00]*$")]


@router.post("", status_code=201)
def create(body: NewDataset, server: Context, principal: Submitter, response: Response) -> dict[str, Any]:
    """Make a dataset: empty, to be uploaded to, or of a folder on the server or in an object store."""
    folder = None if body.folder is None else _registered(server, body.folder)
    row = Dataset(
        id=new_id("ds"),
        owner=principal.owner,
        name=body.name,
        state=UPLOADING if folder is None else VALIDATING,
        folder=folder,
        created=now(),
        updated=now(),
    )
    with server.database.write() as session:
        quota.check(server.database, session, principal.owner, server.settings.limits, 0, 1)
        session.add(row)
        session.flush()
        answer = serializers.dataset(session, row, server.paths, server.settings)
    server.supervisor.wake()
    response.headers["Location"] = f"/v1/datasets/{row.id}"
    return answer


def _registered(server: Server, folder: str) -> str:
    """The folder without links, or the URL, if it may be registered."""
    if store_urls.is_url(folder):
        url = store_urls.below_roots(folder, server.settings.roots)
        if url is None:
            raise Problem(
                "forbidden", "the URL is not below a root of this server", "see `roots` of /v1/info"
            )
        return url
    path = Path(folder)
    resolved = path.resolve()
    below = any(resolved.is_relative_to(root) for root in recording_roots.roots(server.settings))
    if not path.is_absolute() or not below:
        # whether it exists is nobody's business outside the roots
        raise Problem("forbidden", "the folder is not below a root of this server", "see `roots` of /v1/info")
    bag = resolved.is_file() and bool(bags.kind_of_name(resolved.name))
    if not resolved.is_dir() and not bag:
        raise Problem("invalid", "there is no such folder or bag", "name the folder of a recording, or a bag")
    return str(resolved)


@router.get("")
def listed(server: Context, principal: Reader, limit: Limit = 50, cursor: Cursor = None) -> dict[str, Any]:
    """All datasets of the owner."""
    wanted = select(Dataset).where(Dataset.owner == principal.owner, Dataset.deleted.is_(False))
    with server.database.read() as session:
        rows, more = queries.page(session, Dataset, wanted, limit, cursor)
        return {
            "items": [serializers.dataset(session, row, server.paths, server.settings) for row in rows],
            "next": more,
        }


@router.get("/{dataset_id}")
def read(dataset_id: str, server: Context, principal: Reader) -> dict[str, Any]:
    """One dataset."""
    with server.database.read() as session:
        return serializers.dataset(
            session, queries.one(session, Dataset, dataset_id, principal), server.paths, server.settings
        )


@router.delete("/{dataset_id}", status_code=204)
def remove(dataset_id: str, server: Context, principal: Submitter) -> None:
    """Remove a dataset. What was registered stays where it lies."""
    with server.database.write() as session:
        row = queries.one(session, Dataset, dataset_id, principal, lock=True)
        if row.lease_owner is not None:
            raise Problem("conflict", "it is being checked", "try again when it is ready or invalid")
        waiting = select(func.count()).where(Job.dataset_id == row.id, Job.state.not_in(ENDED))
        if session.scalar(waiting):
            raise Problem("conflict", "jobs that need it wait or run", "cancel them first")
        row.deleted = True
    server.supervisor.sweep()


@router.post("/{dataset_id}/finish", status_code=202)
def finish(dataset_id: str, server: Context, principal: Submitter) -> dict[str, Any]:
    """All is uploaded: unpack and check it."""
    with server.database.write() as session:
        row = queries.one(session, Dataset, dataset_id, principal, lock=True)
        if row.state in (UPLOADING, INVALID):
            _begin_check(session, row)
        answer = serializers.dataset(session, row, server.paths, server.settings)
    server.supervisor.wake()
    return answer


def _begin_check(session: Session, row: Dataset) -> None:
    uploads = session.scalars(select(Upload).where(Upload.dataset_id == row.id)).all()
    if row.folder is None and not uploads:
        raise Problem("conflict", "nothing was uploaded", "upload the files first")
    missing = [upload.path or "the archive" for upload in uploads if not upload.complete]
    if missing:
        raise Problem("conflict", f"{len(missing)} files are not complete", missing=missing[:100])
    row.state, row.error, row.updated = VALIDATING, None, now()


@router.get("/{dataset_id}/files")
def files(
    dataset_id: str, server: Context, principal: Reader, limit: Limit = 50, cursor: Cursor = None
) -> dict[str, Any]:
    """What was uploaded."""
    with server.database.read() as session:
        row = queries.one(session, Dataset, dataset_id, principal)
        wanted = (
            select(Upload)
            .where(Upload.dataset_id == row.id, Upload.path > (cursor or ""))
            .order_by(Upload.path)
            .limit(limit + 1)
        )
        uploads = session.scalars(wanted).all()
    items = [upload_shown(server, upload) for upload in uploads[:limit]]
    return {"items": items, "next": uploads[limit - 1].path if len(uploads) > limit else None}


def upload_shown(server: Server, upload: Upload) -> dict[str, Any]:
    """A file that is arriving."""
    arrived = server.paths.upload(upload.dataset_id, upload.id)
    there = arrived.stat().st_size if arrived.exists() else 0
    return {
        "path": upload.path,
        "received": upload.length if upload.complete else there,
        "length": upload.length,
        "complete": upload.complete,
        "sha256": upload.sha256,
    }


@router.get("/{dataset_id}/inspection")
def inspection(dataset_id: str, server: Context, principal: Reader) -> dict[str, Any]:
    """What the check found in a bag: topics, clocks, what is missing, and files beside it."""
    with server.database.read() as session:
        row = queries.one(session, Dataset, dataset_id, principal)
    if row.state != READY:
        raise Problem("not-ready", f"the dataset is {row.state}", "wait until it is ready")
    kept = inspections.read(server.paths, row.id)
    if kept is None:
        raise Problem("not-found", "the dataset is a recording, and needs no import", "run it as it is")
    return kept


@router.get("/{dataset_id}/frames")
def frames(dataset_id: str, server: Context, principal: Reader) -> dict[str, Any]:
    """The images, in the order of their poses."""
    with server.database.read() as session:
        row = queries.one(session, Dataset, dataset_id, principal)
    return {"items": frames_of(server, row)}


def frames_of(server: Server, row: Dataset) -> list[dict[str, Any]]:
    """Index, time, path and URL of each image.

    Raises Problem: they are not known yet.
    """
    known = server.paths.frames(row.id)
    if row.state != READY or not known.exists():
        raise Problem("not-ready", f"the dataset is {row.state}", "wait until it is ready")
    frames: list[dict[str, Any]] = json.loads(known.read_text())
    return [
        {**frame, "url": f"/v1/datasets/{row.id}/files/{file_responses.quoted(frame['path'])}"}
        for frame in frames
    ]


@router.get("/{dataset_id}/files/{path:path}", response_class=FileResponse)
def file(dataset_id: str, path: str, server: Context, principal: Reader) -> FileResponse:
    """One file of a dataset that is ready."""
    with server.database.read() as session:
        row = queries.one(session, Dataset, dataset_id, principal)
    if row.state != READY:
        raise Problem("not-ready", f"the dataset is {row.state}", "wait until it is ready")
    root = server.paths.recording(row.id, row.folder)
    try:
        opened = file_names.opened(root, path)
    except InputError as error:
        raise Problem("not-found", f"{error.where}: {error.problem}", error.mend) from None
    return file_responses.FileOf(opened, path, strange=True)
