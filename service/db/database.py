"""Transactions on SQLite or PostgreSQL, and the tables' migrations."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import sqlalchemy
from alembic import command
from alembic.config import Config as AlembicConfig
from sqlalchemy import Engine, event, text
from sqlalchemy.orm import Session

_BUSY_MS = 20_000
_EVENTS, _CLAIMS, _MIGRATION, _OWNERS = 4711, 4712, 4713, 4714
"""Names of the advisory locks."""


class Database:
    """Opens transactions. Reads never write; writes are serialized on SQLite from their beginning."""

    def __init__(self, url: str) -> None:
        self.url = url
        self.sqlite = url.startswith("sqlite")
        self.engine = _engine(url)
        self._writing = threading.Lock()

    @contextmanager
    def read(self) -> Iterator[Session]:
        """A transaction whose changes are not kept."""
        with Session(self.engine, expire_on_commit=False, autoflush=False) as session:
            yield session

    @contextmanager
    def write(self, *, lasting: bool = True) -> Iterator[Session]:
        """A transaction that is committed at the end of the block, or undone if that raises.

        lasting: on the disk by then; else a power cut may undo it, unless a lasting one came after it
        """
        if not self.sqlite:
            with Session(self.engine, expire_on_commit=False) as session, session.begin():
                yield session
            return
        # threads of this process wait for each other here, fairly; SQLite would have them poll
        with self._writing:
            engine = self.engine.execution_options(immediate=True, lasting=lasting)
            with Session(engine, expire_on_commit=False) as session, session.begin():
                yield session

    def order_events(self, session: Session) -> None:
        """Until the end of the transaction nobody else adds events: their numbers appear in order."""
        self._lock(session, _EVENTS)

    def order_claims(self, session: Session) -> None:
        """Until the end of the transaction nobody else takes up work."""
        self._lock(session, _CLAIMS)

    def order_owner(self, session: Session, owner: str) -> None:
        """Until the end of the transaction nobody else is given anything of what this owner may have."""
        if not self.sqlite:
            words = {"name": _OWNERS, "owner": owner}
            session.execute(text("SELECT pg_advisory_xact_lock(:name, hashtext(:owner))"), words)

    def _lock(self, session: Session, name: int) -> None:
        if not self.sqlite:
            session.execute(text("SELECT pg_advisory_xact_lock(:name)"), {"name": name})

    def migrate(self, revision: str = "head") -> None:
        """Bring the tables to this revision; several instances may try at once."""
        configuration = AlembicConfig()
        configuration.set_main_option("script_location", str(Path(__file__).parent / "migrations"))
        with self.engine.execution_options(immediate=True).connect() as connection, connection.begin():
            if not self.sqlite:
                connection.execute(text("SELECT pg_advisory_xact_lock(:name)"), {"name": _MIGRATION})
            configuration.attributes["connection"] = connection
            command.upgrade(configuration, revision)

    def close(self) -> None:
        """Give back all connections."""
        self.engine.dispose()


def _engine(url: str) -> Engine:
    if not url.startswith("sqlite"):
        return sqlalchemy.create_engine(url, pool_size=20, max_overflow=40, pool_pre_ping=True)
    engine = sqlalchemy.create_engine(
        url, pool_size=20, max_overflow=60, connect_args={"timeout": _BUSY_MS / 1000}
    )
    event.listen(engine, "connect", _prepare_sqlite)
    event.listen(engine, "begin", _begin_sqlite)
    return engine


def _prepare_sqlite(connection: Any, record: Any) -> None:
    # transactions are begun below, not by the driver, which would begin them too late
    connection.isolation_level = None
    for pragma in (
        "journal_mode=WAL",
        f"busy_timeout={_BUSY_MS}",
        "foreign_keys=ON",
    ):
        connection.execute(f"PRAGMA {pragma}")


def _begin_sqlite(connection: Any) -> None:
    options = connection.get_execution_options()
    # NORMAL does not wait for the disk: what clients were told would be gone with the power
    synchronous = "FULL" if options.get("lasting", True) else "NORMAL"
    connection.exec_driver_sql(f"PRAGMA synchronous={synchronous}")
    # a transaction that reads first and writes then could not wait for another writer: it would fail at once
    immediate = options.get("immediate")
    connection.exec_driver_sql("BEGIN IMMEDIATE" if immediate else "BEGIN")
