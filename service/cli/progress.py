"""How far a run is: one line that moves on a terminal, plain lines elsewhere. Both on stderr."""

import shutil
import sys
import time
from collections.abc import Callable, Sequence
from typing import TextIO

from service.jobs.run_events import EndReason

_BAR = 24
_REDRAW = 0.1
_PLAIN = 10.0
"""Seconds between redraws of the bar, and between plain lines of one stage."""


class Display:
    """Shows stages (`stage`) and counts within them (`progress`, as lvba calls it).

    check: called at every one of these, shown or not; what it raises goes through.
    """

    def __init__(
        self,
        stream: TextIO | None = None,
        clock: Callable[[], float] = time.monotonic,
        *,
        quiet: bool = False,
        check: Callable[[], None] = lambda: None,
    ) -> None:
        self._quiet = quiet
        self._check = check
        self._stream = stream or sys.stderr
        self._clock = clock
        self._terminal = self._stream.isatty()
        self._stage = self._what = ""
        self._names: list[str] = []
        self._began = self._what_began = self._shown = clock()
        self._width = 0

    def stages(self, names: Sequence[str]) -> None:
        """The names of all stages, in order: from now on, each is counted by its place among them."""
        self._names = list(names)

    def first_stages(self, names: Sequence[str]) -> None:
        """The names of the stages that come before all are known: they are not counted here."""

    def stage(self, name: str, index: int, total: int, reused: bool | None = None) -> None:
        """A stage begins: its name, its index, how many there are, and whether it is there already (None: not known)."""
        self._check()
        self.clear()
        if self._quiet:
            return
        index, total = self._counted(name, index, total)
        self._stage = f"[{index + 1}/{total}] {name}" if total > 1 else name
        self._what, self._began = "", self._clock()
        self._shown = self._began
        if self._terminal:
            self._draw(self._stage)
        else:
            self._line(self._stage)

    def _counted(self, name: str, index: int, total: int) -> tuple[int, int]:
        """Index of a stage and how many there are: one count for all that a command does, whoever announces the stage."""
        return (self._names.index(name), len(self._names)) if name in self._names else (index, total)

    def progress(self, what: str, done: int, total: int) -> None:
        """`done` of `total` pieces of `what` are finished; rate and time left are those of this count."""
        self._check()
        if self._quiet:
            return
        now = self._clock()
        if what != self._what:
            self._what, self._what_began = what, now
        wait = _REDRAW if self._terminal else _PLAIN
        if now - self._shown < wait:
            return
        self._shown = now
        text = f"{self._stage}: {what} {counts(done, total, now - self._what_began)}"
        if self._terminal:
            self._draw(f"{text} {bar(done, total)}")
        else:
            self._line(text)

    def record(self, name: str, seconds: float, peak_memory_mb: float, reused: bool) -> None:
        """How a stage went, told when all have ended."""

    def end(self, code: int, reason: EndReason, message: str, error: BaseException | None) -> None:
        """The command has ended: its exit code, why, and its last words."""

    def note(self, text: str) -> None:
        """A line that stays."""
        self.clear()
        self._line(text)

    def tell(self, text: str) -> None:
        """A line about the stage that runs; not when quiet."""
        if not self._quiet:
            self.note(f"{self._stage}: {text}" if self._stage else text)

    def clear(self) -> None:
        """Take the moving line away."""
        if self._width:
            self._stream.write("\r" + " " * self._width + "\r")
            self._stream.flush()
            self._width = 0

    def _draw(self, text: str) -> None:
        # a line that wraps could not be taken back
        text = text[: shutil.get_terminal_size().columns - 1]
        self._stream.write("\r" + text.ljust(self._width))
        self._stream.flush()
        self._width = len(text)

    def _line(self, text: str) -> None:
        self._stream.write(text + "\n")
        self._stream.flush()


def counts(done: int, total: int, seconds: float) -> str:
    """For example `34/100, 12.3/s, 0:05 left`."""
    text = f"{done}/{total}" if total else f"{done}"
    if done and seconds > 0:
        rate = done / seconds
        text += f", {rate:.3g}/s"
        if total > done:
            text += f", {clock_text((total - done) / rate)} left"
    return text


def bar(done: int, total: int) -> str:
    """For example `#########---------------`; empty where the total is not known."""
    if total <= 0:
        return ""
    filled = min(_BAR, _BAR * done // total)
    return "#" * filled + "-" * (_BAR - filled)


def clock_text(seconds: float) -> str:
    """Seconds as `m:ss` or `h:mm:ss`."""
    whole = round(seconds)
    hours, minutes = whole // 3600, whole // 60 % 60
    return f"{hours}:{minutes:02}:{whole % 60:02}" if hours else f"{minutes}:{whole % 60:02}"
