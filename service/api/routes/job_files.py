"""What a job says and makes: events, log, results."""

import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, BinaryIO

from fastapi import APIRouter, Header, Query, Response
from starlette.responses import FileResponse, StreamingResponse

from lvba.io import files
from lvba.io.dataset import IMAGE_POSES
from service.api import file_responses, queries
from service.api.context import Context, Reader, Server
from service.api.routes.datasets import frames_of
from service.api.streamed_zip import zipped
from service.datasets import file_names
from service.db.keys import Principal
from service.db.tables import DONE, ENDED, Dataset, Job, Result
from service.jobs import results as digests
from service.problems import Problem
from service.system import messages

router = APIRouter(prefix="/v1", tags=["jobs"])
_STREAM = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
_CURSOR = 1 << 53
LastEventId = Annotated[str | None, Header(max_length=20)]
After = Annotated[int | None, Query(ge=0, le=_CURSOR)]


def _cursor(last_event_id: str | None, after: int | None) -> int | None:
    if last_event_id is None:
        return after
    if not last_event_id.isascii() or not last_event_id.isdigit():
        raise Problem("invalid", "Last-Event-ID is not the id of an event")
    return min(int(last_event_id), _CURSOR)


@router.get("/events", response_class=StreamingResponse)
async def events(
    server: Context, principal: Reader, last_event_id: LastEventId = None, after: After = None
) -> StreamingResponse:
    """What happens to all jobs of the owner, as server-sent events without end."""
    stream = server.broadcaster.stream(
        _cursor(last_event_id, after), None, principal.owner, _key(server, principal)
    )
    return StreamingResponse(stream, media_type="text/event-stream", headers=_STREAM)


@router.get("/jobs/{job_id}/events", response_class=StreamingResponse)
async def job_events(
    job_id: str,
    server: Context,
    principal: Reader,
    last_event_id: LastEventId = None,
    after: After = None,
) -> StreamingResponse:
    """What happens to one job, as server-sent events until it has ended."""
    await server.broadcaster.ask(_job, server, principal, job_id)
    stream = server.broadcaster.stream(
        _cursor(last_event_id, after) or 0, job_id, principal.owner, _key(server, principal)
    )
    return StreamingResponse(stream, media_type="text/event-stream", headers=_STREAM)


def _key(server: Server, principal: Principal) -> str | None:
    """The key that a stream hangs on."""
    return principal.key_id if server.settings.asks_for_keys else None


def _job(server: Server, principal: Principal, job_id: str) -> Job:
    with server.database.read() as session:
        return queries.one(session, Job, job_id, principal)


@router.get("/jobs/{job_id}/logs")
def logs(
    job_id: str,
    server: Context,
    principal: Reader,
    start: Annotated[int, Query(alias="from", ge=-_CURSOR, le=_CURSOR)] = 0,
    limit: Annotated[int, Query(ge=1, le=1 << 20)] = 1 << 16,
) -> dict[str, Any]:
    """Whole lines of the log from a position on."""
    ended = _job(server, principal, job_id).state in ENDED
    log = server.paths.log(job_id)
    size = log.stat().st_size if log.exists() else 0
    begin = max(size + start, 0) if start < 0 else min(start, size)
    data = _read(log, begin, limit) if size else b""
    if start < 0 and begin:
        # the end of a line of which the beginning is not asked for
        begin, data = begin + data.find(b"\n") + 1, data[data.find(b"\n") + 1 :]
    whole = _whole_lines(data, all_there=ended and begin + len(data) >= size, full=len(data) == limit)
    text = messages.without_paths(whole.decode("utf-8", "replace"), server.paths, job_id, None)
    return {"from": begin, "next": begin + len(whole), "size": size, "text": text, "ended": ended}


def _read(log: Path, begin: int, limit: int) -> bytes:
    with log.open("rb") as stream:
        stream.seek(begin)
        return stream.read(limit)


def _whole_lines(data: bytes, *, all_there: bool, full: bool) -> bytes:
    """Without the beginning of a line that is not all there yet; of one longer than can be asked for, what there is."""
    cut = data.rfind(b"\n") + 1
    return data if all_there or (full and not cut) else data[:cut]


@router.get("/jobs/{job_id}/results")
def results(job_id: str, server: Context, principal: Reader) -> dict[str, Any]:
    """Names, sizes, types and digests of all results."""
    out, made = _made(server, principal, job_id)
    items = [file_responses.result_shown(_base(job_id), out, name, row) for name, row in made.items()]
    return {"items": items, "next": None}


def _base(job_id: str) -> str:
    return f"/v1/jobs/{job_id}/results/"


def _made(server: Server, principal: Principal, job_id: str) -> tuple[Path, dict[str, Result | None]]:
    """The result folder of a job that is done, and its files."""
    with server.database.read() as session:
        job = queries.one(session, Job, job_id, principal)
        if job.state != DONE:
            raise Problem("not-ready", f"the job is {job.state}", job_id=job_id)
        out = server.paths.out(job_id)
        return out, digests.of_job(session, job_id, out)


@router.head("/jobs/{job_id}/results/{name:path}", include_in_schema=False)
@router.get("/jobs/{job_id}/results/{name:path}", response_class=FileResponse)
def result(
    job_id: str, name: str, server: Context, principal: Reader, download: bool = False
) -> FileResponse:
    """One result."""
    with server.database.read() as session:
        job = queries.one(session, Job, job_id, principal)
        if job.state != DONE:
            raise Problem("not-ready", f"the job is {job.state}", job_id=job_id)
        row = digests.one(session, job_id, name)
    file = server.results.opened(server.paths.out(job_id), name, row)
    return file_responses.FileOf(file, name, download=download, sha256=row.sha256 if row else None)


@router.get("/jobs/{job_id}/archive", response_class=StreamingResponse)
def archive(job_id: str, server: Context, principal: Reader) -> Response:
    """All results as one zip file, named after the job, in one folder of that name."""
    out, made = _made(server, principal, job_id)

    def opened(name: str) -> BinaryIO:
        return server.results.opened(out, name, made[name])

    # what is damaged is said before anything is sent; what becomes so meanwhile cuts the answer off
    for name in made:
        opened(name).close()
    folder = file_names.plain(_job(server, principal, job_id).name or "", job_id)
    headers = {"Content-Disposition": file_responses.attachment(f"{folder}.zip"), "Cache-Control": "no-store"}
    pieces: Iterator[bytes] = zipped(opened, made, zipfile.ZIP_STORED, folder)
    return StreamingResponse(pieces, media_type="application/zip", headers=headers)


@router.get("/jobs/{job_id}/frames")
def frames(job_id: str, server: Context, principal: Reader) -> dict[str, Any]:
    """Photographs, and the map rendered at their poses."""
    _, there = _made(server, principal, job_id)
    job = _job(server, principal, job_id)
    with server.database.read() as session:
        dataset = queries.one(session, Dataset, job.dataset_id, principal)
    items = []
    for frame in _imported_frames(server, job) if job.import_key else frames_of(server, dataset):
        pictures = file_responses.pictures(_base(job_id), there, frame["index"])
        name = {"name": frame["name"]} if "name" in frame else {}
        items.append(
            {"index": frame["index"], "time": frame["time"], **name, "raw": frame["url"], **pictures}
        )
    return {"items": items}


def _imported_frames(server: Server, job: Job) -> list[dict[str, Any]]:
    """Index, time and stamp of each image of the recording that a job made of a bag, where it has no URL."""
    poses = server.paths.imported(job.dataset_id, job.import_key or "") / IMAGE_POSES
    lines = files.read_text(poses).splitlines() if poses.is_file() else []
    stamps = [line.split()[0] for line in lines if line and not line.startswith("#")]
    return [
        {"index": index, "time": float(stamp), "name": stamp, "url": None}
        for index, stamp in enumerate(stamps)
    ]
