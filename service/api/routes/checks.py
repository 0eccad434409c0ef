"""Whether a recording can be read, as far as names and small texts tell, before it is uploaded."""

import json
import subprocess
import sys
import tempfile
import threading
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request
from starlette.concurrency import run_in_threadpool

from lvba.errors import InputError
from service.api.context import Context, Submitter
from service.datasets import file_names, names_process
from service.problems import Problem

router = APIRouter(prefix="/v1", tags=["uploads"])
_AT_ONCE = threading.BoundedSemaphore(2)
_BODY = {
    "requestBody": {
        "content": {"application/x-ndjson": {"schema": {"type": "string", "format": "binary"}}},
        "required": True,
    }
}


@router.post("/checks", openapi_extra=_BODY)
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
            words = [sys.executable, "-m", names_process.__name__, folder, _plain(name), str(most)]
            done = subprocess.run(words, input=body, capture_output=True, timeout=names_process.SECONDS)
    except subprocess.TimeoutExpired:
        done = None
    finally:
        _AT_ONCE.release()
    if done is None or done.returncode != 0:
        raise Problem("invalid", "the list of files could not be looked at", "upload the recording as it is")
    answer: dict[str, Any] = json.loads(done.stdout)
    return answer


def _plain(name: str) -> str:
    """The name of the folder, which the reader may say something about; another one where it cannot be one."""
    try:
        return file_names.checked(name) if "/" not in name else "recording"
    except InputError:
        return "recording"
