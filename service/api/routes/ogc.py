"""OGC API - Processes, part 1: the same jobs under the words of that standard."""

from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query, Request, Response
from pydantic import ValidationError
from sqlalchemy import select
from starlette.responses import JSONResponse

from service.api import file_responses, options_schema, queries, serializers
from service.api.context import Context, Reader, Submitter
from service.api.routes import jobs as native
from service.api.schemas import Execution, NewJob
from service.db.tables import CANCELED, CANCELING, DONE, ENDED, FAILED, QUEUED, RUNNING, Job
from service.jobs import results as made
from service.problems import Problem, first_errors
from service.system.paths import now

router = APIRouter(tags=["OGC API - Processes"])
_BASE = "http://www.opengis.net/spec/ogcapi-processes-1/1.0/"
CLASSES = [
    f"{_BASE}conf/{name}" for name in ("core", "ogc-process-description", "json", "job-list", "dismiss")
]
_WORDS = {QUEUED: "accepted", RUNNING: "running", CANCELING: "running"}
_WORDS |= {DONE: "successful", FAILED: "failed", CANCELED: "dismissed"}
_JSON = "application/json"
_EXCEPTIONS = "http://www.opengis.net/def/exceptions/ogcapi-processes-1/1.0/"
Words = Literal["accepted", "running", "successful", "failed", "dismissed"]


def landing(request: Request) -> JSONResponse:
    """What there is, as links."""
    links = [
        _link("/", "self", _JSON, "this document"),
        _link("/openapi.json", "service-desc", "application/vnd.oai.openapi+json;version=3.0", "the API"),
        _link("/docs", "service-doc", "text/html", "the API, to be read"),
        _link("/conformance", "http://www.opengis.net/def/rel/ogc/1.0/conformance", _JSON, "conformance"),
        _link("/processes", "http://www.opengis.net/def/rel/ogc/1.0/processes", _JSON, "processes"),
        _link("/jobs", "http://www.opengis.net/def/rel/ogc/1.0/job-list", _JSON, "jobs"),
    ]
    return JSONResponse(
        {"title": "lvba", "description": _summary()["description"], "links": _absolute(links, request)}
    )


def _link(href: str, rel: str, kind: str, title: str) -> dict[str, str]:
    return {"href": href, "rel": rel, "type": kind, "title": title}


def _absolute(links: list[dict[str, str]], request: Request) -> list[dict[str, str]]:
    base = str(request.base_url).rstrip("/")
    return [{**link, "href": base + link["href"]} for link in links]


def _summary() -> dict[str, Any]:
    return {
        "id": "lvba",
        "version": "1.0.0",
        "title": "LiDAR-visual bundle adjustment",
        "description": "Refines scan poses, camera poses and exposures of a recording, and colors its map.",
        "jobControlOptions": ["async-execute", "dismiss"],
        "outputTransmission": ["reference"],
    }


@router.get("/conformance")
def conformance() -> dict[str, Any]:
    """The conformance classes that hold."""
    return {"conformsTo": CLASSES}


@router.get("/processes")
def processes(request: Request) -> dict[str, Any]:
    """There is one process."""
    links = [_link("/processes/lvba", "process", _JSON, "process description")]
    own = [_link("/processes", "self", _JSON, "this document")]
    return {
        "processes": [{**_summary(), "links": _absolute(links, request)}],
        "links": _absolute(own, request),
    }


@router.get("/processes/{process_id}")
def process(process_id: str, request: Request) -> dict[str, Any]:
    """Inputs and outputs of the process."""
    _check_process(process_id)
    outputs = {
        "map": ("colored point cloud, PLY", "application/octet-stream"),
        "lidar_poses": ("refined scan poses, TUM", "text/plain"),
        "image_poses": (
            "refined poses of the images, TUM: its first line says whether of the camera or the body",
            "text/plain",
        ),
        "exposures": ("relative exposures", "text/csv"),
        "report": ("everything that was measured", "application/json"),
    }
    links = [
        _link("/processes/lvba", "self", _JSON, "this document"),
        _link(
            "/processes/lvba/execution", "http://www.opengis.net/def/rel/ogc/1.0/execute", _JSON, "execute"
        ),
    ]
    return {
        **_summary(),
        "inputs": {
            "dataset": _input(
                "a dataset of /v1/datasets that is ready", {"type": "string", "pattern": "^ds_"}
            ),
            "config": _input("settings", options_schema.describe()["schema"], required=False),
            "import": _input(
                "how a bag is imported", options_schema.describe()["import"]["schema"], required=False
            ),
            "reference": _input(
                "compare with reference/ in the dataset", {"type": "boolean"}, required=False
            ),
        },
        "outputs": {
            name: {"title": title, "schema": {"type": "string", "contentMediaType": kind}}
            for name, (title, kind) in outputs.items()
        },
        "links": _absolute(links, request),
    }


def _input(title: str, schema: dict[str, Any], *, required: bool = True) -> dict[str, Any]:
    return {"title": title, "schema": schema, "minOccurs": int(required), "maxOccurs": 1}


def _check_process(process_id: str) -> None:
    if process_id != "lvba":
        problem = Problem("not-found", f"there is no process {process_id[:80]!r}", "there is one: lvba")
        problem.more["type"] = _EXCEPTIONS + "no-such-process"
        raise problem


@router.post("/processes/{process_id}/execution", status_code=201)
def execute(
    process_id: str,
    body: Execution,
    request: Request,
    response: Response,
    server: Context,
    principal: Submitter,
) -> dict[str, Any]:
    """Queue a run; it is always asynchronous."""
    _check_process(process_id)
    try:
        wanted = NewJob.model_validate(body.inputs)
    except ValidationError as error:
        errors = first_errors([{**one, "loc": ("inputs", *one["loc"])} for one in error.errors()])
        raise Problem("invalid", f"{errors[0]['where']}: {errors[0]['message']}", errors=errors) from None
    job_id = native.submit(wanted, server, principal, response)["id"]
    response.headers["Location"] = f"{str(request.base_url).rstrip('/')}/jobs/{job_id}"
    response.headers["Preference-Applied"] = "respond-async"
    response.status_code = 201
    with server.database.read() as session:
        return _status(queries.one(session, Job, job_id, principal), request)


@router.get("/jobs")
def jobs(
    request: Request,
    server: Context,
    principal: Reader,
    status: Annotated[list[Words] | None, Query()] = None,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
) -> dict[str, Any]:
    """All jobs of the owner."""
    wanted = select(Job).where(Job.owner == principal.owner, Job.deleted.is_(False), Job.hidden.is_(False))
    if status is not None:
        wanted = wanted.where(Job.state.in_([own for own, word in _WORDS.items() if word in status]))
    with server.database.read() as session:
        rows, _ = queries.page(session, Job, wanted, limit, None)
    own = [_link("/jobs", "self", _JSON, "this document")]
    return {"jobs": [_status(row, request) for row in rows], "links": _absolute(own, request)}


@router.get("/jobs/{job_id}")
def status(job_id: str, request: Request, server: Context, principal: Reader) -> dict[str, Any]:
    """The state of a job."""
    with server.database.read() as session:
        return _status(queries.one(session, Job, job_id, principal), request)


def _status(row: Job, request: Request) -> dict[str, Any]:
    links = [
        _link(f"/jobs/{row.id}", "self", _JSON, "this document"),
        _link(f"/v1/jobs/{row.id}", "alternate", _JSON, "the job with everything"),
        _link(f"/v1/jobs/{row.id}/logs", "runlog", _JSON, "log"),
    ]
    if row.state == DONE:
        results = "http://www.opengis.net/def/rel/ogc/1.0/results"
        links.append(_link(f"/jobs/{row.id}/results", results, _JSON, "results"))
    running = next((stage["name"] for stage in row.stages if stage["state"] == "running"), "")
    fields = {
        "jobID": row.id,
        "id": row.id,
        "processID": "lvba",
        "type": "process",
        "status": _WORDS[row.state],
        "message": (row.error or {}).get("cause") or running or row.state,
        "progress": int(row.progress * 100),
        **{
            name: serializers.time(getattr(row, name))
            for name in ("created", "started", "finished", "updated")
        },
        "links": _absolute(links, request),
    }
    return {name: value for name, value in fields.items() if value is not None}


@router.delete("/jobs/{job_id}")
def dismiss(job_id: str, request: Request, server: Context, principal: Submitter) -> dict[str, Any]:
    """Cancel a job that has not ended; take one that has from this list."""
    with server.database.read() as session:
        row = queries.one(session, Job, job_id, principal)
    if row.state in ENDED:
        with server.database.write() as session:
            row = queries.one(session, Job, job_id, principal, lock=True)
            row.hidden, row.updated = True, now()
    else:
        native.cancel_job(server, principal, job_id)
        with server.database.read() as session:
            row = queries.one(session, Job, job_id, principal)
    return {**_status(row, request), "status": "dismissed"}


@router.get("/jobs/{job_id}/results")
def results(job_id: str, request: Request, server: Context, principal: Reader) -> dict[str, Any]:
    """Links to what the job made."""
    with server.database.read() as session:
        row = queries.one(session, Job, job_id, principal)
        there = made.of_job(session, job_id, server.paths.out(job_id))
    if row.state == FAILED:
        raise Problem("conflict", (row.error or {}).get("cause") or "the job failed", job_id=job_id)
    if row.state != DONE:
        problem = Problem("not-found", f"the job is {_WORDS[row.state]}", "wait until it is successful")
        problem.more["type"] = _EXCEPTIONS + "result-not-ready"
        raise problem
    names = {
        "map": "map.ply",
        "lidar_poses": "lidar_poses.txt",
        "image_poses": "image_poses.txt",
        "exposures": "exposures.csv",
        "report": "report.json",
    }
    base = str(request.base_url).rstrip("/")
    return {
        output: {"href": f"{base}/v1/jobs/{job_id}/results/{name}", "type": file_responses.media_type(name)}
        for output, name in names.items()
        if name in there
    }
