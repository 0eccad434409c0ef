"""One job that runs: its process, what it tells, and how it ends."""

import json
import logging
import signal
import time
from pathlib import Path
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from lvba import config
from lvba.errors import InputError
from lvba.io import files
from lvba.pipeline import Config
from service.datasets import recording_roots
from service.db import journal, leases
from service.db.database import Database
from service.db.leases import Lease
from service.db.tables import CANCELED, CANCELING, DONE, FAILED, QUEUED, RUNNING, Dataset, Job, Outcome
from service.jobs import job_import, results, tail, timeline, webhooks
from service.jobs.run_events import VIEWER, EndReason
from service.settings import Settings
from service.system import durable, messages
from service.system.child_process import Child
from service.system.deadline import EXIT_LEASE_EXPIRED
from service.system.disk_space import EXIT_DISK_FULL, LEAST_FREE, free_bytes
from service.system.file_lock import EXIT_LOCKED
from service.system.paths import Paths, now, size_of

_log = logging.getLogger(__name__)
_WRITE_S = 1.0
"""Seconds between two events of progress of a job."""
_HISTORY = 20


class JobRun:
    """A job under a lease of this service."""

    def __init__(self, database: Database, paths: Paths, settings: Settings, job: Job, owner: str) -> None:
        self._database, self._paths, self._settings = database, paths, settings
        self.lease = Lease(Job, job.id, owner, job.attempt)
        self._events = paths.events(job.id, job.attempt)
        self._log = paths.log(job.id)
        self._written: list[str] | None = None
        """What the result held when its last stage began."""
        self._wrote_at = 0.0
        self._log_bytes = -1
        self._progress: timeline.JobEvent | None = None
        self._pending: list[timeline.JobEvent] = []
        """Events that are not in the journal yet."""
        self._lost = ""
        """What of its files is gone without which it cannot end well."""
        self._stopping = False
        self._disk_was_full: bool | None = None
        """When its process ended; None: it has not."""
        with database.read() as session:
            dataset = session.get_one(Dataset, job.dataset_id)
            history = _history(session)
        self._timeline = timeline.Timeline(
            timeline.time_fractions(history), job.estimate.get("seconds") or 0.0, time.monotonic()
        )
        self._recording = paths.recording(dataset.id, dataset.folder)
        self._name = dataset.name
        self._import = job_import.prepare(database, paths, job, self._recording)
        self.child = self._start(job)

    def _start(self, job: Job) -> Child:
        folder = self._paths.job(job.id)
        durable.make_folder(folder)
        self._paths.notes(job.id).unlink(missing_ok=True)
        wanted = config.from_mapping(Config, job.config)
        files.write_text(folder / "config.yaml", config.to_yaml(wanted))
        with self._log.open("a") as log:
            log.write(f"--- attempt {job.attempt}\n")
        self._tail = tail.Tail(self._events)
        task = {
            "lock": str(folder / ".lock"),
            "without_links": recording_roots.folders(self._recording, self._settings),
            "out": str(self._paths.out(job.id)),
            "notes": str(self._paths.notes(job.id)),
        }
        return Child(
            "service.cli.job_process",
            [json.dumps(task), *self._command(job, folder)],
            self._log,
            self._settings.lease_s * 0.7,
        )

    def _command(self, job: Job, folder: Path) -> list[str]:
        arguments = ["run", str(self._import.source if self._import else self._recording)]
        if self._import is not None:
            arguments += [f"--import={folder / 'import.yaml'}", f"--recording={self._import.out}"]
            files.write_text(folder / "import.yaml", config.to_yaml(self._import.options))
        arguments += [f"--out={self._paths.out(job.id)}"]
        arguments += [f"--config={folder / 'config.yaml'}", f"--events={self._events}", "--viewer"]
        arguments += [f"--name={self._name}"]
        options = {
            "reference": self._recording / "reference" if job.reference else None,
            "redo": job.redo,
            "threads": self._settings.threads,
            "workers": self._settings.workers,
            "memory-limit": self._settings.memory_limit,
            "scheduler": self._settings.scheduler,
            "tls-ca": self._settings.tls_ca,
            "tls-cert": self._settings.tls_cert,
            "tls-key": self._settings.tls_key,
        }
        return arguments + [f"--{name}={value}" for name, value in options.items() if value is not None]

    def stop(self, *, for_good: bool) -> None:
        """Have it stop; for_good: because it is canceled, not because the service ends."""
        self._stopping = not for_good
        self.child.stop()

    def follow(self) -> bool:
        """Write down what it told since the last call; False: it has ended, or the lease is lost."""
        code = self.child.ended()
        self._take_lines()
        if code is not None:
            if self._disk_was_full is None:  # now, not when the database can be told
                self._disk_was_full = self._disk_is_full(code)
            self._write_events(last=True)
            self._end(code)
            return False
        if not self._write_events(last=False):
            self.child.end()
            return False
        return True

    def give_up(self, error: Exception) -> None:
        """End the run, which cannot be followed any more, and have its job fail."""
        self.child.end()
        self._lost = self._lost or messages.of_error(error)
        self._settle(1, crashed=False)

    def _take_lines(self) -> None:
        for line in filter(None, map(_parsed, self._tail.lines())):
            for event in self._timeline.take(line, time.monotonic()):
                if event[0] == journal.PROGRESS:
                    self._progress = event
                else:
                    self._pending.append(event)
        if self._written is None and self._timeline.current() == VIEWER:
            self._written = list(results.result_names(self._paths.out(self.lease.id)))

    def _write_events(self, *, last: bool) -> bool:
        """Add events to the journal; False: the lease is lost."""
        size = tail.size(self._log)
        if last or time.monotonic() > self._wrote_at + _WRITE_S:
            if self._progress is not None:
                self._pending.append(self._progress)
                self._progress = None
            if size != self._log_bytes:
                self._log_bytes = size
                self._pending.append((journal.LOG, {"bytes": size}))
        if not self._pending:
            return True
        with self._database.write() as session:
            job = self.lease.row(session)
            if job is None:
                return False
            self._show_progress(job)
            self._database.order_events(session)
            for kind, data in self._pending:
                journal.add(session, job, kind, data)
                if kind == journal.STAGES and "write" in data["stages"]:  # not only those of an import
                    job.redo = None  # done by now: an attempt after this one continues
        self._pending, self._wrote_at = [], time.monotonic()
        return True

    def _show_progress(self, job: Job) -> None:
        job.stages = [dict(stage) for stage in self._timeline.stages]
        job.progress = round(self._timeline.fraction(), 4)
        job.eta_s = self._timeline.eta_s(time.monotonic())

    def _end(self, code: int) -> None:
        """What becomes of the job, after its process has ended."""
        end = self._timeline.end
        stopped = end is not None and end.reason is EndReason.STOPPED
        if code == EXIT_LOCKED:
            leases.lose(
                self._database, self.lease, "the previous attempt still holds the job's lock", counts=False
            )
        elif code == EXIT_LEASE_EXPIRED or self._stopping:
            why = "the service was stopped" if self._stopping else "the service lost its lease"
            leases.lose(self._database, self.lease, why, counts=code == EXIT_LEASE_EXPIRED)
        elif (code < 0 and (end is None or end.code == 0)) or stopped or self._disk_was_full:
            # somebody ended it, such as the system for want of memory; what fails by itself would fail again
            self._settle(code, crashed=True)
        else:
            self._settle(code, crashed=False)

    def _settle(self, code: int, *, crashed: bool) -> None:
        size = size_of(self._paths.job(self.lease.id))
        # without what a viewer shows, the result is a result
        whole = self._timeline.current() == VIEWER if crashed else code == 0
        noted, summary = self._result() if whole else ([], None)
        with self._database.write() as session:
            job = self.lease.row(session)
            if job is None:
                return
            job.lease_owner, job.bytes, job.eta_s = None, size, None
            if self._import is not None:
                job_import.account(session, self._paths, job.dataset_id)
            outcome, message = self._show_end(job, code, crashed, summary)
            if job.state == DONE:
                results.keep(session, job.id, noted)
            leases.close_attempt(session, job, outcome, message)
            self._database.order_events(session)
            journal.state(session, job)
            if job.state in (DONE, FAILED, CANCELED):
                webhooks.enqueue(session, job)
        _log.info("%s: %s", job.id, job.state)

    def _result(self) -> tuple[list[results.Noted], dict[str, Any] | None]:
        """The files of the result and its figures; no figures where some of it is gone."""
        out = self._paths.out(self.lease.id)
        try:
            noted = results.read_notes(out, self._paths.notes(self.lease.id))
            gone = {*results.ALWAYS, *(self._written or ())} - {each.name for each in noted}
            if gone:
                raise InputError(out / min(gone), "has disappeared while the job ran", "restart the job")
            files.sync(self._paths.job(self.lease.id))
            return noted, _summary(out)
        except (InputError, OSError, ValueError, LookupError, TypeError, AttributeError) as error:
            self._lost = messages.of_error(error)
            return [], None

    def _show_end(
        self, job: Job, code: int, crashed: bool, summary: dict[str, Any] | None
    ) -> tuple[Outcome, str]:
        """Outcome and message of the attempt, after the job's fields are set."""
        message = self._hidden(self._why_crashed(code) if crashed else self._last_words())
        if job.state == CANCELING:
            job.state, outcome = CANCELED, Outcome.CANCELED
            self._timeline.stop(time.monotonic())
        elif self._lost:
            message = self._hidden(self._lost)
            self._timeline.give_up(time.monotonic())
            job.state, job.error, outcome = FAILED, _lost(message), Outcome.FAILED
        elif crashed and (summary is None or job.crashes + 1 < self._settings.limits.attempts):
            job.crashes += 1
            job.state = FAILED if job.crashes >= self._settings.limits.attempts else QUEUED
            job.error = self._crash(job, code)
            outcome = Outcome.CRASHED
        elif summary is not None:
            if crashed:
                message = f"nothing for the page: {message}"
                self._timeline.give_up(time.monotonic())
            job.state, job.summary, job.progress, outcome = DONE, summary, 1.0, Outcome.DONE
        else:
            job.state, job.error, outcome = FAILED, self._failure(message), Outcome.FAILED
        job.finished = None if job.state in (QUEUED, RUNNING) else now()
        job.stages = [dict(stage) for stage in self._timeline.stages]
        return outcome, message

    def _last_words(self) -> str:
        """What it said last: as an event, or where an error that nobody foresaw cut it short, in the log."""
        if self._timeline.end is not None and self._timeline.end.code != 0:
            return self._timeline.end.message
        return tail.last_line(self._log) or "it said nothing"

    def _failure(self, message: str) -> dict[str, Any]:
        end = self._timeline.end
        failed = next((s["name"] for s in self._timeline.stages if s["state"] == timeline.FAILED), None)
        if end is not None and end.reason is EndReason.OUT_OF_MEMORY:
            hint = "use a machine with more memory, or fewer frames; then restart the job: finished stages are kept"
            return {"code": "out-of-memory", "stage": failed, "cause": "out of memory", "hint": hint}
        if end is not None and end.mend:
            cause = self._hidden(f"{end.where}: {end.problem}")
            return {"code": "input", "stage": failed, "cause": cause, "hint": self._hidden(end.mend)}
        return {"code": "failed", "stage": failed, "cause": message, "hint": "the log may say more"}

    def _disk_is_full(self, code: int) -> bool:
        """Whether that is what ended it."""
        end = self._timeline.end
        said = end is not None and end.reason is EndReason.DISK_FULL
        silent = (end is None or not end.problem) and free_bytes(self._paths.root) < LEAST_FREE
        return code == EXIT_DISK_FULL or (code > 0 and (said or silent))

    def _why_crashed(self, code: int) -> str:
        return "the disk was full" if self._disk_was_full else messages.of_exit(code)

    def _crash(self, job: Job, code: int) -> dict[str, Any] | None:
        """What is wrong with a job that failed so, or that waits for room; None: it is only tried again."""
        if self._disk_was_full:
            needed = int(job.estimate.get("disk_bytes", 0)) + LEAST_FREE
            hint = (
                f"it continues when {needed} bytes are free"
                if job.state == QUEUED
                else "make room, then restart it"
            )
            error = {"code": "disk-full", "stage": self._timeline.current(), "cause": "the disk was full"}
            return {**error, "hint": hint, "needed_bytes": needed}
        if job.state == QUEUED:
            return None
        hint = "the log may say more; finished stages are kept: restart the job once the cause is removed"
        if code == -signal.SIGKILL:
            hint = "the system does this when memory runs out: use a machine with more of it, or fewer frames"
        cause = f"{messages.of_exit(code)}, {job.crashes} times"
        return {"code": "crashed", "stage": self._timeline.current(), "cause": cause, "hint": hint}

    def _hidden(self, text: str) -> str:
        return messages.without_paths(text, self._paths, self.lease.id, self._recording)


def _lost(message: str) -> dict[str, Any]:
    hint = "see who removes files in the data folder; then restart the job: finished stages are kept"
    return {"code": "files", "stage": None, "cause": message, "hint": hint}


def _parsed(line: bytes) -> dict[str, Any] | None:
    """What a line of the run says; None: it was cut short, as on a full disk."""
    try:
        event = json.loads(line)
    except ValueError:
        return None
    return event if isinstance(event, dict) else None


def _history(session: Session) -> list[list[dict[str, Any]]]:
    done = select(Job.stages).where(Job.state == DONE).order_by(Job.updated.desc()).limit(_HISTORY)
    return list(session.scalars(done))


def _summary(out: Path) -> dict[str, Any]:
    report = json.loads(files.read_text(out / "report.json"))
    rough, refined = (report["evaluation"].get(state) or {} for state in ("rough", "refined"))
    return {
        "psnr_before": rough.get("psnr_leave_one_out"),
        "psnr_after": refined.get("psnr_leave_one_out"),
        "entropy_before": rough.get("map_entropy"),
        "entropy_after": refined.get("map_entropy"),
        "verdict": (report.get("verdict") or {}).get("level"),
        "map_error_m": ((report.get("expected_error") or {}).get("map") or {}).get("position_m"),
        "accepted_scans": (report.get("lidar") or {}).get("accepted"),
        "accepted_cameras": (report.get("visual") or {}).get("accepted"),
        "accepted_exposures": (report.get("visual") or {}).get("exposures_accepted"),
        "accepted_fusion": (report.get("fusion") or {}).get("accepted"),
    }
