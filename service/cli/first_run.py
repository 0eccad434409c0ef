"""The first run on a machine compiles the numerical kernels, for minutes: whoever waits sees so, and how far it is."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from numba.core import event

from lvba import kernels
from service.cli import kernel_cache
from service.cli.progress import Display

NOTICE = (
    "numerical kernels are compiled, once on this machine (up to two minutes); `lvba warm` does it beforehand"
)
COUNT = "kernels compiled"
_KIND = "numba:compile"


class Compilations(event.Listener):
    """Shows the kernels that are compiled in this process: a notice with the first, then how many of about how many."""

    def __init__(self, display: Display, notice: str) -> None:
        self.done = 0
        self._display, self._notice, self._total = display, notice, 0
        self._lock = threading.RLock()

    def on_start(self, event: event.Event) -> None:
        """A kernel is being compiled; those that it calls come within."""
        with self._lock:
            if self._total or not _is_ours(event):
                return
            # its own code may be there for other types only
            self._total = max(kernel_cache.missing(), 1)
            if self._notice:
                self._display.tell(self._notice)

    def on_end(self, event: event.Event) -> None:
        """One more is done, or has failed."""
        if _is_ours(event):
            with self._lock:
                self.done += 1
                self._display.progress(COUNT, self.done, max(self._total, self.done))


@contextmanager
def shown(display: Display, notice: str = NOTICE) -> Iterator[Compilations]:
    """Kernels that are compiled meanwhile in this process are shown. They are where numba's cache has no code of them."""
    compilations = Compilations(display, notice)
    with event.install_listener(_KIND, compilations):
        yield compilations


def announce_in_workers(display: Display) -> None:
    """Say that other processes on this machine will compile kernels, where the cache has no code of some of them."""
    if kernel_cache.missing():
        display.tell(f"{NOTICE}. The count may stand still meanwhile.")


def _is_ours(event: event.Event) -> bool:
    return str(event.data["dispatcher"].py_func.__module__).startswith(f"{kernels.__name__}.")
