"""One service among others on the same database: its name, and who of the others is surely dead."""

import fcntl
import os
import secrets
import socket
import time
from collections.abc import Collection
from pathlib import Path
from typing import IO

_SEPARATOR = "+"
_FORGOTTEN_S = 7 * 86400.0
"""For so long nobody has touched the file of a service that is surely dead, wherever it was."""


class Instance:
    """This service. Its name is never used again.

    While it lives it holds a lock on a file of its name: whoever is on the same machine can see at once that it is dead.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._host = socket.gethostname()
        self.name = f"{self._host}{_SEPARATOR}{secrets.token_hex(6)}"
        self._file: IO[str] = (folder / self.name).open("w")
        fcntl.flock(self._file, fcntl.LOCK_EX)

    def knows_dead(self, name: str) -> bool:
        """Whether the service of this name is surely gone. False: who knows."""
        if name == self.name or name.partition(_SEPARATOR)[0] != self._host:
            return False
        try:
            with (self._folder / name).open() as file:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except OSError:
            return False
        return True

    def sweep(self, needed: Collection[str]) -> None:
        """Remove the files of services that are dead.

        needed: names of services that others still have to know to be dead
        """
        os.utime(self._folder / self.name)
        for file in self._folder.iterdir():
            if file.name in needed or file.name == self.name:
                continue
            # of another machine no lock may be seen here: its services touch their files while they live
            if self.knows_dead(file.name) or time.time() - file.stat().st_mtime > _FORGOTTEN_S:
                file.unlink(missing_ok=True)

    def close(self) -> None:
        """This service ends."""
        (self._folder / self.name).unlink(missing_ok=True)
        self._file.close()


class Watch:
    """Whose heart stands still, by this machine's steady clock: that of the wall may jump, or differ among machines."""

    def __init__(self, patience: float) -> None:
        self._patience = patience
        self._seen: dict[str, tuple[tuple[str, int, int], float]] = {}

    def stands_still(self, work: str, owner: str, attempt: int, heartbeat: int) -> bool:
        """Whether the heartbeat of this work has been the same for longer than a lease holds."""
        beat, since = self._seen.get(work, (None, 0.0))
        if beat != (owner, attempt, heartbeat):
            self._seen[work] = ((owner, attempt, heartbeat), time.monotonic())
            return False
        return time.monotonic() - since > self._patience

    def keep_only(self, works: set[str]) -> None:
        """Forget what is nobody's any more."""
        self._seen = {work: seen for work, seen in self._seen.items() if work in works}
