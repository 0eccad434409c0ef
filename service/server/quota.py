"""What an owner has used."""

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from service.server.tables import READY, Dataset, Job, Upload


def used_bytes(session: Session, owner: str) -> int:
    """What an owner's datasets and results take."""
    mine = select(Dataset.id).where(
        Dataset.owner == owner, Dataset.deleted.is_(False), Dataset.state != READY
    )
    parts = (
        select(func.sum(Dataset.bytes)).where(
            Dataset.owner == owner, Dataset.deleted.is_(False), Dataset.state == READY
        ),
        select(func.sum(Upload.length)).where(Upload.dataset_id.in_(mine)),
        select(func.sum(Job.bytes)).where(Job.owner == owner, Job.deleted.is_(False)),
    )
    return sum(int(session.scalar(part) or 0) for part in parts)
