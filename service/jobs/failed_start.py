"""Work that cannot be begun, for a reason of its own: it ends with that, and does not hold up what waits behind."""

from service.db import journal, leases
from service.db.database import Database
from service.db.leases import Lease
from service.db.tables import CANCELED, CANCELING, FAILED, INVALID, Dataset, Outcome
from service.jobs import webhooks
from service.system.paths import now


def fail(database: Database, lease: Lease, cause: str) -> None:
    """Have the job fail, or the dataset be invalid."""
    error = {"code": "files", "cause": f"it could not be begun: {cause}"}
    with database.write() as session:
        row = lease.row(session)
        if row is None:
            return
        row.lease_owner, row.updated = None, now()
        if isinstance(row, Dataset):
            row.state, row.error = INVALID, {**error, "hint": "ask who runs the server to look at its folder"}
            return
        row.state = CANCELED if row.state == CANCELING else FAILED
        row.error = {
            **error,
            "stage": None,
            "hint": "ask who runs the server to look at its folder, then restart it",
        }
        row.finished = now()
        leases.close_attempt(session, row, Outcome(row.state), error["cause"])
        database.order_events(session)
        journal.state(session, row)
        webhooks.enqueue(session, row)
