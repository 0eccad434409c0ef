"""What a server answers, as this program understands it.

Whatever else comes is refused here, in one place; texts are made fit for a terminal (`printable`).
"""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

from service.system.printable import printable

JOB_STATES = ("queued", "running", "canceling", "done", "failed", "canceled")
DATASET_STATES = ("uploading", "validating", "ready", "invalid")
_ID = re.compile(r"[a-z]{1,8}_[0-9a-f]{1,64}")
_DIGEST = re.compile(r"[0-9a-f]{64}")
_MOST = 1e15
Value = TypeVar("Value")


class WrongAnswerError(ValueError):
    """An answer that no lvba server gives; its text says what is wrong with it."""


@dataclass(frozen=True)
class Failure:
    """Why something failed, and what helps."""

    cause: str
    hint: str


@dataclass(frozen=True)
class Dataset:
    """A recording on the server."""

    id: str
    name: str
    state: str
    error: Failure | None


@dataclass(frozen=True)
class Stage:
    """A stage of a job; seconds: None until it has ended."""

    name: str
    state: str
    what: str
    done: int
    total: int
    seconds: float | None
    reused: bool


@dataclass(frozen=True)
class Job:
    """A run; position: how many are before it while it waits."""

    id: str
    name: str
    state: str
    progress: float
    created: str
    eta_s: float | None
    position: int
    error: Failure | None
    stages: tuple[Stage, ...]


@dataclass(frozen=True)
class Result:
    """A file that a job made; sha256: in hexadecimal, None where the server does not know it."""

    name: str
    bytes: int
    etag: str
    sha256: str | None


@dataclass(frozen=True)
class LogPiece:
    """Whole lines of a log; next: where the rest begins."""

    text: str
    next: int
    size: int
    ended: bool


class Fields:
    """A JSON object whose fields are asked for by what they must be."""

    def __init__(self, value: Any, what: str) -> None:
        if not isinstance(value, dict):
            raise WrongAnswerError(f"{what} is not an object")
        self._value, self._what = value, what

    def text(self, name: str, keep: str = "") -> str:
        """A text; empty where there is none."""
        return printable(self.plain(name), keep)

    def plain(self, name: str) -> str:
        """A text as it came: never to be shown."""
        value = self._value.get(name)
        if value is not None and not isinstance(value, str):
            raise self._wrong(name, "text")
        return value or ""

    def one_of(self, name: str, known: tuple[str, ...]) -> str:
        """One of the words that are known."""
        value = self._value.get(name)
        if value not in known:
            raise self._wrong(name, "word that is known")
        return str(value)

    def matching(self, name: str, pattern: re.Pattern[str]) -> str:
        """A text of this form."""
        value = self._value.get(name)
        if not isinstance(value, str) or not pattern.fullmatch(value):
            raise self._wrong(name, "text of that form")
        return value

    def number(self, name: str) -> float | None:
        """A number; None where there is none."""
        value = self._value.get(name)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise self._wrong(name, "number")
        if abs(value) > _MOST:
            raise self._wrong(name, "number of a size that makes sense")
        return float(value)

    def count(self, name: str) -> int:
        """A number of things; 0 where there is none."""
        value = self.number(name) or 0.0
        if value < 0 or value != int(value):
            raise self._wrong(name, "count")
        return int(value)

    def each(self, name: str, read: Callable[[Any], Value]) -> tuple[Value, ...]:
        """A list; empty where there is none."""
        values = self._value.get(name)
        if values is not None and not isinstance(values, list):
            raise self._wrong(name, "list")
        return tuple(read(value) for value in values or ())

    def maybe(self, name: str, read: Callable[[Any], Value]) -> Value | None:
        """What is there; None where there is nothing."""
        value = self._value.get(name)
        return None if value is None else read(value)

    def _wrong(self, name: str, kind: str) -> WrongAnswerError:
        return WrongAnswerError(f"`{name}` of {self._what} is no {kind}")


def dataset(value: Any) -> Dataset:
    """Raises WrongAnswerError."""
    of = Fields(value, "a dataset")
    state = of.one_of("state", DATASET_STATES)
    return Dataset(of.matching("id", _ID), of.plain("name"), state, of.maybe("error", _failure))


def job(value: Any) -> Job:
    """Raises WrongAnswerError."""
    of = Fields(value, "a job")
    return Job(
        id=of.matching("id", _ID),
        name=of.plain("name"),
        state=of.one_of("state", JOB_STATES),
        progress=of.number("progress") or 0.0,
        created=of.text("created"),
        eta_s=of.number("eta_s"),
        position=of.count("position"),
        error=of.maybe("error", _failure),
        stages=of.each("stages", _stage),
    )


def batch(value: Any) -> tuple[str, tuple[Job, ...]]:
    """Its id and its jobs. Raises WrongAnswerError."""
    of = Fields(value, "a batch")
    return of.matching("id", _ID), of.each("jobs", job)


def result(value: Any) -> Result:
    """Raises WrongAnswerError."""
    of = Fields(value, "a result")
    digest = of.maybe("sha256", lambda _: of.matching("sha256", _DIGEST))
    return Result(of.plain("name"), of.count("bytes"), of.plain("etag"), digest)


def log_piece(value: Any) -> LogPiece:
    """Raises WrongAnswerError."""
    of = Fields(value, "a log")
    ended = of.maybe("ended", bool)
    if ended is None:
        raise WrongAnswerError("a log has no `ended`")
    return LogPiece(of.text("text", keep="\n\t"), of.count("next"), of.count("size"), ended)


def page(value: Any, read: Callable[[Any], Value]) -> tuple[tuple[Value, ...], str | None]:
    """Items of a list, and the cursor of the next page; None: that was all. Raises WrongAnswerError."""
    of = Fields(value, "a list")
    items = of.maybe("items", lambda _: of.each("items", read))
    if items is None:
        raise WrongAnswerError("a list has no `items`")
    return items, of.plain("next") or None


def _failure(value: Any) -> Failure:
    of = Fields(value, "an error")
    return Failure(
        of.text("cause") or "it does not say why", of.text("hint") or "ask the server's administrator"
    )


def _stage(value: Any) -> Stage:
    of = Fields(value, "a stage")
    return Stage(
        of.text("name"),
        of.text("state"),
        of.text("what"),
        of.count("done"),
        of.count("total"),
        of.number("seconds"),
        bool(of.maybe("reused", bool)),
    )
