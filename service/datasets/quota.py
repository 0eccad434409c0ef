"""What an owner has: everything of it that is on the disk, or may soon be, counts."""

from dataclasses import dataclass

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from service.datasets.intake_budget import EXCEEDED
from service.db.database import Database
from service.db.tables import ENDED, READY, Dataset, Job, Upload
from service.problems import Problem
from service.settings import Limits


@dataclass(frozen=True)
class Used:
    """By one owner."""

    bytes: int
    files: int
    """Of datasets, arrived or to arrive; each dataset and each job counts as one more."""


def used(session: Session, owner: str, but: str | None = None) -> Used:
    """What an owner has, without the dataset of the id `but`.

    Uploads count with the length that was announced, jobs that have not ended with what they are estimated to take, and
    what was removed as long as it is on the disk.
    """
    mine = (Dataset.owner == owner, Dataset.id != (but or ""))
    datasets = select(func.count(), func.sum(Dataset.bytes), func.sum(Dataset.files)).where(*mine)
    # of what is ready its files are what was uploaded
    arriving = select(Dataset.id).where(*mine, Dataset.state != READY)
    uploads = select(func.count(), func.sum(Upload.length)).where(Upload.dataset_id.in_(arriving))
    ended = select(func.count(), func.sum(Job.bytes)).where(Job.owner == owner, Job.state.in_(ENDED))
    bytes_, files = 0, 0
    for wanted in (datasets, uploads, ended):
        count, size, *inside = session.execute(wanted).one()
        bytes_, files = bytes_ + int(size or 0), files + count + sum(int(each or 0) for each in inside)
    for size, estimate in session.execute(
        select(Job.bytes, Job.estimate).where(Job.owner == owner, Job.state.not_in(ENDED))
    ):
        bytes_, files = bytes_ + max(size, int(estimate.get("disk_bytes", 0))), files + 1
    return Used(bytes_, files)


def exceeds(used: Used, limits: Limits, more_bytes: int = 0, more_files: int = 0) -> bool:
    """Whether an owner who has that may not have so much more."""
    return used.bytes + more_bytes > limits.owner_bytes or used.files + more_files > limits.owner_files


def check(
    database: Database, session: Session, owner: str, limits: Limits, more_bytes: int, more_files: int
) -> None:
    """Nobody else is given anything of what the owner may have until the end of the transaction.

    Raises Problem: the owner may not have so much more.
    """
    if more_bytes <= 0 and more_files <= 0:
        return
    database.order_owner(session, owner)
    if exceeds(used(session, owner), limits, max(more_bytes, 0), max(more_files, 0)):
        raise Problem("quota", EXCEEDED, "remove some")
