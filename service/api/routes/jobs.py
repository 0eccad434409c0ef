"""Jobs: submitted, watched, canceled, begun anew, removed."""

from typing import Annotated, Any, Literal

from fastapi import APIRouter, Header, Query, Response
from sqlalchemy import select
from sqlalchemy.exc import IntegrityError

from service.api import queries, serializers, submission
from service.api.context import Context, Reader, Server, Submitter
from service.api.routes.datasets import Cursor, Limit
from service.api.schemas import ChangedJob, NewJob, Restart
from service.db import journal
from service.db.keys import Principal
from service.db.tables import (
    CANCELED,
    CANCELING,
    DONE,
    ENDED,
    FAILED,
    QUEUED,
    RUNNING,
    Dataset,
    Delivery,
    Job,
)
from service.jobs.run_events import IMPORT, VIEWER
from service.problems import Problem
from service.system.paths import now

router = APIRouter(prefix="/v1", tags=["jobs"])
IdempotencyKey = Annotated[str | None, Header(max_length=200, pattern=r"^[^\x00]+$")]
Id = Annotated[str | None, Query(max_length=60, pattern=r"^[a-z]+_[0-9a-f]+$")]
_ALWAYS = (IMPORT, "input", "write", VIEWER)
"""Stages that cannot be asked for."""
State = Literal["queued", "running", "canceling", "done", "failed", "canceled"]


@router.post("/jobs", status_code=201)
def submit(
    body: NewJob,
    server: Context,
    principal: Submitter,
    response: Response,
    idempotency_key: IdempotencyKey = None,
) -> dict[str, Any]:
    """Ask for a run."""
    known = _known(server, principal, body, idempotency_key)
    if known is None:
        try:
            with server.database.write() as session:
                job = submission.queue(server, session, principal, body, key=idempotency_key)
        except IntegrityError:
            # the same request came twice at once, and the other one was faster
            known = _known(server, principal, body, idempotency_key)
            if known is None:
                raise
    if known is not None:
        job, response.status_code = known, 200
    server.supervisor.wake()
    response.headers["Location"] = f"/v1/jobs/{job.id}"
    return _shown(server, principal, job.id)


def _known(server: Server, principal: Principal, body: NewJob, key: str | None) -> Job | None:
    """The job that this key made before."""
    if key is None:
        return None
    with server.database.read() as session:
        wanted = select(Job).where(Job.owner == principal.owner, Job.idempotency_key == key)
        job = session.scalars(wanted).one_or_none()
    if job is not None and job.request_digest != submission.request_digest(body):
        raise Problem("invalid", "the Idempotency-Key was used for another request", "choose another one")
    if job is not None and job.deleted:
        raise Problem("invalid", "the job of this Idempotency-Key was removed", "choose another one")
    return job


def _shown(server: Server, principal: Principal, job_id: str) -> dict[str, Any]:
    with server.database.read() as session:
        row = queries.one(session, Job, job_id, principal)
        return serializers.job(session, row, server.paths, server.settings)


@router.post("/estimates")
def estimate(body: NewJob, server: Context, principal: Submitter) -> dict[str, Any]:
    """What a run would take; nothing is queued."""
    with server.database.read() as session:
        fields = submission.estimate(server, session, principal, body)
    return {name: value for name, value in fields.items() if name != "plain"}


@router.get("/jobs")
def listed(
    server: Context,
    principal: Reader,
    state: State | None = None,
    dataset: Id = None,
    batch: Id = None,
    limit: Limit = 50,
    cursor: Cursor = None,
) -> dict[str, Any]:
    """All jobs of the owner."""
    wanted = select(Job).where(Job.owner == principal.owner, Job.deleted.is_(False))
    for column, value in ((Job.state, state), (Job.dataset_id, dataset), (Job.batch_id, batch)):
        wanted = wanted if value is None else wanted.where(column == value)
    with server.database.read() as session:
        rows, more = queries.page(session, Job, wanted, limit, cursor)
        return {"items": serializers.jobs(session, rows, server.paths, server.settings), "next": more}


@router.get("/jobs/{job_id}")
def read(job_id: str, server: Context, principal: Reader) -> dict[str, Any]:
    """One job with its stages and attempts."""
    return _shown(server, principal, job_id)


@router.patch("/jobs/{job_id}")
def change(job_id: str, body: ChangedJob, server: Context, principal: Submitter) -> dict[str, Any]:
    """Change name, priority or how long it is kept."""
    with server.database.write() as session:
        job = queries.one(session, Job, job_id, principal, lock=True)
        for name, value in body.model_dump(exclude_unset=True).items():
            if value is not None or name == "keep_days":
                setattr(job, name, value)
        job.updated = now()
    return _shown(server, principal, job_id)


@router.delete("/jobs/{job_id}", status_code=204)
def remove(job_id: str, server: Context, principal: Submitter) -> None:
    """Remove an ended job with its files."""
    with server.database.write() as session:
        job = queries.one(session, Job, job_id, principal, lock=True)
        if job.state not in ENDED:
            raise Problem("conflict", f"the job is {job.state}", "cancel it first")
        job.deleted = True
    server.supervisor.sweep()


@router.post("/jobs/{job_id}/cancel", status_code=202)
def cancel(job_id: str, server: Context, principal: Submitter) -> dict[str, Any]:
    """Stop a job. What is finished of it stays."""
    cancel_job(server, principal, job_id)
    return _shown(server, principal, job_id)


def cancel_job(server: Server, principal: Principal, job_id: str) -> None:
    """Stop a job; once more does no harm.

    Raises Problem: it has ended by itself.
    """
    with server.database.write() as session:
        job = queries.one(session, Job, job_id, principal, lock=True)
        if job.state in (DONE, FAILED):
            raise Problem("conflict", f"the job is {job.state}", "there is nothing to cancel")
        if job.state in (QUEUED, RUNNING):
            job.state = CANCELED if job.state == QUEUED else CANCELING
            job.finished = now() if job.state == CANCELED else None
            server.database.order_events(session)
            journal.state(session, job)
    server.supervisor.wake()


@router.post("/jobs/{job_id}/restart", status_code=202)
def restart(
    job_id: str, server: Context, principal: Submitter, body: Restart | None = None
) -> dict[str, Any]:
    """Run an ended job again, from a stage or with other settings; what can be kept of it is kept."""
    wanted = body or Restart()
    if wanted.config is not None:
        submission.check_config(wanted.config)
    with server.database.write() as session:
        job = queries.one(session, Job, job_id, principal, lock=True)
        if job.state not in ENDED:
            raise Problem("conflict", f"the job is {job.state}", "cancel it first, or wait")
        if wanted.import_ is not None:
            submission.check_import(server, session.get_one(Dataset, job.dataset_id), wanted.import_)
            job.import_options = wanted.import_
        _check_stage(job, wanted.from_stage)
        submission.check_restart(server, session, job)
        job.redo = wanted.from_stage
        job.config = job.config if wanted.config is None else wanted.config
        job.state, job.error, job.summary, job.finished, job.started = QUEUED, None, None, None, None
        job.crashes = job.losses = 0
        job.progress, job.eta_s = 0.0, None
        server.database.order_events(session)
        journal.state(session, job)
    server.supervisor.wake()
    return _shown(server, principal, job_id)


def _check_stage(job: Job, stage: str | None) -> None:
    # they are done anew each time anyway, or, as an import, kept for as long as they fit
    known = [record["name"] for record in job.stages if record["name"] not in _ALWAYS]
    if stage is not None and stage not in known:
        raise Problem(
            "invalid", f"the job has no stage {stage!r}", f"one of these: {', '.join(known) or '(none yet)'}"
        )


@router.get("/jobs/{job_id}/deliveries")
def deliveries(job_id: str, server: Context, principal: Reader) -> dict[str, Any]:
    """What was told to the webhook of a job."""
    with server.database.read() as session:
        queries.one(session, Job, job_id, principal)
        rows = session.scalars(
            select(Delivery).where(Delivery.job_id == job_id).order_by(Delivery.created)
        ).all()
    items = [
        {
            "id": row.id,
            "created": serializers.time(row.created),
            "status": row.status,
            "tries": row.tries,
            "message": row.message,
            "next_try": serializers.time(row.next_try),
        }
        for row in rows
    ]
    return {"items": items, "next": None}
