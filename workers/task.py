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
from lvba.io import no_links
from lvba.plan import MissingError, Step
from workers import local, sending, versions
from workers.store import ZarrStore
from workers.url_store import open_store

_ALONE = threading.Lock()
"""numba's simplest threading layer ends the process when two threads enter it: one step at a time in each process."""
_kept: dict[str, Any] = {}
"""Arguments of the last step, and the last recording (or part of one) that a step needed."""
_seen: dict[str, str] = {}
"""The store that this process worked on last, and the plan that it found there."""
_MANY = 8
"""Inputs: a step that is made from more stands for all parts, and may need memory that steps of single parts left."""
_REPORT_S = _LOOK_SECONDS = 0.25
_PATIENCE_SECONDS = 1.25


class UnwantedError(Exception):
    """Nobody waits for this step any more: it was canceled, or its driver is gone."""


def make(
    place: str,
    sent: str,
    key: str,
    outline: str,
    function: Callable[..., Any],
    topic: str,
    version: str,
    without_links: tuple[str, ...] = (),
) -> dict[str, Any]:
    """Make one artifact, unless it is there already.

    place, sent: the store, and the key there of the plan; outline: of the step (see `sending`)
    topic: where progress is told; version: of the plan
    without_links: folders below which the driver follows no link, and so does not this process
    Returns a few hundred bytes: {"record": fields of a StageRecord}, or {"missing": keys} of inputs that are not there
    (any more).
    """
    report = Reporter(topic, key)
    with _ALONE, _ended_where_unwanted(report):
        _check_version(version)
        no_links.refuse_below(without_links)
        store = open_store(place)
        _check_seen(place, sent, store)
        step = sending.receive(outline, key, function)
        _recall(step, store)
        report("", 0, 0)
        if key in store:
            return {"record": asdict(local.recorded(step, store))}
        missing = [needed for needed in dict.fromkeys(step.needs_at_once) if not _is_readable(needed, store)]
        if missing:
            return {"missing": missing}
        _keep(step, store)
        if len(step.needs) > _MANY:
            local.give_back_memory()
        try:
            return {"record": asdict(local.make(step, store, report, version))}
        except MissingError as gone:
            return {"missing": [gone.key]}


def _is_readable(key: str, store: ZarrStore) -> bool:
    """Read it at once, as the step needs it: what is damaged after a mere look would be an error in its midst."""
    try:
        store[key]
    except KeyError:
        return False
    return True


def _recall(step: Step, store: ZarrStore) -> None:
    """Give the store what this process still has of the step's inputs, and forget what would be too much to hold."""
    inputs = set(filter(sending.is_input, step.needs))
    other = any(map(sending.is_recording, inputs))
    for key in list(_kept):
        if key in inputs:
            store.know(key, _kept[key])
        elif other or not sending.is_recording(key):
            del _kept[key]


def _keep(step: Step, store: ZarrStore) -> None:
    for key in filter(sending.is_input, step.needs):
        _kept[key] = store[key]


class Reporter:
    """Progress of the task that is running in this thread, as events of the scheduler. Raises UnwantedError."""

    def __init__(self, topic: str, step: str) -> None:
        self._worker = get_worker()
        self._task = self._worker.get_current_task()
        self._topic, self._step = topic, step
        self._what: str | None = None
        self._began = self._reported = 0.0

    def __call__(self, what: str, done: int, total: int) -> None:
        if self.is_unwanted():
            raise UnwantedError(self._step)
        now = time.monotonic()
        if what != self._what:
            self._what, self._began, self._reported = what, now, 0.0
        if now - self._reported >= _REPORT_S:
            self._reported = now
            self._report({"what": what, "done": done, "total": total, "seconds": round(now - self._began, 3)})

    def _report(self, facts: dict[str, Any]) -> None:
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


def _check_seen(place: str, sent: str, store: ZarrStore) -> None:
    """That this is the store of the driver, and not a folder of the same name on another machine."""
    if _seen.get(place) == sent:
        return
    if sent not in store:
        where = f"{place}, seen from {get_worker().address}"
        mend = "choose a folder that all machines share, or a URL, with --store"
        raise InputError(where, "does not hold the plan", mend)
    _seen.clear()
    _seen[place] = sent


def _check_version(version: str) -> None:
    if version != versions.key_version():
        where = f"worker {get_worker().address}"
        raise InputError(where, "has another version of lvba than the driver", "install the same on both")
