"""Jobs in a database that nobody runs, and events of them."""

from service.db import journal
from service.db.tables import Dataset, Job
from service.system.paths import new_id, now


def add_job(database, owner="x", **more):
    """Adds a job of this owner; its id. more: of its row"""
    dataset, job = new_id("ds"), new_id("job")
    row = {"owner": owner, "name": "x", "created": now(), "updated": now()}
    with database.write() as session:
        session.add(Dataset(id=dataset, state="ready", **row))
        session.flush()
        session.add(Job(id=job, dataset_id=dataset, config={}, **row, **more))
    return job


def tell(database, job_id, *kinds):
    """Adds events of these kinds; their ids."""
    with database.write() as session:
        job = session.get_one(Job, job_id)
        for kind in kinds:
            journal.add(session, job, kind, {"what": kind})
        session.flush()
        return journal.latest(session)
