"""Rows as the API shows them."""

from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

from sqlalchemy import and_, func, or_, select
from sqlalchemy.orm import Session

from service.db.tables import (
    DONE,
    ENDED,
    QUEUED,
    READY,
    UPLOADING,
    VALIDATING,
    Attempt,
    Dataset,
    Job,
    Upload,
)
from service.jobs import retention
from service.settings import Settings
from service.system import disk_space, store_urls
from service.system.paths import Paths, now

_DAY_S = 86400.0


def time(seconds: float | None) -> str | None:
    """RFC 3339, UTC."""
    if seconds is None:
        return None
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def dataset(session: Session, row: Dataset, paths: Paths, settings: Settings) -> dict[str, Any]:
    """A dataset."""
    size, files = row.bytes, row.files
    if row.state != READY and row.folder is None:
        arrived = select(func.coalesce(func.sum(Upload.length), 0), func.count()).where(
            Upload.dataset_id == row.id
        )
        size, files = session.execute(arrived).one()
    keep = settings.keep_uploads_days * _DAY_S if row.state == UPLOADING else 0.0
    return {
        "id": row.id,
        "name": row.name,
        "state": row.state,
        "source": "upload" if row.folder is None else "url" if store_urls.is_url(row.folder) else "folder",
        "created": time(row.created),
        "bytes": int(size),
        "files": files,
        "error": _waits_for_room(paths) if _waits(row) else row.error,
        "facts": row.facts,
        "expires": time(row.updated + keep) if keep else None,
    }


def jobs(session: Session, rows: Sequence[Job], paths: Paths, settings: Settings) -> list[dict[str, Any]]:
    """Jobs as in a list."""
    positions = _positions(session, [row for row in rows if row.state == QUEUED])
    full = _waits_for_room(paths) if positions else None
    return [_job(row, positions, full, paths, settings) for row in rows]


def job(session: Session, row: Job, paths: Paths, settings: Settings) -> dict[str, Any]:
    """A job with its stages and attempts."""
    [fields] = jobs(session, [row], paths, settings)
    attempts = select(Attempt).where(Attempt.job_id == row.id).order_by(Attempt.number)
    return {
        **fields,
        "stages": row.stages,
        "attempts": [_attempt(attempt) for attempt in session.scalars(attempts)],
    }


def _job(
    row: Job, positions: dict[str, int], full: dict[str, Any] | None, paths: Paths, settings: Settings
) -> dict[str, Any]:
    links = {name: f"/v1/jobs/{row.id}/{name}" for name in ("events", "logs", "results", "archive", "frames")}
    log = paths.log(row.id)
    fields = {
        **{name: getattr(row, name) for name in ("id", "name")},
        "dataset": row.dataset_id,
        "batch": row.batch_id,
        **{name: getattr(row, name) for name in ("config", "priority", "reference", "state")},
        "import": row.import_options,
        **{name: time(getattr(row, name)) for name in ("created", "started", "finished", "updated")},
        "expires": time(retention.expiry(row, settings)),
        "progress": row.progress,
        "eta_s": row.eta_s if row.state not in ENDED else None,
        "elapsed_s": _elapsed(row),
        "error": row.error,
        "estimate": {name: value for name, value in row.estimate.items() if name != "plain"},
        "summary": row.summary if row.state == DONE else None,
        "log_bytes": log.stat().st_size if log.exists() else 0,
        "links": {"self": f"/v1/jobs/{row.id}", **links},
    }
    if row.state == QUEUED:
        fields["position"] = positions.get(row.id, 0)
        needed = (row.error or {}).get("needed_bytes", 0)
        fields["error"] = full or (_waits_for_room(paths, needed) if needed else None) or row.error
    return fields


def _waits(row: Dataset) -> bool:
    return row.state == VALIDATING and row.lease_owner is None


def _waits_for_room(paths: Paths, needed: int = disk_space.LEAST_FREE) -> dict[str, Any] | None:
    """Why nothing is begun that needs so many bytes; None: nothing is in its way.

    Not written down when it happens: a full disk may not take even that.
    """
    lack = disk_space.lacking(paths.root, needed)
    if lack is None:
        return None
    hint = "it continues by itself when there is room: remove what is not needed, or ask the server's administrator"
    return {
        "code": "disk-full",
        "stage": None,
        "cause": f"waits for disk space: {lack}",
        "hint": hint,
        "needed_bytes": needed,
    }


def _elapsed(row: Job) -> float:
    if row.started is None:
        return 0.0
    end = row.finished if row.finished is not None else now()
    return round(max(end - row.started, 0.0), 1)


def _positions(session: Session, waiting: Sequence[Job]) -> dict[str, int]:
    """How many are before each, by priority and age."""
    everybody = (Job.state == QUEUED, Job.deleted.is_(False))
    if len(waiting) == 1:
        [one] = waiting
        earlier = or_(
            Job.priority > one.priority, and_(Job.priority == one.priority, Job.created < one.created)
        )
        return {one.id: session.scalar(select(func.count()).where(*everybody, earlier)) or 0}
    if not waiting:
        return {}
    ordered = select(Job.id).where(*everybody).order_by(Job.priority.desc(), Job.created)
    return {job_id: index for index, job_id in enumerate(session.scalars(ordered))}


def _attempt(row: Attempt) -> dict[str, Any]:
    return {
        "number": row.number,
        "started": time(row.started),
        "finished": time(row.finished),
        "outcome": row.outcome,
        "message": row.message,
    }
