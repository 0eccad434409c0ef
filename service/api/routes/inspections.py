"""What is in a bag, by a few pieces of it, before it is uploaded."""

import tempfile
import threading
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request
from starlette.concurrency import run_in_threadpool

from service.api.context import Context, Submitter
from service.api.process_answers import answer_of, body_of
from service.datasets import file_names, inspection_process
from service.problems import Problem, too_slow

router = APIRouter(prefix="/v1", tags=["uploads"])
_AT_ONCE = threading.BoundedSemaphore(2)


@router.post("/inspections", openapi_extra=body_of("application/octet-stream"))
async def look(
    request: Request,
    server: Context,
    principal: Submitter,
    name: Annotated[str, Query(max_length=200)] = "bag",
) -> dict[str, Any]:
    """What `lvba inspect` finds in a bag of which pieces are sent; pieces that it needs beside them. Nothing is kept."""
    with tempfile.TemporaryDirectory(prefix="lvba-inspection-") as folder:
        body = Path(folder) / ".body"
        with body.open("wb") as file:
            received = 0
            async for piece in request.stream():
                received += file.write(piece)
        if received < int(request.headers.get("content-length", "0")):
            raise too_slow()
        largest = str(server.settings.limits.upload_bytes)
        arguments = [folder, file_names.plain(name, "bag"), str(body), largest]
        # only now: a client that sends slowly keeps none from being looked at
        if not _AT_ONCE.acquire(blocking=False):
            raise Problem("unavailable", "other bags are being looked at", headers={"Retry-After": "2"})
        try:
            return await run_in_threadpool(
                answer_of,
                inspection_process.__name__,
                arguments,
                inspection_process.SECONDS,
                Problem("invalid", "the bag could not be looked at by pieces", "upload it as it is"),
            )
        finally:
            _AT_ONCE.release()
