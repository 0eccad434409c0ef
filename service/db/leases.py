"""Who works on what: taking up a job or a dataset, renewing, losing, taking over.

A lease is (owner, attempt): every change that its holder makes names both, and does nothing once they are another's. That
no two processes work in one folder does not hang on leases or clocks: each holds a lock there (`file_lock.exclusive`).
"""

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

from sqlalchemy import ColumnElement, and_, delete, func, select, update
from sqlalchemy.orm import Session

from service.db import journal
from service.db.database import Database
from service.db.instance import Instance, Watch
from service.db.tables import (
    CANCELED,
    CANCELING,
    FAILED,
    QUEUED,
    RUNNING,
    VALIDATING,
    Attempt,
    Dataset,
    Job,
    Leased,
    Outcome,
)
from service.system.paths import now

KINDS: tuple[type[Job], type[Dataset]] = (Job, Dataset)
"""What is worked on."""
MAX_LOSSES = 20
"""How often a job may lose its service before it is taken for the cause."""


@dataclass(frozen=True)
class Lease:
    """The right to work on a row."""

    kind: type[Job] | type[Dataset]
    id: str
    owner: str
    attempt: int

    @property
    def condition(self) -> ColumnElement[bool]:
        """That the row is still held under this lease."""
        return and_(
            self.kind.id == self.id, self.kind.lease_owner == self.owner, self.kind.attempt == self.attempt
        )

    def row(self, session: Session) -> Any:
        """The row, locked until the end of the transaction; None: the lease is lost."""
        return session.scalars(select(self.kind).where(self.condition).with_for_update()).one_or_none()


def claim_job(
    database: Database,
    owner: str,
    running_jobs: int,
    but: Collection[str] = (),
    free_bytes: float = float("inf"),
) -> Job | None:
    """The next job, taken up: highest priority first, then owners in turn, then the oldest. None: there is none.

    running_jobs: how many of one owner may run at once
    but: jobs to leave alone for now
    free_bytes: of the disk: a job that it could not hold before waits until it can
    """
    with database.read() as session:  # mostly nothing waits, and SQLite has one writer at a time
        if _next_job(session, running_jobs, but, free_bytes) is None:
            return None
    with database.write() as session:
        database.order_claims(session)
        chosen = _next_job(session, running_jobs, but, free_bytes)
        if chosen is None:
            return None
        # a job that another transaction holds, such as one that cancels it, is for the next round
        wanted = select(Job).where(Job.id == chosen, Job.state == QUEUED).with_for_update(skip_locked=True)
        job = session.scalars(wanted).one_or_none()
        if job is None:
            return None
        _take(job, owner)
        job.state, job.error, job.stages, job.progress, job.eta_s = RUNNING, None, [], 0.0, None
        job.started = job.started or now()
        session.add(Attempt(job_id=job.id, number=job.attempt, instance=owner, started=now()))
        database.order_events(session)
        journal.state(session, job)
        return job


def _next_job(session: Session, running_jobs: int, but: Collection[str], free_bytes: float) -> str | None:
    busy = select(Job.owner, func.count()).where(Job.state.in_((RUNNING, CANCELING))).group_by(Job.owner)
    running = {owner: count for owner, count in session.execute(busy)}
    waiting = select(Job.id, Job.owner, Job.priority, Job.created, Job.error).where(
        Job.state == QUEUED, Job.deleted.is_(False)
    )
    eligible = [
        (-priority, running.get(owner, 0), created, job)
        for job, owner, priority, created, error in session.execute(waiting)
        if running.get(owner, 0) < running_jobs
        and job not in but
        and (error or {}).get("needed_bytes", 0) <= free_bytes
    ]
    return min(eligible)[-1] if eligible else None


def claim_dataset(database: Database, owner: str) -> Dataset | None:
    """The next dataset to be checked, taken up."""
    wanted = (
        select(Dataset)
        .where(Dataset.state == VALIDATING, Dataset.lease_owner.is_(None), Dataset.deleted.is_(False))
        .order_by(Dataset.updated)
        .limit(1)
    )
    with database.read() as session:
        if session.scalars(wanted).one_or_none() is None:
            return None
    with database.write() as session:
        database.order_claims(session)
        dataset = session.scalars(wanted.with_for_update(skip_locked=True)).one_or_none()
        if dataset is not None:
            _take(dataset, owner)
        return dataset


def _take(row: Leased, owner: str) -> None:
    row.lease_owner, row.attempt, row.heartbeat = owner, row.attempt + 1, 0


def renew(database: Database, owner: str) -> None:
    """Say that everything this owner holds is still in good hands."""
    with database.write() as session:
        for kind in KINDS:
            session.execute(
                update(kind).where(kind.lease_owner == owner).values(heartbeat=kind.heartbeat + 1)
            )


def held(database: Database, owner: str) -> dict[tuple[str, int], str]:
    """State of everything that this owner holds, by id and attempt."""
    with database.read() as session:
        return {
            (row.id, row.attempt): row.state
            for kind in KINDS
            for row in session.execute(
                select(kind.id, kind.attempt, kind.state).where(kind.lease_owner == owner)
            )
        }


def owners(database: Database) -> set[str]:
    """Everybody who holds something."""
    with database.read() as session:
        return {
            name
            for kind in KINDS
            for name in session.scalars(select(kind.lease_owner).where(kind.lease_owner.is_not(None)))
            if name is not None
        }


def take_over(database: Database, me: Instance, watch: Watch) -> list[Lease]:
    """Set free what belongs to services that are dead; what was set free."""
    with database.read() as session:
        leases = [
            (Lease(kind, row.id, row.lease_owner, row.attempt), row.heartbeat)
            for kind in KINDS
            for row in session.execute(
                select(kind.id, kind.lease_owner, kind.attempt, kind.heartbeat).where(
                    kind.lease_owner.is_not(None), kind.lease_owner != me.name
                )
            )
        ]
    watch.keep_only({lease.id for lease, _ in leases})
    freed = []
    for lease, heartbeat in leases:
        still = watch.stands_still(lease.id, lease.owner, lease.attempt, heartbeat)
        if (still or me.knows_dead(lease.owner)) and lose(database, lease, "the service died", heartbeat):
            freed.append(lease)
    return freed


def lose(
    database: Database, lease: Lease, why: str, heartbeat: int | None = None, *, counts: bool = True
) -> bool:
    """Give back what a lease is about, to be taken up again; False: it was not held any more.

    heartbeat: as it was seen; if it has moved since, nothing is done
    counts: towards giving the job up
    """
    with database.write() as session:
        row = lease.row(session)
        if row is None or heartbeat not in (None, row.heartbeat):
            return False
        row.lease_owner = None
        if isinstance(row, Job):
            _back_to_queue(database, session, row, why, counts)
        return True


def take_back(database: Database, lease: Lease, why: str) -> None:
    """Set free what was taken up and could not be begun: as if it had not been, but for the reason that a job tells."""
    with database.write() as session:
        row = lease.row(session)
        if row is None:
            return
        row.lease_owner = None
        if isinstance(row, Job):
            session.execute(delete(Attempt).where(Attempt.job_id == row.id, Attempt.number == row.attempt))
            row.state, row.finished = (CANCELED, now()) if row.state == CANCELING else (QUEUED, None)
            row.error = {
                "code": "unavailable",
                "stage": None,
                "cause": f"the server cannot begin it now: {why}",
                "hint": "it is tried again; if it stays, tell the server's administrator",
            }
            database.order_events(session)
            journal.state(session, row)


def _back_to_queue(database: Database, session: Session, job: Job, why: str, counts: bool) -> None:
    job.losses += counts
    if job.state == CANCELING:
        job.state, job.finished = CANCELED, now()
    elif job.losses >= MAX_LOSSES:
        job.state, job.finished = FAILED, now()
        job.error = {
            "code": "lost",
            "stage": None,
            "cause": f"the service was lost {job.losses} times while this job ran",
            "hint": "it may be what brings the machine down: look at its memory, then restart the job",
        }
    else:
        job.state = QUEUED
    close_attempt(session, job, Outcome.CANCELED if job.state == CANCELED else Outcome.LOST, why)
    database.order_events(session)
    journal.state(session, job)


def close_attempt(session: Session, job: Job, outcome: Outcome, message: str = "") -> None:
    """Write down how the present attempt ended."""
    session.execute(
        update(Attempt)
        .where(Attempt.job_id == job.id, Attempt.number == job.attempt)
        .values(finished=now(), outcome=outcome, message=message)
    )
