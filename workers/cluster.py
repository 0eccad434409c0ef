"""A plan on Dask: a task for each step, as soon as what it needs is there.

Nothing that matters lives in Dask. What is finished is in the store; when workers, the scheduler or this process die,
what is not there is asked for again. Futures hold a few hundred bytes.
"""

import itertools
import logging
import time
import uuid
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from queue import Empty, SimpleQueue
from typing import Any

from distributed import CancelledError, Client, Future, KilledWorker
from distributed.comm.core import CommClosedError

from lvba import plan
from lvba.errors import ArtifactError
from lvba.io import no_links
from lvba.plan import Plan, Step
from lvba.progress import Progress, silent
from workers import sending, task
from workers.connection import ClusterError, Scheduler
from workers.frontier import Frontier
from workers.local import StageRecord
from workers.sending import Sender
from workers.url_store import open_store

_log = logging.getLogger(__name__)

ATTEMPTS = 4
"""How often a step is tried when workers or schedulers are lost under it, or files cannot be read for a moment."""
FIRST_CONTACT_SECONDS = 10.0
"""How long a scheduler may take to answer at first ..."""
RECONNECT_SECONDS = 600.0
"""... and to come back after it was lost."""
PARDONS = 25
"""How often a step that had begun less often than that is given out again after Dask gave it up."""
LIVE = 500
"""How many steps are handed to the scheduler at a time; the others wait here."""
_WAIT_SECONDS = 0.05
_LONELY_SECONDS = 5.0


def run(
    work: Plan,
    place: str,
    scheduler: Scheduler,
    progress: Progress = silent,
    on_step: Callable[[Step, int, int], None] | None = None,
    check: Callable[[], None] = lambda: None,
) -> list[StageRecord]:
    """Make every artifact of the plan that the store does not hold yet; one record per step, in the plan's order.

    place: folder or URL of the store, as the workers see it
    on_step: called when a step begins with the step, its index and the number of steps
    check: called many times a second; what it raises stops the tasks and goes through
    Raises what a step raises, after everything that does not need this step is made. ClusterError: a step that lost its
    worker too often, or no scheduler.
    """
    sender = sending.Sender(work, open_store(place))
    execution = Execution(work, place, sender, scheduler, progress, on_step, check)
    try:
        return execution.run()
    finally:
        execution.stop()


def latest_progress(client: Client, place: str) -> dict[str, dict[str, Any]]:
    """The last thing told about each step, by key, of the run over a store: for who did not listen, or missed something.

    Each has `what`, `done`, `total`, the `seconds` since this count began, and the `process`.
    """
    return {event["step"]: event for _, event in client.get_events(topic(place))}


def topic(place: str) -> str:
    """Where the run over a store tells its progress: one run at a time has the store."""
    return f"lvba-{plan.digest(place)[:12]}"


class Execution:
    """One run of a plan. Only `run` and `stop` are for others."""

    def __init__(
        self,
        work: Plan,
        place: str,
        sender: Sender,
        scheduler: Scheduler,
        progress: Progress,
        on_step: Callable[[Step, int, int], None] | None,
        check: Callable[[], None],
    ) -> None:
        self._work, self._place, self._sender, self._scheduler = work, place, sender, scheduler
        self._progress, self._on_step, self._check = progress, on_step, check
        self._numbers = {key: number for number, key in enumerate(work.steps)}
        self._id = uuid.uuid4().hex[:12]
        self._frontier = Frontier(work)
        self._news: SimpleQueue[dict[str, Any] | None] = SimpleQueue()
        """What workers tell of steps; None: one is done."""
        self._records: dict[str, StageRecord] = {}
        self._running: dict[str, Future[Any]] = {}
        self._failures: dict[str, Exception] = {}
        self._serial = itertools.count()
        self._attempts: Counter[str] = Counter()
        self._begun: Counter[str] = Counter()
        self._pardons: Counter[str] = Counter()
        self._client: Client = self._connect(FIRST_CONTACT_SECONDS)
        self._heard = time.monotonic()

    def run(self) -> list[StageRecord]:
        """See `run` of the module."""
        while True:
            self._submit_what_is_ready()
            if not self._running:
                break
            self._check()
            self._take_news()
            self._settle_what_is_done()
        for key in self._work.steps:
            if key in self._failures:
                raise self._failures[key]
        return [self._records[key] for key in self._work.steps]

    def stop(self) -> None:
        """Take back what still runs; workers notice at their next report of progress."""
        if self._running and self._client.status == "running":
            with suppress(CommClosedError):  # with its scheduler gone there is nothing to take back
                self._client.cancel(list(self._running.values()), force=True, asynchronous=False)
        self._disconnect()

    # the frontier

    def _submit_what_is_ready(self) -> None:
        while len(self._running) < LIVE and (key := self._frontier.take()) is not None:
            self._submit(self._work.steps[key])

    def _submit(self, step: Step) -> None:
        self._attempts[step.key] += 1
        if self._attempts[step.key] > ATTEMPTS:
            self._failures[step.key] = ClusterError(
                f"{step.name}: lost {ATTEMPTS} times; see the workers' logs"
            )
            return
        future = self._client.submit(
            task.make,
            self._place,
            self._sender.plan,
            step.key,
            self._sender.outline(step),
            step.function,
            topic(self._place),
            self._work.version,
            no_links.refused(),
            key=f"{step.key}-{self._id}-{next(self._serial)}",
            pure=False,
            priority=self._frontier.priority(step.key),
        )
        self._running[step.key] = future
        future.add_done_callback(lambda _: self._news.put(None))

    def _take_news(self) -> None:
        """What was told since the last call, or within a moment from now; a step that is done ends the wait."""
        with suppress(Empty):
            self._show_event(self._news.get(timeout=_WAIT_SECONDS))
        self._take_news_at_hand()
        self._say_if_lonely()

    def _take_news_at_hand(self) -> None:
        with suppress(Empty):
            while True:
                self._show_event(self._news.get_nowait())

    def _settle_what_is_done(self) -> None:
        # looked at, and not left to callbacks: one that is lost would leave a run waiting for ever
        done = [key for key, future in self._running.items() if future.done()]
        # a begin arrives before the end of its step: read it before that end is judged
        self._take_news_at_hand()
        if self._client.status != "running" or any(self._running[key].cancelled() for key in done):
            self._start_over()
            return
        for key in done:
            future = self._running[key]
            try:
                outcome = future.result() if future.status == "finished" else None
            except (OSError, CancelledError):  # the scheduler died after it told that the step is done
                self._start_over()
                return
            del self._running[key]
            if outcome is not None:
                self._accept(key, outcome)
            elif future.status == "error":
                self._fail(key, future.exception())
            else:  # done, and its worker gone before it could be told of
                self._frontier.again(key)

    def _accept(self, key: str, outcome: dict[str, Any]) -> None:
        if "record" in outcome:
            self._records[key] = StageRecord(**outcome["record"])
            self._frontier.made(key)
            return
        for missing in outcome["missing"]:
            _log.warning("%s is gone; it is made again", missing)
            self._sender.forget(missing)
        self._frontier.lost(missing for missing in outcome["missing"] if missing in self._work.steps)
        self._frontier.again(key)

    def _fail(self, key: str, error: Exception) -> None:
        name = self._work.steps[key].name
        if isinstance(error, KilledWorker) and self._is_innocent(key):
            self._attempts[key] -= 1
            self._frontier.again(key)
        elif isinstance(error, KilledWorker):
            self._failures[key] = ClusterError(
                f"{name}: its worker process died again and again, most often for lack of memory; give each worker more "
                "(--memory-limit), or cut the recording into smaller parts (--set split.memory_gb=GB)"
            )
        elif self._may_pass(error) and self._attempts[key] < ATTEMPTS:
            _log.warning("%s is tried again (%s)", name, error)
            self._frontier.again(key)
        else:
            self._failures[key] = error

    def _is_innocent(self, key: str) -> bool:
        """Whether workers died before this step's turn: Dask blames what waits on them just as what they were doing."""
        self._pardons[key] += 1
        return self._begun[key] < ATTEMPTS and self._pardons[key] < PARDONS

    def _may_pass(self, error: Exception) -> bool:
        """Whether trying again makes sense: never for what the user gave or what the method found."""
        return isinstance(error, OSError | ArtifactError | task.UnwantedError)

    # the connection

    def _connect(self, seconds: float) -> Client:
        client = self._scheduler.connect(seconds, self._check)
        client.subscribe_topic(topic(self._place), lambda event: self._news.put(event[1]))
        return client

    def _disconnect(self) -> None:
        # on a busy machine a client may need longer, most of all one whose scheduler is gone: it ends with this process
        with suppress(TimeoutError):
            self._client.close(timeout=1)

    def _start_over(self) -> None:
        """The scheduler is gone, and with it everything that it knew."""
        _log.warning("lost the scheduler at %s; waiting for it to come back", self._scheduler.address)
        waiting, self._running = list(self._running), {}
        self._disconnect()
        self._client = self._connect(RECONNECT_SECONDS)
        self._heard = time.monotonic()
        for key in waiting:
            if not self._begun[key]:
                self._attempts[key] -= 1  # it was only waiting for its turn
            self._frontier.again(key)

    # what people see

    def _show_event(self, event: dict[str, Any] | None) -> None:
        if event is None:
            return
        self._heard = time.monotonic()
        key = event["step"]
        step = self._work.steps.get(key)
        if step is None:
            return  # of a run before this one, over the same store
        if not event["what"]:
            self._begin(step, event["process"])
        elif key in self._running:
            what = event["what"] if len(self._running) == 1 else f"{step.name}: {event['what']}"
            self._progress(what, event["done"], event["total"])

    def _begin(self, step: Step, process: int) -> None:
        if self._begun[step.key]:
            _log.warning("%s begins again", step.name)
        self._begun[step.key] += 1
        _log.debug("%s begins in process %d", step.name, process)
        if self._on_step is not None:
            self._on_step(step, self._numbers[step.key], len(self._work.steps))

    def _say_if_lonely(self) -> None:
        if time.monotonic() - self._heard < _LONELY_SECONDS:
            return
        self._heard = float("inf")
        with suppress(CommClosedError):  # a lost scheduler is noticed where results are taken
            self._warn_without_workers()

    def _warn_without_workers(self) -> None:
        if not self._client.scheduler_info()["workers"]:
            _log.warning("no workers at %s yet; waiting for them", self._scheduler.address)
