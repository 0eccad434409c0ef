"""Batches: many jobs at once, all or none."""

from collections import Counter
from typing import Any

from fastapi import APIRouter, Response
from sqlalchemy import select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from service.api import queries, serializers, submission
from service.api.context import Context, Reader, Server, Submitter
from service.api.routes.datasets import Cursor, Limit
from service.api.routes.jobs import IdempotencyKey, cancel_job
from service.api.schemas import NewBatch
from service.db.keys import Principal
from service.db.tables import ENDED, JOB_STATES, Batch, Job
from service.problems import Problem
from service.system.paths import new_id, now

router = APIRouter(prefix="/v1/batches", tags=["batches"])


@router.post("", status_code=201)
def create(
    body: NewBatch,
    server: Context,
    principal: Submitter,
    response: Response,
    idempotency_key: IdempotencyKey = None,
) -> dict[str, Any]:
    """Ask for many runs."""
    known = _known(server, principal, body, idempotency_key)
    if known is None:
        try:
            batch = _create(server, principal, body, idempotency_key)
        except IntegrityError:
            known = _known(server, principal, body, idempotency_key)
            if known is None:
                raise
    if known is not None:
        batch, response.status_code = known, 200
    server.supervisor.wake()
    response.headers["Location"] = f"/v1/batches/{batch.id}"
    with server.database.read() as session:
        return _shown(server, session, batch, with_jobs=True)


def _create(server: Server, principal: Principal, body: NewBatch, key: str | None) -> Batch:
    batch = Batch(id=new_id("bat"), owner=principal.owner, name=body.name, created=now(), idempotency_key=key)
    batch.request_digest = submission.digest(body.model_dump())
    with server.database.write() as session:
        session.add(batch)
        session.flush()
        for number, wanted in enumerate(body.jobs):
            try:
                submission.queue(server, session, principal, wanted, batch=batch)
            except Problem as problem:
                problem.more["entry"] = number
                raise
    return batch


def _known(server: Server, principal: Principal, body: NewBatch, key: str | None) -> Batch | None:
    if key is None:
        return None
    with server.database.read() as session:
        wanted = select(Batch).where(Batch.owner == principal.owner, Batch.idempotency_key == key)
        batch = session.scalars(wanted).one_or_none()
    if batch is not None and batch.request_digest != submission.digest(body.model_dump()):
        raise Problem("invalid", "the Idempotency-Key was used for another request", "choose another one")
    return batch


@router.get("")
def listed(server: Context, principal: Reader, limit: Limit = 50, cursor: Cursor = None) -> dict[str, Any]:
    """All batches of the owner."""
    wanted = select(Batch).where(Batch.owner == principal.owner)
    with server.database.read() as session:
        rows, more = queries.page(session, Batch, wanted, limit, cursor)
        return {"items": [_shown(server, session, row, with_jobs=False) for row in rows], "next": more}


@router.get("/{batch_id}")
def read(batch_id: str, server: Context, principal: Reader) -> dict[str, Any]:
    """One batch with its jobs."""
    with server.database.read() as session:
        return _shown(server, session, queries.one(session, Batch, batch_id, principal), with_jobs=True)


@router.post("/{batch_id}/cancel", status_code=202)
def cancel(batch_id: str, server: Context, principal: Submitter) -> dict[str, Any]:
    """Stop all jobs of a batch that have not ended."""
    with server.database.read() as session:
        batch = queries.one(session, Batch, batch_id, principal)
        open_jobs = [job.id for job in _jobs(session, batch) if job.state not in ENDED]
    for job_id in open_jobs:
        try:
            cancel_job(server, principal, job_id)
        except Problem as problem:
            if problem.code != "conflict":  # ended meanwhile
                raise
    with server.database.read() as session:
        return _shown(server, session, batch, with_jobs=True)


def _jobs(session: Session, batch: Batch) -> list[Job]:
    wanted = select(Job).where(Job.batch_id == batch.id, Job.deleted.is_(False)).order_by(Job.created, Job.id)
    return list(session.scalars(wanted))


def _shown(server: Server, session: Session, batch: Batch, *, with_jobs: bool) -> dict[str, Any]:
    rows = _jobs(session, batch)
    counts = Counter(row.state for row in rows)
    parts = [1.0 if row.state in ENDED else row.progress for row in rows]
    fields = {
        "id": batch.id,
        "name": batch.name,
        "created": serializers.time(batch.created),
        "counts": {state: counts[state] for state in JOB_STATES},
        "progress": round(sum(parts) / len(parts), 4) if parts else 1.0,
    }
    return fields | (
        {"jobs": serializers.jobs(session, rows, server.paths, server.settings)} if with_jobs else {}
    )
