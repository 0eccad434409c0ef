"""The thread that removes: what has had its time, and what was left behind. It may take long, so nobody waits for it."""

import logging
import threading
import time

from sqlalchemy.exc import SQLAlchemyError

from service.datasets import leftovers
from service.db.database import Database
from service.jobs import job_import
from service.jobs.retention import Retention
from service.settings import Settings
from service.system.paths import Paths

_log = logging.getLogger(__name__)
_EVERY_S = 60.0
_STRAYS_S = 3600.0
_STOP_S = 5.0


class Sweeper(threading.Thread):
    """Sweeps at the start, then every minute, and when there is something to remove; until `stop`."""

    def __init__(self, database: Database, paths: Paths, settings: Settings) -> None:
        super().__init__(name="sweeper", daemon=True)
        self._database, self._paths = database, paths
        self._retention = Retention(database, paths, settings)
        self._wake = threading.Event()
        self._ending = False
        self._strays_due = time.monotonic()

    def wake(self) -> None:
        """There is something to remove."""
        self._wake.set()

    def stop(self) -> None:
        """End; what is not removed yet is removed at the next start."""
        self._ending = True
        self.wake()
        if self.is_alive():
            self.join(_STOP_S)

    def run(self) -> None:
        while not self._ending:
            try:
                self._sweep()
            except SQLAlchemyError as error:
                _log.warning("nothing could be removed: %s", str(error).splitlines()[0])
            except Exception:
                _log.exception("not everything could be removed")
            self._wake.wait(_EVERY_S)
            self._wake.clear()

    def _sweep(self) -> None:
        self._retention.sweep()
        job_import.sweep(self._database, self._paths)
        strays = time.monotonic() >= self._strays_due
        leftovers.sweep(self._database, self._paths, uploads=strays)
        if strays:
            self._strays_due = time.monotonic() + _STRAYS_S
