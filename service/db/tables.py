"""The tables of the job service. Times are seconds since 1970 UTC."""

from enum import StrEnum
from typing import Any

from sqlalchemy import JSON, BigInteger, ForeignKey, Index, Integer, MetaData, String, Text, UniqueConstraint
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

_BIG = BigInteger().with_variant(Integer, "sqlite")

QUEUED, RUNNING, CANCELING, DONE, FAILED, CANCELED = (
    *("queued", "running", "canceling"),
    *("done", "failed", "canceled"),
)
ENDED = (DONE, FAILED, CANCELED)
JOB_STATES = (QUEUED, RUNNING, CANCELING, *ENDED)
UPLOADING, VALIDATING, READY, INVALID = "uploading", "validating", "ready", "invalid"


class Base(DeclarativeBase):
    """Of all tables."""

    metadata = MetaData(
        naming_convention={
            "ix": "ix_%(table_name)s_%(column_0_N_name)s",
            "uq": "uq_%(table_name)s_%(column_0_N_name)s",
            "fk": "fk_%(table_name)s_%(column_0_name)s",
            "pk": "pk_%(table_name)s",
        }
    )
    type_annotation_map = {dict[str, Any]: JSON, list[Any]: JSON, str: Text}  # noqa: RUF012


class Leased:
    """Work that one instance holds: it renews the heartbeat; where that stands still, another may take over."""

    lease_owner: Mapped[str | None]
    heartbeat: Mapped[int] = mapped_column(default=0)
    attempt: Mapped[int] = mapped_column(default=0)
    """How often it was taken up. Who holds an older attempt has lost it."""


class Key(Base):
    """An API key. The secret itself is not kept."""

    __tablename__ = "keys"
    id: Mapped[str] = mapped_column(primary_key=True)
    owner: Mapped[str]
    hash: Mapped[str]
    """sha256 of the secret: 32 random bytes need no slow hash."""
    scopes: Mapped[list[Any]]
    note: Mapped[str] = mapped_column(default="")
    created: Mapped[float]
    expires: Mapped[float | None]
    revoked: Mapped[float | None]


class Dataset(Leased, Base):
    """A recording: uploaded, or registered where it lies."""

    __tablename__ = "datasets"
    id: Mapped[str] = mapped_column(primary_key=True)
    owner: Mapped[str] = mapped_column(index=True)
    name: Mapped[str]
    state: Mapped[str]
    folder: Mapped[str | None]
    """Where a registered one lies, a path or the URL of an object store; None: uploaded."""
    created: Mapped[float]
    updated: Mapped[float]
    bytes: Mapped[int] = mapped_column(_BIG, default=0)
    files: Mapped[int] = mapped_column(default=0)
    error: Mapped[dict[str, Any] | None] = mapped_column(JSON)
    facts: Mapped[dict[str, Any] | None] = mapped_column(JSON)
    deleted: Mapped[bool] = mapped_column(default=False)
    """To be removed: nobody sees it any more."""


class Upload(Base):
    """A file of a dataset that is arriving or has arrived. How much is there, the file itself says."""

    __tablename__ = "uploads"
    __table_args__ = (UniqueConstraint("dataset_id", "path"),)
    id: Mapped[str] = mapped_column(primary_key=True)
    dataset_id: Mapped[str] = mapped_column(ForeignKey("datasets.id", ondelete="CASCADE"))
    path: Mapped[str]
    """As the user named it; empty: the archive."""
    length: Mapped[int] = mapped_column(_BIG)
    complete: Mapped[bool] = mapped_column(default=False)
    sha256: Mapped[str | None]


class Batch(Base):
    """Jobs that were submitted together."""

    __tablename__ = "batches"
    __table_args__ = (UniqueConstraint("owner", "idempotency_key"),)
    id: Mapped[str] = mapped_column(primary_key=True)
    owner: Mapped[str]
    name: Mapped[str]
    created: Mapped[float]
    idempotency_key: Mapped[str | None]
    request_digest: Mapped[str] = mapped_column(default="")


class Job(Leased, Base):
    """A run that was asked for."""

    __tablename__ = "jobs"
    __table_args__ = (
        UniqueConstraint("owner", "idempotency_key"),
        Index(None, "state", "priority", "created"),
    )
    id: Mapped[str] = mapped_column(primary_key=True)
    owner: Mapped[str] = mapped_column(index=True)
    name: Mapped[str]
    dataset_id: Mapped[str] = mapped_column(ForeignKey("datasets.id"))
    batch_id: Mapped[str | None] = mapped_column(ForeignKey("batches.id"), index=True)
    config: Mapped[dict[str, Any]]
    import_options: Mapped[dict[str, Any] | None] = mapped_column(JSON(none_as_null=True))
    """What is chosen of a bag, as it was given; None: the dataset is a recording."""
    import_key: Mapped[str | None]
    """Of the recording that was made of the bag; None: it was not begun."""
    reference: Mapped[bool] = mapped_column(default=False)
    priority: Mapped[int] = mapped_column(default=0)
    keep_days: Mapped[float | None]
    webhook: Mapped[dict[str, Any] | None] = mapped_column(JSON)
    idempotency_key: Mapped[str | None]
    request_digest: Mapped[str] = mapped_column(default="")
    state: Mapped[str] = mapped_column(default=QUEUED)
    created: Mapped[float]
    updated: Mapped[float]
    started: Mapped[float | None]
    finished: Mapped[float | None]
    redo: Mapped[str | None]
    """Stage from which the next attempt makes everything again."""
    crashes: Mapped[int] = mapped_column(default=0)
    """Attempts since the last submission whose process was killed."""
    losses: Mapped[int] = mapped_column(default=0)
    """Attempts since the last submission that lost their service."""
    stages: Mapped[list[Any]] = mapped_column(default=list)
    progress: Mapped[float] = mapped_column(default=0.0)
    eta_s: Mapped[float | None]
    error: Mapped[dict[str, Any] | None] = mapped_column(JSON)
    estimate: Mapped[dict[str, Any]] = mapped_column(default=dict)
    summary: Mapped[dict[str, Any] | None] = mapped_column(JSON)
    hidden: Mapped[bool] = mapped_column(default=False)
    """Dismissed by an OGC client: not listed there."""
    deleted: Mapped[bool] = mapped_column(default=False)
    bytes: Mapped[int] = mapped_column(_BIG, default=0)
    """Of its result and stages, when it ended."""


class Result(Base):
    """A file that a job made, as its run left it."""

    __tablename__ = "results"
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True)
    name: Mapped[str] = mapped_column(primary_key=True)
    bytes: Mapped[int] = mapped_column(_BIG)
    sha256: Mapped[str | None]
    """None: the run was killed in its last stage, before it could take the digest."""
    stamp: Mapped[str]
    """Inode, size and times then: while they are the same, nobody has touched the file."""


class Outcome(StrEnum):
    """How an attempt ended."""

    DONE = "done"
    FAILED = "failed"
    CANCELED = "canceled"
    CRASHED = "crashed"
    """Its process was ended from outside, or had no room; the job may be tried again."""
    LOST = "lost"
    """Its service was lost, or gave it back."""


class DeliveryStatus(StrEnum):
    """What became of a delivery so far."""

    WAITING = "waiting"
    DELIVERED = "delivered"
    RETRYING = "retrying"
    GIVEN_UP = "given up"


class Attempt(Base):
    """One time that a job was taken up."""

    __tablename__ = "attempts"
    __table_args__ = (UniqueConstraint("job_id", "number"),)
    id: Mapped[int] = mapped_column(_BIG, primary_key=True, autoincrement=True)
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"))
    number: Mapped[int]
    instance: Mapped[str]
    started: Mapped[float]
    finished: Mapped[float | None]
    outcome: Mapped[str | None]
    """An Outcome; None: it runs."""
    message: Mapped[str] = mapped_column(default="")


class Event(Base):
    """What happened to a job, in order. Only ever added to; progress of ended jobs is removed."""

    __tablename__ = "events"
    __table_args__ = ({"sqlite_autoincrement": True},)
    id: Mapped[int] = mapped_column(_BIG, primary_key=True, autoincrement=True)
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"), index=True)
    owner: Mapped[str]
    time: Mapped[float]
    kind: Mapped[str] = mapped_column(String(16))
    data: Mapped[dict[str, Any]]


class Delivery(Base):
    """A webhook that is to be told, or was."""

    __tablename__ = "deliveries"
    id: Mapped[str] = mapped_column(primary_key=True)
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"), index=True)
    created: Mapped[float]
    body: Mapped[str]
    tries: Mapped[int] = mapped_column(default=0)
    next_try: Mapped[float | None] = mapped_column(index=True)
    """None: delivered, or given up."""
    status: Mapped[str] = mapped_column(default=DeliveryStatus.WAITING.value)
    """A DeliveryStatus."""
    message: Mapped[str] = mapped_column(default="")
