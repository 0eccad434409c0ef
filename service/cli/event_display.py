"""A display that also writes what a run does into a file (`--events FILE`; `jobs.run_events` says how)."""

import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TextIO

from lvba.errors import InputError
from service.cli.progress import Display
from service.jobs.run_events import EndReason

_WAIT = 0.25
"""Seconds between two progress lines of one count."""


class EventDisplay(Display):
    """A display that also writes events."""

    def __init__(
        self,
        events: Path,
        clock: Callable[[], float] = time.monotonic,
        *,
        quiet: bool = False,
        check: Callable[[], None] = lambda: None,
    ) -> None:
        super().__init__(clock=clock, quiet=quiet, check=check)
        self._clock = clock
        self._file: TextIO = _open(events)
        self._sent_stage = self._sent_what = ""
        self._sent_at = float("-inf")

    def stages(self, names: Sequence[str]) -> None:
        super().stages(names)
        self._send("stages", names=list(names))

    def first_stages(self, names: Sequence[str]) -> None:
        self._send("stages", names=list(names))

    def stage(self, name: str, index: int, total: int, reused: bool | None = None) -> None:
        self._sent_stage, self._sent_what = name, ""
        index, total = self._counted(name, index, total)
        self._send("stage", name=name, index=index, total=total, reused=reused)
        super().stage(name, index, total, reused)

    def progress(self, what: str, done: int, total: int) -> None:
        super().progress(what, done, total)
        now = self._clock()
        if what == self._sent_what and now - self._sent_at < _WAIT:
            return
        self._sent_what, self._sent_at = what, now
        self._send("progress", stage=self._sent_stage, what=what, done=done, total=total)

    def record(self, name: str, seconds: float, peak_memory_mb: float, reused: bool) -> None:
        self._send("record", name=name, seconds=seconds, peak_memory_mb=peak_memory_mb, reused=reused)

    def end(self, code: int, reason: EndReason, message: str, error: BaseException | None) -> None:
        named = {"where": "", "problem": "", "mend": ""}
        if isinstance(error, InputError):
            named = {"where": error.where, "problem": error.problem, "mend": error.mend}
        self._send("end", code=code, reason=reason, message=message, **named)

    def _send(self, event: str, **facts: Any) -> None:
        # one write a line: whoever reads along sees whole lines, but for the last
        self._file.write(json.dumps({"event": event, "time": time.time(), **facts}) + "\n")
        self._file.flush()


def _open(events: Path) -> TextIO:
    try:
        return events.open("a", encoding="utf-8")
    except OSError as error:
        raise InputError(
            events, f"cannot be written ({error.strerror})", "give --events another file"
        ) from None
