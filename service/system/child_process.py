"""The service's end of a child process: starting it, answering for it, stopping it."""

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

_PATIENCE = 10.0
"""Seconds from asking a child to stop to ending it."""


class Child:
    """A process of this program whose output goes into a file. It ends when this object does not extend its deadline."""

    def __init__(self, module: str, words: Sequence[str], output: Path, deadline_s: float) -> None:
        self._stopped: float | None = None
        with output.open("ab") as stream:
            self._process = subprocess.Popen(
                [sys.executable, "-m", module, *words],
                stdin=subprocess.PIPE,
                stdout=stream,
                stderr=stream,
                # Ctrl-C is for the service, which stops its children itself
                start_new_session=True,
                env=_environment(),
            )
        self.extend_deadline(deadline_s)

    def extend_deadline(self, seconds: float) -> None:
        """It may continue for so many seconds from now."""
        if self._stopped is None and seconds > 0 and self._process.stdin is not None:
            with suppress(BrokenPipeError):
                self._process.stdin.write(b"%f\n" % seconds)
                self._process.stdin.flush()

    def stop(self) -> None:
        """Ask it to stop; if it was asked some time ago, end it."""
        if self._stopped is None:
            self._stopped = time.monotonic()
            self._process.terminate()
        elif time.monotonic() > self._stopped + _PATIENCE:
            self._process.kill()

    def end(self) -> None:
        """End it at once, and wait until it is gone."""
        self._process.kill()
        self._process.wait()
        self._close()

    def ended(self) -> int | None:
        """Its exit code, negative for a signal; None: it runs."""
        code = self._process.poll()
        if code is not None:
            self._close()
        return code

    def _close(self) -> None:
        if self._process.stdin is not None:
            with suppress(BrokenPipeError):
                self._process.stdin.close()


def _environment() -> dict[str, str]:
    """Without what only the service may know."""
    secret = ("LVBA_DATABASE", "LVBA_DATABASE_FILE")
    environment = {name: value for name, value in os.environ.items() if name not in secret}
    # found also where the program was started from its source folder
    paths = [str(Path(__file__).parents[2]), environment.get("PYTHONPATH", "")]
    return {**environment, "PYTHONPATH": os.pathsep.join(path for path in paths if path)}
