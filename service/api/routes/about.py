"""The server itself: who asks, options, tickets, health, metrics."""

import dataclasses
import os
from collections.abc import Sequence
from importlib import metadata
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Depends, Query, Response
from sqlalchemy import func, select, text
from sqlalchemy.exc import SQLAlchemyError

from service.api import context, metrics, options_schema
from service.api.context import Context, Reader, needs, who
from service.api.schemas import TicketFor
from service.datasets import quota
from service.db import keys
from service.db.keys import Principal
from service.db.tables import CANCELING, QUEUED, RUNNING, Job
from service.jobs import estimates
from service.problems import Problem
from service.system import disk_space

router = APIRouter(tags=["server"])
Exclude = Annotated[Sequence[Literal["disk"]], Query()]


@router.get("/v1/me")
def me(server: Context, principal: Annotated[Principal, Depends(who)]) -> dict[str, Any]:
    """Who asks, and what of the quota is used."""
    mine = select(Job.state, func.count()).where(Job.owner == principal.owner, Job.deleted.is_(False))
    with server.database.read() as session:
        counts = {state: count for state, count in session.execute(mine.group_by(Job.state))}
        used = quota.used(session, principal.owner)
    limits = server.settings.limits
    return {
        "owner": principal.owner,
        "scopes": sorted(principal.scopes),
        "auth": server.settings.asks_for_keys,
        "quota": {
            "bytes": limits.owner_bytes,
            "bytes_used": used.bytes,
            "files": limits.owner_files,
            "files_used": used.files,
            "queued_jobs": limits.queued_jobs,
            "queued_jobs_used": counts.get(QUEUED, 0),
            "running_jobs": limits.running_jobs,
            "running_jobs_used": counts.get(RUNNING, 0) + counts.get(CANCELING, 0),
        },
    }


@router.post("/v1/tickets")
def ticket(body: TicketFor, server: Context, principal: Reader) -> dict[str, Any]:
    """What stands for the key in GET requests that a browser makes by itself."""
    return {"ticket": context.ticket(server, principal, body.path), "expires_in_s": context.TICKET_S}


@router.get("/v1/options")
def read_options(principal: Reader) -> dict[str, Any]:
    """All settings of a run: JSON Schema, defaults, and a flat list."""
    return options_schema.describe()


@router.get("/v1/info")
def info(server: Context, principal: Reader) -> dict[str, Any]:
    """The server, its limits, and what it has to do."""
    with server.database.read() as session:
        counts = {
            state: count
            for state, count in session.execute(select(Job.state, func.count()).group_by(Job.state))
        }
    return {
        "version": metadata.version("lvba"),
        "cores": os.cpu_count(),
        "memory_bytes": estimates.memory_bytes(),
        "disk_free_bytes": disk_space.free_bytes(server.paths.root),
        "concurrency": server.settings.jobs,
        "queued": counts.get(QUEUED, 0),
        "running": counts.get(RUNNING, 0) + counts.get(CANCELING, 0),
        "limits": dataclasses.asdict(server.settings.limits) | {"keep_days": server.settings.keep_days},
        "webhooks": server.settings.webhooks,
        "roots": [str(root) for root in server.settings.roots],
    }


@router.get("/healthz")
def healthz(server: Context) -> dict[str, str]:
    """Whether the process is well: its supervisor lives."""
    if not server.supervisor.is_alive():
        raise Problem("unavailable", "the supervisor has ended", "restart the service")
    return {"status": "ok"}


@router.get("/readyz")
def readyz(server: Context, exclude: Exclude = ()) -> dict[str, str]:
    """Whether requests can be served and jobs begun: the database answers, files can be written, the disk has room.

    exclude: `disk` leaves out its room, for who would take away a server whose users must remove something
    """
    try:
        with server.database.read() as session:
            session.execute(text("SELECT 1"))
    except SQLAlchemyError:
        raise Problem("unavailable", "the database does not answer") from None
    if not os.access(server.paths.root, os.W_OK):
        raise Problem("unavailable", "the data folder cannot be written")
    lack = None if "disk" in exclude else disk_space.lacking(server.paths.root)
    if lack:
        mend = "remove what is not needed; jobs and uploads continue by themselves"
        raise Problem("unavailable", f"the disk of the data folder is full: {lack}", mend)
    return {"status": "ready"}


@router.get("/metrics", response_class=Response)
def read_metrics(server: Context, principal: Annotated[Principal, needs(keys.METRICS)]) -> Response:
    """For Prometheus."""
    return Response(metrics.exposition(server), media_type=metrics.CONTENT_TYPE)
