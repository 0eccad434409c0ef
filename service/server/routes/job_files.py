"""What a job says and makes: events, log, results."""

import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Header, Query, Response
from starlette.responses import FileResponse, StreamingResponse

from lvba.errors import InputError
from service.server import finding, names, served, words
from service.server.context import Context, Reader, Server
from service.server.keys import Principal
from service.server.problems import Problem
from service.server.routes.datasets import frames_of
from service.server.streamed_zip import zipped
from service.server.tables import DONE, ENDED, Dataset, Job

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
    stream = server.broadcaster.stream(_cursor(last_event_id, after), None, principal.owner)
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
    stream = server.broadcaster.stream(_cursor(last_event_id, after) or 0, job_id, principal.owner)
    return StreamingResponse(stream, media_type="text/event-stream", headers=_STREAM)


def _job(server: Server, principal: Principal, job_id: str) -> Job:
    with server.database.read() as session:
        return finding.one(session, Job, job_id, principal)


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
    log = server.places.log(job_id)
    size = log.stat().st_size if log.exists() else 0
    begin = max(size + start, 0) if start < 0 else min(start, size)
    data = _read(log, begin, limit) if size else b""
    if start < 0 and begin:
        # the end of a line of which the beginning is not asked for
        begin, data = begin + data.find(b"\n") + 1, data[data.find(b"\n") + 1 :]
    whole = _whole_lines(data, all_there=ended and begin + len(data) >= size, full=len(data) == limit)
    text = words.without_paths(whole.decode("utf-8", "replace"), server.places, job_id, None)
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
    """Names, sizes and types of all results."""
    out = _out(server, principal, job_id)
    return {
        "items": [served.result_shown(job_id, out, name) for name in served.result_names(out)],
        "next": None,
    }


def _out(server: Server, principal: Principal, job_id: str) -> Any:
    job = _job(server, principal, job_id)
    if job.state != DONE:
        raise Problem("not-ready", f"the job is {job.state}", job_id=job_id)
    return server.places.out(job_id)


@router.head("/jobs/{job_id}/results/{name:path}", include_in_schema=False)
@router.get("/jobs/{job_id}/results/{name:path}", response_class=FileResponse)
def result(
    job_id: str, name: str, server: Context, principal: Reader, download: bool = False
) -> FileResponse:
    """One result."""
    out = _out(server, principal, job_id)
    try:
        file = names.below(out, name)
    except InputError:
        raise Problem("not-found", "there is no such result") from None
    hidden = name.split("/")[0] == "stages" or any(part.startswith(".") for part in name.split("/"))
    if hidden or not file.is_file():
        raise Problem("not-found", "there is no such result", "see the list of results")
    return served.FileOf(file, name, download=download)


@router.get("/jobs/{job_id}/archive", response_class=StreamingResponse)
def archive(job_id: str, server: Context, principal: Reader) -> Response:
    """All results as one zip file."""
    out = _out(server, principal, job_id)
    headers = {"Content-Disposition": f'attachment; filename="{job_id}.zip"', "Cache-Control": "no-store"}
    pieces: Iterator[bytes] = zipped(out, served.result_names(out), zipfile.ZIP_STORED)
    return StreamingResponse(pieces, media_type="application/zip", headers=headers)


@router.get("/jobs/{job_id}/frames")
def frames(job_id: str, server: Context, principal: Reader) -> dict[str, Any]:
    """Photographs, and the map rendered at their poses."""
    out = _out(server, principal, job_id)
    job = _job(server, principal, job_id)
    with server.database.read() as session:
        dataset = finding.one(session, Dataset, job.dataset_id, principal)
    there = set(served.result_names(out))
    base = f"/v1/jobs/{job_id}/results/"
    items = []
    for frame in frames_of(server, dataset):
        made = {state: f"frames/{state}/{frame['index']:06}.jpg" for state in ("photo", "before", "after")}
        urls = {state: base + name if name in there else None for state, name in made.items()}
        items.append({"index": frame["index"], "time": frame["time"], "raw": frame["url"], **urls})
    return {"items": items}
