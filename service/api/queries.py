"""Rows that whoever asks may see: of others it is said that there are none."""

from collections.abc import Sequence
from typing import Any, TypeVar

from sqlalchemy import Select, and_, or_, select
from sqlalchemy.orm import Session

from service.db.keys import Principal
from service.db.tables import Batch, Dataset, Job
from service.problems import Problem

Row = TypeVar("Row", Dataset, Job, Batch)


def one(session: Session, kind: type[Row], row_id: str, principal: Principal, *, lock: bool = False) -> Row:
    """The row of this id.

    lock: until the end of the transaction
    Raises Problem: it does not exist, or belongs to somebody else.
    """
    wanted = select(kind).where(kind.id == row_id)
    row = session.scalars(wanted.with_for_update() if lock else wanted).one_or_none()
    if row is None or row.owner != principal.owner or getattr(row, "deleted", False):
        raise Problem("not-found", f"there is no {kind.__name__.lower()} {row_id[:80]!r}")
    return row


def page(
    session: Session, kind: type[Row], wanted: Select[Any], limit: int, cursor: str | None
) -> tuple[Sequence[Row], str | None]:
    """Rows from the newest on, and the cursor of the next page; None: that was all."""
    if cursor is not None:
        created, row_id = _position(cursor)
        wanted = wanted.where(or_(kind.created < created, and_(kind.created == created, kind.id < row_id)))
    rows: Sequence[Any] = session.scalars(
        wanted.order_by(kind.created.desc(), kind.id.desc()).limit(limit + 1)
    ).all()
    more = f"{rows[limit - 1].created!r}~{rows[limit - 1].id}" if len(rows) > limit else None
    return rows[:limit], more


def _position(cursor: str) -> tuple[float, str]:
    created, _, row_id = cursor.partition("~")
    try:
        return float(created), row_id
    except ValueError:
        raise Problem(
            "invalid", "the cursor is not one of this server", "take `next` of the page before"
        ) from None
