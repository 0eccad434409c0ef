"""The thread that works the queue: takes up jobs and datasets, follows their processes, answers for them, ends them."""

import errno
import logging
import os
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from sqlalchemy.exc import SQLAlchemyError

from lvba.errors import InputError
from service.datasets.dataset_check import DatasetCheck
from service.db import leases
from service.db.database import Database
from service.db.instance import Instance, Watch
from service.db.leases import Lease
from service.db.tables import CANCELING
from service.jobs import failed_start
from service.jobs.job_run import JobRun
from service.jobs.sweeper import Sweeper
from service.settings import Settings
from service.system import descriptors, disk_space, messages
from service.system.paths import Paths

_log = logging.getLogger(__name__)
_ROUND_S = 0.2
_LOOK_S = 1.0
"""Seconds between looks at what others did: cancellations, services that died."""
_BACK_OFF_S = 2.0
"""Seconds until a job is tried again by the instance that could not continue with it."""
_LACK_S = 20.0
"""Seconds until something is begun again after that failed for want of what this service needs."""
_CHECKS = 2
"""Datasets that are checked at a time."""
_STOP_S = 15.0


class Supervisor(threading.Thread):
    """Runs until `stop`. Everything that it knows it could learn again from the database."""

    def __init__(self, database: Database, paths: Paths, settings: Settings) -> None:
        super().__init__(name="supervisor", daemon=True)
        self._database, self._paths, self._settings = database, paths, settings
        self._instance = Instance(paths.instances)
        self._watch = Watch(settings.lease_s)
        self._wake = threading.Event()
        self._ending = False
        self._works: list[JobRun | DatasetCheck] = []
        self._avoid: dict[str, float] = {}
        self._due: dict[str, float] = {}
        self._sweeper = Sweeper(database, paths, settings)
        self._renewed = time.monotonic()
        self._idle_until = 0.0
        """When to begin something again, after this service lacked what it needs for that."""
        self.healthy = True
        """False: the last round could not reach the database."""

    def wake(self) -> None:
        """There may be something to do."""
        self._wake.set()

    def sweep(self) -> None:
        """There is something to remove."""
        self._sweeper.wake()

    def stop(self) -> None:
        """Give back all work and end; waits for it."""
        self._ending = True
        self.wake()
        self.join(_STOP_S)

    def start(self) -> None:
        """Begin; here and not in the thread, so that a service without it does not come to be."""
        self._sweeper.start()
        super().start()

    def run(self) -> None:
        while not self._ending:
            self._round()
            self._wake.wait(_ROUND_S)
            self._wake.clear()
        self._sweeper.stop()
        self._give_back()
        self._instance.close()

    def _round(self) -> None:
        steps: tuple[Callable[[], None], ...] = (
            lambda: self._every("renew", self._settings.lease_s / 5, self._renew),
            self._follow,
            lambda: self._every("look", _LOOK_S, self._look),
            self._claim,
            lambda: self._every("instances", 60.0, self._sweep_instances),
        )
        for step in steps:
            try:
                step()
                self.healthy = True
            except SQLAlchemyError as error:
                self.healthy = False
                _log.warning("the database cannot be reached: %s", str(error).splitlines()[0])
                time.sleep(_ROUND_S)
            except Exception:
                # whatever goes wrong with one piece of work must not leave all others without a supervisor
                _log.exception("a round of the supervisor failed")

    def _every(self, name: str, seconds: float, step: Callable[[], object]) -> None:
        if time.monotonic() >= self._due.get(name, 0.0):
            step()
            self._due[name] = time.monotonic() + seconds

    def _renew(self) -> None:
        if not self._works:
            return
        began = time.monotonic()
        leases.renew(self._database, self._instance.name)
        for work in self._works:
            work.child.extend_deadline(began + self._settings.lease_s * 0.7 - time.monotonic())

    def _follow(self) -> None:
        for work in list(self._works):
            if not self._goes_on(work):
                self._works.remove(work)
                self.sweep()
                self._avoid[work.lease.id] = time.monotonic() + _BACK_OFF_S

    def _goes_on(self, work: JobRun | DatasetCheck) -> bool:
        """Follow one piece of work. What goes wrong with it, such as a file that is gone, is the end of it alone."""
        try:
            return work.follow()
        except SQLAlchemyError:
            raise
        except Exception as error:
            _log.warning("%s cannot be followed: %s", work.lease.id, messages.of_error(error))
            work.give_up(error)
            return False

    def _look(self) -> None:
        held = leases.held(self._database, self._instance.name)
        for work in self._works:
            state = held.get((work.lease.id, work.lease.attempt))
            if state is None:
                work.child.end()
            elif state == CANCELING:
                work.stop(for_good=True)
        self._give_up_strays(held)
        leases.take_over(self._database, self._instance, self._watch)

    def _give_up_strays(self, held: dict[tuple[str, int], str]) -> None:
        """What this service holds on paper, but could not begin or end for want of the database."""
        known = {(work.lease.id, work.lease.attempt) for work in self._works}
        for stray in set(held) - known:
            for kind in leases.KINDS:
                lease = Lease(kind, stray[0], self._instance.name, stray[1])
                leases.lose(self._database, lease, "it could not be begun")

    def _sweep_instances(self) -> None:
        with suppress(OSError):  # what is left is for the next time
            self._instance.sweep(leases.owners(self._database))

    def _claim(self) -> None:
        if disk_space.lacking(self._paths.root):
            return  # what is begun on a full disk only fails; `shown` says so of what waits
        free = disk_space.free_bytes(self._paths.root)
        if time.monotonic() < self._idle_until:
            return
        if lack := descriptors.lacking():
            self._idle_until = time.monotonic() + _BACK_OFF_S
            _log.warning("nothing can be begun: %s", lack)
            return
        now = time.monotonic()
        self._avoid = {job: until for job, until in self._avoid.items() if until > now}
        while self._count(DatasetCheck) < _CHECKS:
            dataset = leases.claim_dataset(self._database, self._instance.name)
            if dataset is None:
                break
            if not self._begin(DatasetCheck, dataset):
                return
        while self._count(JobRun) < self._settings.jobs:
            limit = self._settings.limits.running_jobs
            job = leases.claim_job(self._database, self._instance.name, limit, self._avoid, free)
            if job is None or not self._begin(JobRun, job):
                break

    def _begin(self, kind: type[JobRun] | type[DatasetCheck], row: Any) -> bool:
        """Start what was taken up; False: this service lacks what it needs for that, and gives it back as it was.

        What cannot be started for another reason, such as a file in the place of its folder, has failed.
        """
        lease = Lease(type(row), row.id, self._instance.name, row.attempt)
        try:
            self._works.append(kind(self._database, self._paths, self._settings, row, self._instance.name))
        except (OSError, MemoryError, InputError) as error:
            cause = error.__cause__ if isinstance(error, InputError) else error
            if cause is not None and descriptors.is_lack(cause):
                why = os.strerror(getattr(cause, "errno", 0) or errno.ENOMEM)
                _log.warning("%s cannot be begun: %s", row.id, why)
                self._idle_until = time.monotonic() + _LACK_S
                leases.take_back(self._database, lease, why)
                return False
            why = messages.of_error(error)
            _log.warning("%s cannot be begun: %s", row.id, why)
            failed_start.fail(self._database, lease, why.replace(str(self._paths.root), "DATA"))
        return True

    def _count(self, kind: type) -> int:
        return sum(isinstance(work, kind) for work in self._works)

    def _give_back(self) -> None:
        deadline = time.monotonic() + _STOP_S * 0.8
        while self._works:
            for work in self._works:
                if time.monotonic() > deadline:
                    work.child.end()
                else:
                    work.stop(for_good=False)
            try:
                self._follow()
            except SQLAlchemyError as error:
                _log.warning("work could not be given back: %s", str(error).splitlines()[0])
                return
            time.sleep(0.05)
