"""Being told to stop, by Ctrl-C or by SIGTERM.

The signal handler raises nothing: an exception from there is lost, or ends the process, where it meets a callback of a
compiled library (numba's compiler calls back into Python). It takes note; the next report of progress raises. Where none
comes in time, or the signal comes again, the process ends at once: what is finished is on disk, nothing else counts.
"""

import os
import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType

_PATIENCE = 1.5
"""Seconds from the signal to the next report of progress; after them nobody asks any more."""

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it: 128 and the number of the signal."""

_asked = threading.Event()
_numbers: list[int] = []
_timers: list[threading.Timer] = []
_last_words: list[Callable[[], object]] = [lambda: sys.stderr.write("lvba: stopped\n")]


def install() -> None:
    """From now on both signals are noted, and end the process even where nobody looks."""
    signal.signal(signal.SIGINT, _note)
    signal.signal(signal.SIGTERM, _note)


def say_at_last(words: Callable[[], object]) -> None:
    """What is called before the process ends without being asked; replaces what was given before."""
    _last_words[:] = [words]


def check() -> None:
    """Raises KeyboardInterrupt if a signal came: for places where nothing is lost by that."""
    if _asked.is_set():
        raise KeyboardInterrupt


def code() -> int:
    """The exit code after being told to stop: INTERRUPTED by Ctrl-C, 1 by SIGTERM."""
    return INTERRUPTED if signal.SIGINT in _numbers else 1


def heard() -> None:
    """The command has ended by itself: no need to force it."""
    for timer in _timers:
        timer.cancel()


def _note(number: int, frame: FrameType | None) -> None:
    _numbers.append(number)
    if _asked.is_set():
        _end()
    _asked.set()
    timer = threading.Timer(_PATIENCE, _end)
    timer.daemon = True
    _timers.append(timer)
    timer.start()


def _end() -> None:
    _last_words[0]()
    sys.stderr.flush()
    os._exit(code())
