"""Work that cannot be begun, for a reason of its own: it ends with that, and does not hold up what waits behind."""

from service.db import journal, leases
from service.db.database import Database
from service.db.leases import Lease
from service.db.tables import CANCELED, CANCELING, FAILED, INVALID, Dataset, Outcome
from service.jobs import webhooks
from service.system.paths import now


def fail(database: Database, lease: Lease, cause: str) -> None:
    """Have the job fail, or the dataset be invalid."""
    with database.write() as session:
        row = lease.row(session)
        if row is None:
            return
        row.lease_owner, row.updated = None, now()
        if isinstance(row, Dataset):
            row.state, row.error = (
                INVALID,
                {
                    "code": "files",
                    "cause": f"the recording could not be checked: {cause}",
                    "hint": "ask the server's administrator to look at its folder",
                },
            )
            return
        row.state = CANCELED if row.state == CANCELING else FAILED
        failed = f"the job could not be started: {cause}"
        row.error = {
            "code": "files",
            "cause": failed,
            "stage": None,
            "hint": "ask the server's administrator to look at its folder, then restart it",
        }
        row.finished = now()
        leases.close_attempt(session, row, Outcome(row.state), failed)
        database.order_events(session)
        journal.state(session, row)
        webhooks.enqueue(session, row)
