"""Jobs: checked, estimated and queued, once for each idempotency key."""

import hashlib
import json
from typing import Any

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from lvba import config
from lvba.errors import InputError
from lvba.pipeline import Config
from service.api import queries
from service.api.context import Server
from service.api.schemas import NewJob
from service.datasets import import_choices, inspections, quota
from service.db import journal
from service.db.keys import Principal
from service.db.tables import ENDED, QUEUED, READY, Batch, Dataset, Job
from service.jobs import estimates, webhooks
from service.problems import Problem, of_input
from service.system import disk_space
from service.system.paths import new_id, now


def estimate(server: Server, session: Session, principal: Principal, wanted: NewJob) -> dict[str, Any]:
    """What a job would take.

    Raises Problem: it could not be queued as it is.
    """
    dataset = _check(server, session, principal, wanted)
    return estimates.estimate(session, dataset, server.settings.threads)


def queue(
    server: Server,
    session: Session,
    principal: Principal,
    wanted: NewJob,
    *,
    batch: Batch | None = None,
    key: str | None = None,
) -> Job:
    """A new job that waits for its turn.

    Raises Problem: it cannot be run as it is, a quota, no room.
    """
    dataset = _check(server, session, principal, wanted)
    estimate = estimates.estimate(session, dataset, server.settings.threads)
    _check_room(server, session, principal, estimate)
    job = Job(
        id=new_id("job"),
        owner=principal.owner,
        name=wanted.name or dataset.name,
        dataset_id=dataset.id,
        batch_id=batch.id if batch else None,
        config=wanted.config,
        reference=wanted.reference,
        priority=wanted.priority,
        keep_days=wanted.keep_days,
        webhook=wanted.webhook.model_dump() if wanted.webhook else None,
        idempotency_key=key,
        import_options=_import_options(dataset, wanted),
        request_digest=request_digest(wanted),
        created=now(),
        updated=now(),
        estimate=estimate,
    )
    session.add(job)
    session.flush()
    server.database.order_events(session)
    journal.state(session, job)
    return job


def request_digest(wanted: NewJob) -> str:
    """Equal for equal requests, also those of versions that knew no imports."""
    request = wanted.model_dump()
    return digest(
        request if wanted.import_ is not None else {k: v for k, v in request.items() if k != "import_"}
    )


def digest(request: dict[str, Any]) -> str:
    """Equal for equal requests."""
    return hashlib.sha256(json.dumps(request, sort_keys=True).encode()).hexdigest()


def check_config(values: dict[str, Any]) -> None:
    """Raises Problem: settings that do not exist or have wrong values."""
    try:
        config.from_mapping(Config, values)
    except config.SettingError as error:
        problem = of_input(error)
        problem.more["errors"] = [{"where": f"config.{error.setting}", "message": error.problem}]
        raise problem from None
    except (TypeError, ValueError, OverflowError) as error:
        raise Problem("invalid", f"config: {error}") from None


def check_import(server: Server, dataset: Dataset, values: dict[str, Any] | None) -> None:
    """Raises Problem: the dataset is not imported, or does not have what is chosen of it."""
    inspection = inspections.read(server.paths, dataset.id)
    if inspection is None:
        if values is not None:
            raise Problem("invalid", "the dataset is a recording and needs no import", "leave `import` out")
        return
    try:
        import_choices.check(import_choices.read(values or {}), inspection, dataset.name)
    except InputError as error:
        problem = of_input(error)
        where = import_choices.place(error)
        problem.more["errors"] = [{"where": where, "message": f"{error.problem}: {error.mend}"}]
        raise problem from None


def _import_options(dataset: Dataset, wanted: NewJob) -> dict[str, Any] | None:
    imported = (dataset.facts or {}).get("format") is not None
    return (wanted.import_ or {}) if imported else None


def _check(server: Server, session: Session, principal: Principal, wanted: NewJob) -> Dataset:
    dataset = queries.one(session, Dataset, wanted.dataset, principal)
    if dataset.state != READY:
        raise Problem("not-ready", f"the dataset is {dataset.state}", "jobs need one that is ready")
    check_config(wanted.config)
    check_import(server, dataset, wanted.import_)
    if wanted.reference and not (dataset.facts or {}).get("has_reference"):
        raise Problem("invalid", "the dataset has no folder reference/", "leave `reference` out")
    if wanted.webhook is not None:
        _check_webhook(server, wanted.webhook.url)
    return dataset


def _check_webhook(server: Server, url: str) -> None:
    if not server.settings.webhooks:
        raise Problem("invalid", "webhooks are switched off on this server", "leave `webhook` out")
    try:
        webhooks.check_url(url, server.settings.webhook_allow)
    except InputError as error:
        raise of_input(error) from None


def _check_room(server: Server, session: Session, principal: Principal, estimate: dict[str, Any]) -> None:
    limits = server.settings.limits
    disk_bytes = int(estimate.get("disk_bytes", 0))
    quota.check(server.database, session, principal.owner, limits, disk_bytes, 1)
    _check_waiting(server, session, principal.owner)
    free = disk_space.free_bytes(server.paths.root)
    needed = int(estimate.get("disk_bytes", 0)) + limits.disk_reserve_bytes + _reserved(session)
    if needed > free:
        raise Problem(
            "disk-full",
            f"the job and those before it need about {needed} bytes, the disk has {free}",
            needed_bytes=needed,
            free_bytes=free,
        )


def check_restart(server: Server, session: Session, job: Job) -> None:
    """Raises Problem: a quota, which a job that is run again meets like a new one."""
    more = int((job.estimate or {}).get("disk_bytes", 0)) - job.bytes
    quota.check(server.database, session, job.owner, server.settings.limits, more, 0)
    _check_waiting(server, session, job.owner)


def _check_waiting(server: Server, session: Session, owner: str) -> None:
    most = server.settings.limits.queued_jobs
    waiting = select(func.count()).where(Job.owner == owner, Job.state == QUEUED)
    if (session.scalar(waiting) or 0) >= most:
        raise Problem("quota", f"{most} jobs of this owner wait already", headers={"Retry-After": "60"})


def _reserved(session: Session) -> int:
    """What the jobs that have not ended may still take."""
    pending = session.scalars(select(Job.estimate).where(Job.state.not_in(ENDED), Job.deleted.is_(False)))
    return sum(int(estimate.get("disk_bytes", 0)) for estimate in pending)
