"""One step of a plan as a task: what a worker process does, and how it tells of it."""

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from typing import Any

from distributed import get_worker

from lvba.errors import InputError
from lvba.plan import Step
from workers import local, sending, versions
from workers.store import ZarrStore
from workers.url_store import open_store

_ALONE = threading.Lock()
"""numba's simplest threading layer ends the process when two threads enter it: one step at a time in each process."""
_kept: dict[str, Any] = {}
"""The plan that this process works for, and its recording: images are kept in memory as long as that lives."""
_TELL_SECONDS = _LOOK_SECONDS = 0.25
_PATIENCE_SECONDS = 1.25


class UnwantedError(Exception):
    """Nobody waits for this step any more: it was canceled, or its driver is gone."""


def make(place: str, sent: str, key: str, function: Callable[..., Any], topic: str) -> dict[str, Any]:
    """Make one artifact, unless it is there already.

    place, sent: the store, and the key there of the plan (see `sending`)
    topic: where progress is told
    Returns a few hundred bytes: {"record": fields of a StageRecord}, or {"missing": keys} of inputs that are not there
    (any more).
    """
    report = Reporter(topic, key)
    with _ALONE, _ended_where_unwanted(report):
        store = _open(place, sent)
        try:
            step, version = sending.receive(store, sent, key, function)
        except KeyError:
            raise _unseen(place) from None
        _keep(sent, step, store)
        _check_version(version)
        report("", 0, 0)
        if key in store:
            return {"record": asdict(local.recorded(step, store))}
        missing = [needed for needed in step.needs if needed not in store]
        if missing:
            return {"missing": missing}
        return {"record": asdict(local.make(step, store, report, version))}


def _open(place: str, sent: str) -> ZarrStore:
    """The store, with what this process knows of the plan."""
    if sent not in _kept:
        _kept.clear()
    store = open_store(place)
    for key, value in _kept.items():
        store.know(key, value)
    return store


def _keep(sent: str, step: Step, store: ZarrStore) -> None:
    for key in [sent, *filter(sending.is_input, step.needs)]:
        if key in store:
            _kept[key] = store[key]


class Reporter:
    """Progress of the task that is running in this thread, as events of the scheduler. Raises UnwantedError."""

    def __init__(self, topic: str, step: str) -> None:
        self._worker = get_worker()
        self._task = self._worker.get_current_task()
        self._topic, self._step = topic, step
        self._what: str | None = None
        self._began = self._told = 0.0

    def __call__(self, what: str, done: int, total: int) -> None:
        if self.is_unwanted():
            raise UnwantedError(self._step)
        now = time.monotonic()
        if what != self._what:
            self._what, self._began, self._told = what, now, 0.0
        if now - self._told >= _TELL_SECONDS:
            self._told = now
            self._tell({"what": what, "done": done, "total": total, "seconds": round(now - self._began, 3)})

    def _tell(self, facts: dict[str, Any]) -> None:
        self._worker.log_event(self._topic, {"step": self._step, "process": os.getpid(), **facts})

    def is_unwanted(self) -> bool:
        """The scheduler takes a task back when it is canceled and when its client is gone; the thread must ask."""
        task = self._worker.state.tasks.get(self._task)
        return task is None or task.state != "executing" or self._worker.status.name != "running"


@contextmanager
def _ended_where_unwanted(report: Reporter) -> Iterator[None]:
    """Ends the process where an unwanted step does not report for a while: its nanny starts a new one.

    Compiled code cannot be interrupted, and an artifact is either whole or not there.
    """
    done = threading.Event()

    def watch() -> None:
        while not done.wait(_LOOK_SECONDS):
            if report.is_unwanted() and not done.wait(_PATIENCE_SECONDS):
                os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
    try:
        yield
    finally:
        done.set()


def _unseen(place: str) -> InputError:
    where = f"{place}, seen from {get_worker().address}"
    return InputError(
        where, "does not hold the plan", "choose a folder that all machines share, or a URL, with --store"
    )


def _check_version(version: str) -> None:
    if version != versions.key_version():
        where = f"worker {get_worker().address}"
        raise InputError(where, "has another version of lvba than the driver", "install the same on both")
