"""Figures for Prometheus."""

from typing import TYPE_CHECKING

from prometheus_client import (
    CONTENT_TYPE_LATEST,
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    generate_latest,
)
from sqlalchemy import func, select

from service.db.tables import JOB_STATES, Dataset, Delivery, Job
from service.system.disk_space import free_bytes

if TYPE_CHECKING:
    from service.api.context import Server

CONTENT_TYPE = CONTENT_TYPE_LATEST


class Requests:
    """Counts of the requests that this process has answered."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self._count = Counter(
            "lvba_requests", "Requests answered", ["method", "route", "status"], registry=self.registry
        )
        self._seconds = Histogram(
            "lvba_request_seconds",
            "Time to the head of the answer",
            ["method", "route"],
            buckets=(0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 10.0),
            registry=self.registry,
        )

    def answered(self, method: str, route: str, status: int, seconds: float) -> None:
        """One more."""
        self._count.labels(method, route, str(status)).inc()
        self._seconds.labels(method, route).observe(seconds)


REQUESTS = Requests()
"""Of this process: there is one server in it."""


def exposition(server: "Server") -> bytes:
    """All figures as text."""
    registry = CollectorRegistry()
    jobs = Gauge("lvba_jobs", "Jobs by state", ["state"], registry=registry)
    datasets = Gauge("lvba_datasets", "Datasets by state", ["state"], registry=registry)
    waiting = Gauge("lvba_webhooks_waiting", "Webhooks not delivered yet", registry=registry)
    with server.database.read() as session:
        for state in JOB_STATES:
            jobs.labels(state).set(0)
        for state, count in session.execute(select(Job.state, func.count()).group_by(Job.state)):
            jobs.labels(state).set(count)
        for state, count in session.execute(select(Dataset.state, func.count()).group_by(Dataset.state)):
            datasets.labels(state).set(count)
        waiting.set(session.scalar(select(func.count()).where(Delivery.next_try.is_not(None))) or 0)
    Gauge("lvba_event_listeners", "Open event streams", registry=registry).set(server.broadcaster.listeners)
    Gauge("lvba_supervisor_up", "1: the supervisor lives and reaches the database", registry=registry).set(
        server.supervisor.is_alive() and server.supervisor.healthy
    )
    free = free_bytes(server.paths.root)
    Gauge("lvba_disk_free_bytes", "Free on the disk of the data folder", registry=registry).set(free)
    return generate_latest(registry) + generate_latest(REQUESTS.registry)
