"""Removing what has had its time. Only what the database says may go is removed: a folder that it does not know stays."""

import time
from collections.abc import Sequence

from sqlalchemy import delete, select, update
from sqlalchemy.orm import Session

from service.db.database import Database
from service.db.tables import ENDED, UPLOADING, Dataset, Event, Job, Upload
from service.settings import Settings
from service.system.paths import Paths, now

_DAY_S = 86400.0
_SURE_S = 600.0
"""For so long it must have been over, by a steady clock: that of the wall may have jumped."""


def expiry(job: Job, settings: Settings) -> float | None:
    """When an ended job may go; None: never, or it has not ended."""
    days = settings.keep_days if job.keep_days is None else job.keep_days
    return (
        None if job.finished is None or job.state not in ENDED or not days else job.finished + days * _DAY_S
    )


class Retention:
    """What one service has seen to be over, and since when."""

    def __init__(self, database: Database, paths: Paths, settings: Settings) -> None:
        self._database, self._paths, self._settings = database, paths, settings
        self._seen: dict[str, float] = {}

    def sweep(self, sure_s: float = _SURE_S) -> int:
        """Mark what is over for removal, and remove what is marked; how many jobs and datasets went."""
        with self._database.read() as session:
            over = [*self._jobs_over(session), *self._uploads_over(session)]
        steady = time.monotonic()
        self._seen = {name: self._seen.get(name, steady) for name in over}
        due = [name for name, since in self._seen.items() if steady - since >= sure_s]
        if due:
            self._mark(due)
        return remove_marked(self._database, self._paths)

    def _jobs_over(self, session: Session) -> list[str]:
        ended = session.scalars(select(Job).where(Job.state.in_(ENDED), Job.deleted.is_(False)))
        return [job.id for job in ended if (expiry(job, self._settings) or now() + 1) < now()]

    def _uploads_over(self, session: Session) -> Sequence[str]:
        if not self._settings.keep_uploads_days:
            return []
        oldest = now() - self._settings.keep_uploads_days * _DAY_S
        return session.scalars(
            select(Dataset.id).where(
                Dataset.state == UPLOADING, Dataset.updated < oldest, Dataset.deleted.is_(False)
            )
        ).all()

    def _mark(self, names: list[str]) -> None:
        with self._database.write() as session:
            session.execute(update(Job).where(Job.id.in_(names), Job.state.in_(ENDED)).values(deleted=True))
            session.execute(
                update(Dataset).where(Dataset.id.in_(names), Dataset.state == UPLOADING).values(deleted=True)
            )


def remove_marked(database: Database, paths: Paths) -> int:
    """Remove files, then records, of what nobody sees any more. Cut short, the next call continues."""
    with database.read() as session:
        jobs = session.scalars(select(Job.id).where(Job.deleted.is_(True))).all()
        used = select(Job.dataset_id)
        datasets = session.scalars(
            select(Dataset.id).where(Dataset.deleted.is_(True), Dataset.id.not_in(used))
        ).all()
    for job_id in jobs:
        paths.discard(paths.job(job_id))
        paths.empty_trash()  # before nobody is accountable for it any more
        with database.write() as session:
            session.execute(delete(Event).where(Event.job_id == job_id))
            session.execute(delete(Job).where(Job.id == job_id, Job.deleted.is_(True)))
    for dataset_id in datasets:
        paths.discard(paths.dataset(dataset_id))
        paths.empty_trash()
        with database.write() as session:
            session.execute(delete(Upload).where(Upload.dataset_id == dataset_id))
            session.execute(delete(Dataset).where(Dataset.id == dataset_id, Dataset.deleted.is_(True)))
    paths.empty_trash()
    return len(jobs) + len(datasets)
