"""Events of jobs: adding them, inside the transaction that makes them true, and reading them after a cursor."""

from collections.abc import Sequence
from typing import Any

from sqlalchemy import delete, func, select
from sqlalchemy.orm import Session

from service.db.tables import ENDED, Event, Job
from service.system.paths import now

STATE, STAGES, STAGE, PROGRESS, LOG, END = "state", "stages", "stage", "progress", "log", "end"
KINDS = (STATE, STAGES, STAGE, PROGRESS, LOG, END)
PASSING = (PROGRESS, LOG)
"""What says nothing any more once a job has ended."""


def add(session: Session, job: Job, kind: str, data: dict[str, Any]) -> None:
    """One more event. The transaction must hold `Database.order_events`."""
    job.updated = now()
    session.add(Event(job_id=job.id, owner=job.owner, time=job.updated, kind=kind, data=data))


def state(session: Session, job: Job) -> None:
    """The job's state, after it has changed; if it has ended, also that."""
    add(session, job, STATE, {"state": job.state, "attempt": job.attempt, "error": job.error})
    if job.state in ENDED:
        forget(session, job.id)
        add(session, job, END, {"state": job.state})


def forget(session: Session, job_id: str) -> None:
    """Remove the passing events of a job that has ended."""
    session.execute(delete(Event).where(Event.job_id == job_id, Event.kind.in_(PASSING)))


def after(
    session: Session,
    cursor: int,
    *,
    job_id: str | None = None,
    owner: str | None = None,
    upto: int | None = None,
    limit: int = 500,
) -> Sequence[Event]:
    """Events after the cursor, in order; of one job, of one owner, or all; up to one that is named, or the newest."""
    wanted = select(Event).where(Event.id > cursor).order_by(Event.id).limit(limit)
    if job_id is not None:
        wanted = wanted.where(Event.job_id == job_id)
    if owner is not None:
        wanted = wanted.where(Event.owner == owner)
    if upto is not None:
        wanted = wanted.where(Event.id <= upto)
    return session.scalars(wanted).all()


def latest(session: Session) -> int:
    """Number of the newest event; 0: there is none."""
    return session.scalar(select(func.max(Event.id))) or 0
