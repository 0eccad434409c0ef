"""Uploads: pieces of files, and of archives."""

from contextlib import suppress
from typing import Annotated, Any

from fastapi import APIRouter, Path, Request, Response
from sqlalchemy import delete
from starlette.concurrency import run_in_threadpool

from lvba.errors import InputError
from lvba.io.files import sync
from service.api import queries, upload_record
from service.api.context import Context, Server, Submitter
from service.api.routes.datasets import upload_shown
from service.datasets import file_names, file_upload
from service.db.keys import Principal
from service.db.tables import INVALID, UPLOADING, Dataset, Upload
from service.problems import Problem, of_input

router = APIRouter(prefix="/v1/datasets", tags=["uploads"])
ARCHIVE = ""
"""Path of the archive among the uploads of a dataset."""
FilePath = Annotated[str, Path(max_length=800)]
_BODY = {
    "requestBody": {
        "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}
    },
    "parameters": [
        {"name": name, "in": "header", "required": False, "schema": {"type": kind}}
        for name, kind in (
            *(("Upload-Offset", "integer"), ("Upload-Length", "integer")),
            *(("Content-Digest", "string"), ("Repr-Digest", "string")),
        )
    ],
}


@router.put("/{dataset_id}/files/{path:path}", openapi_extra=_BODY)
async def put_file(
    dataset_id: str,
    path: FilePath,
    request: Request,
    server: Context,
    principal: Submitter,
    response: Response,
) -> dict[str, Any]:
    """A file, or a piece of it, as raw bytes."""
    return await _put(server, principal, dataset_id, _checked(path), request, response)


@router.put("/{dataset_id}/archive", openapi_extra=_BODY)
async def put_archive(
    dataset_id: str, request: Request, server: Context, principal: Submitter, response: Response
) -> dict[str, Any]:
    """An archive, or a piece of it, as raw bytes."""
    return await _put(server, principal, dataset_id, ARCHIVE, request, response)


async def _put(
    server: Server, principal: Principal, dataset_id: str, path: str, request: Request, response: Response
) -> dict[str, Any]:
    wanted = file_upload.piece(request.headers)
    place = f"{principal.owner}/{dataset_id}/{path}"
    async with server.active_uploads.begin(place, principal.key_id) as active:
        upload, stream = await run_in_threadpool(
            upload_record.begin, server, principal, dataset_id, path, wanted
        )
        # held until the record says what the file is: nobody else changes it while its digest is taken
        with stream:
            reserve = server.settings.limits.disk_reserve_bytes
            received = await file_upload.receive(stream, wanted, active.of(request.stream()), reserve)
            upload = await run_in_threadpool(upload_record.end, server, upload, wanted, stream, received)
    response.status_code = 201 if upload.complete else 200
    response.headers["Upload-Offset"] = str(received)
    return upload_shown(server, upload)


@router.head("/{dataset_id}/files/{path:path}")
def head_file(dataset_id: str, path: FilePath, server: Context, principal: Submitter) -> Response:
    """How much of a file has arrived."""
    return _head(server, principal, dataset_id, _checked(path))


@router.head("/{dataset_id}/archive")
def head_archive(dataset_id: str, server: Context, principal: Submitter) -> Response:
    """How much of the archive has arrived."""
    return _head(server, principal, dataset_id, ARCHIVE)


def _head(server: Server, principal: Principal, dataset_id: str, path: str) -> Response:
    upload = _find(server, principal, dataset_id, path)
    record = upload_shown(server, upload)
    if not upload.complete:
        # what is said to be there may be forgotten by the client: also if the request that brings it is not answered yet
        with suppress(FileNotFoundError):
            sync(server.paths.upload(dataset_id, upload.id))
        upload_record.settle(server, upload)
    headers = {
        "Upload-Offset": str(record["received"]),
        "Upload-Length": str(record["length"]),
        "Upload-Complete": "?1" if record["complete"] else "?0",
        "Cache-Control": "no-store",
    }
    return Response(headers=headers | ({"Upload-Digest": record["sha256"]} if record["complete"] else {}))


def _find(server: Server, principal: Principal, dataset_id: str, path: str) -> Upload:
    with server.database.read() as session:
        queries.one(session, Dataset, dataset_id, principal)
        upload = upload_record.find(session, dataset_id, path)
    if upload is None:
        raise Problem("not-found", "nothing of this file has arrived")
    return upload


@router.delete("/{dataset_id}/files/{path:path}", status_code=204)
def delete_file(dataset_id: str, path: FilePath, server: Context, principal: Submitter) -> None:
    """Forget a file."""
    _forget(server, principal, dataset_id, _checked(path))


@router.delete("/{dataset_id}/archive", status_code=204)
def delete_archive(dataset_id: str, server: Context, principal: Submitter) -> None:
    """Forget the archive."""
    _forget(server, principal, dataset_id, ARCHIVE)


def _forget(server: Server, principal: Principal, dataset_id: str, path: str) -> None:
    upload = _find(server, principal, dataset_id, path)
    with server.database.write() as session:
        dataset = queries.one(session, Dataset, dataset_id, principal, lock=True)
        if dataset.state not in (UPLOADING, INVALID):
            raise Problem("conflict", f"the dataset is {dataset.state}", "what is checked stays as it is")
        session.execute(delete(Upload).where(Upload.id == upload.id))
    server.paths.upload(dataset_id, upload.id).unlink(missing_ok=True)


def _checked(path: str) -> str:
    try:
        return file_names.checked(path)
    except InputError as error:
        raise of_input(error) from None
