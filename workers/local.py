"""A plan in this process: steps in order, finished ones reused, time and memory of each recorded.

An artifact is written while the next step runs. A process that is killed then has one step more to do again.
"""

import bisect
import contextlib
import ctypes
import resource
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

from lvba import plan
from lvba.plan import Plan, Step
from lvba.progress import Progress, silent
from workers.store import ZarrStore

HELD_BYTES = 1 << 28
"""Artifacts that later steps need are held in memory up to this size, so that memory does not grow with the recording."""
_LONG_SECONDS = 1.0
"""After steps that take longer, what they have freed goes back to the system, which takes up to a tenth of that time."""


@dataclass(frozen=True)
class StageRecord:
    """How one step went. Seconds and memory are those of the run that made the artifact."""

    name: str
    seconds: float
    peak_memory_mb: float
    """Peak resident memory of the process while the step ran, MB."""
    tasks: int
    reused: bool


def run(
    work: Plan,
    store: ZarrStore,
    progress: Progress = silent,
    on_step: Callable[[Step, int, int], None] | None = None,
) -> list[StageRecord]:
    """Make every artifact of the plan that the store does not hold yet; one record per step.

    on_step: called before each step with the step, its index and the number of steps
    """
    records = []
    uses = _uses(work)

    def release(index: int, but: str | None) -> None:
        later = {key: _next(uses[key], index) for key in store.held() if key in uses and key != but}
        _release(store, later, index)

    with _Writer(store) as writer:
        for index, step in enumerate(work.steps.values()):
            if on_step is not None:
                on_step(step, index, len(work.steps))
            if step.key in store:
                records.append(recorded(step, store))
            else:
                value, record = _computed(step, store, progress)
                writer.write(step.key, value, _facts(record, work.version))
                records.append(record)
                _give_back_after(record)
            release(index, writer.key)
    release(len(work.steps), None)
    return records


class _Writer:
    """Writes an artifact while the next step runs, one at a time; what is written at last is there when it is left.

    key: of the artifact that may not be there yet; its value is in memory
    """

    def __init__(self, store: ZarrStore) -> None:
        self.key: str | None = None
        self._store = store
        self._pool = ThreadPoolExecutor(1)
        self._pending: Future[None] | None = None

    def __enter__(self) -> Self:
        return self

    def write(self, key: str, value: Any, facts: dict[str, Any]) -> None:
        """Begin to write an artifact when the one before is there. Raises what writing that one raised."""
        self._wait()
        self._store.know(key, value)
        self.key, self._pending = key, self._pool.submit(self._store.put, key, value, facts)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            self._wait()
        except OSError:
            if kind is None:
                raise
        finally:
            self._pool.shutdown()

    def _wait(self) -> None:
        pending, self._pending, self.key = self._pending, None, None
        if pending is not None:
            pending.result()


def _uses(work: Plan) -> dict[str, list[int]]:
    """For each artifact the numbers of the steps that need it, ascending."""
    uses: dict[str, list[int]] = {key: [] for key in work.steps}
    for number, step in enumerate(work.steps.values()):
        for key in dict.fromkeys(step.needs):
            uses[key].append(number)
    return uses


def _next(uses: list[int], index: int) -> int | None:
    """The first step after `index` that needs an artifact."""
    position = bisect.bisect_right(uses, index)
    return uses[position] if position < len(uses) else None


def _release(store: ZarrStore, later: dict[str, int | None], index: int) -> None:
    """Forget what no step needs any more; and, beyond so many bytes, what is needed last: it will be read again.

    later: for each artifact in memory, the next step that needs it
    """
    held = 0
    for key, use in sorted(later.items(), key=lambda item: (item[1] is None, item[1])):
        held += store.size(key) if use is not None else 0
        if use is None or (held > HELD_BYTES and use > index + 1):
            store.release(key)


def make(step: Step, store: ZarrStore, progress: Progress, version: str) -> StageRecord:
    """Make one artifact and put it in the store."""
    value, record = _computed(step, store, progress)
    store.put(step.key, value, _facts(record, version))
    _give_back_after(record)
    return record


def _computed(step: Step, store: ZarrStore, progress: Progress) -> tuple[Any, StageRecord]:
    """One artifact, which is not in the store yet, and its record."""
    reset_peak_memory()
    started = time.perf_counter()
    value = plan.compute(step, store, progress)
    seconds = time.perf_counter() - started
    return value, StageRecord(step.name, round(seconds, 3), round(peak_memory_mb(), 1), 1, reused=False)


def _facts(record: StageRecord, version: str) -> dict[str, Any]:
    """What is kept with an artifact."""
    facts = asdict(record)
    facts.pop("reused")
    return {**facts, "version": version}


def _give_back_after(record: StageRecord) -> None:
    if record.seconds > _LONG_SECONDS:
        give_back_memory()


def give_back_memory() -> None:
    """Return to the system what this process has freed, where the C library can (glibc).

    It would do so by itself only at the end of its heap. Not for every step: to get pages anew takes a tenth of a
    second for each half gigabyte.
    """
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


def recorded(step: Step, store: ZarrStore) -> StageRecord:
    """The record of an artifact that the store holds."""
    facts: dict[str, Any] = store.facts(step.key)
    return StageRecord(
        step.name,
        facts.get("seconds", 0.0),
        facts.get("peak_memory_mb", 0.0),
        facts.get("tasks", 1),
        reused=True,
    )


def reset_peak_memory() -> None:
    """Start a new peak, where the system can (Linux)."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def peak_memory_mb() -> float:
    """Peak resident memory since the last reset, MB; since the process began where the system cannot reset."""
    try:
        status = Path("/proc/self/status").read_text()
        line = next(line for line in status.splitlines() if line.startswith("VmHWM:"))
        return int(line.split()[1]) * 1024 / 1e6
    except (OSError, StopIteration, ValueError):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6
