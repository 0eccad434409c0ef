"""Whether a recording can be read, as far as names and small texts tell, before it is uploaded."""

import tempfile
import threading
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request
from starlette.concurrency import run_in_threadpool

from lvba.errors import InputError
from service.api.context import Context, Submitter
from service.api.process_answers import answer_of, body_of
from service.datasets import file_names, names_process
from service.problems import Problem

router = APIRouter(prefix="/v1", tags=["uploads"])
_AT_ONCE = threading.BoundedSemaphore(2)


@router.post("/checks", openapi_extra=body_of("application/x-ndjson"))
async def check(
    request: Request,
    server: Context,
    principal: Submitter,
    name: Annotated[str, Query(max_length=200)] = "recording",
) -> dict[str, Any]:
    """What is wrong with a recording of these files: a JSON object a line, {"path", "text"?}, with the text of poses and
    calibration. Nothing is kept."""
    body = await request.body()
    return await run_in_threadpool(_checked, body, name, server.settings.limits.owner_files)


def _checked(body: bytes, name: str, most: int) -> dict[str, Any]:
    if not _AT_ONCE.acquire(blocking=False):
        raise Problem("unavailable", "other recordings are being looked at", headers={"Retry-After": "2"})
    try:
        with tempfile.TemporaryDirectory(prefix="lvba-names-") as folder:
            return answer_of(
                names_process.__name__,
                [folder, _plain(name), str(most)],
                names_process.SECONDS,
                Problem(
                    "invalid", "the list of files could not be looked at", "upload the recording as it is"
                ),
                given=body,
            )
    finally:
        _AT_ONCE.release()


def _plain(name: str) -> str:
    """The name of the folder, which the reader may say something about; another one where it cannot be one."""
    try:
        return file_names.checked(name) if "/" not in name else "recording"
    except InputError:
        return "recording"
