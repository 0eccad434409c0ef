"""One dataset that is being checked: its process, and what becomes of the dataset."""

import dataclasses
import json
import logging
import time
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from lvba.io import files
from service.datasets import check_memory, leftovers, quota, recording_roots
from service.datasets.intake_budget import EXCEEDED
from service.db import leases
from service.db.database import Database
from service.db.leases import Lease
from service.db.tables import INVALID, READY, Dataset, Upload
from service.settings import Settings
from service.system import durable, messages
from service.system.child_process import Child
from service.system.deadline import EXIT_LEASE_EXPIRED
from service.system.file_lock import EXIT_LOCKED
from service.system.paths import Paths, now

_log = logging.getLogger(__name__)


class DatasetCheck:
    """A dataset under a lease of this service."""

    def __init__(
        self, database: Database, paths: Paths, settings: Settings, dataset: Dataset, owner: str
    ) -> None:
        self._database, self._paths, self._settings = database, paths, settings
        self.lease = Lease(Dataset, dataset.id, owner, dataset.attempt)
        self._answer = paths.dataset(dataset.id) / f"check-{dataset.attempt}.json"
        self._began = time.monotonic()
        self._stopping = self._late = False
        folder = paths.dataset(dataset.id)
        durable.make_folder(folder)
        task = folder / "task.json"
        task.write_text(json.dumps(self._task(dataset)))
        self._log = folder / "check.log"
        self._log_begin = self._log.stat().st_size if self._log.exists() else 0
        self.child = Child("service.datasets.check_process", [str(task)], self._log, settings.lease_s * 0.7)

    def _task(self, dataset: Dataset) -> dict[str, Any]:
        limits = self._settings.limits
        with self._database.read() as session:
            others = quota.used(session, dataset.owner, but=dataset.id)
            uploads = session.scalars(select(Upload).where(Upload.dataset_id == dataset.id)).all()
        return {
            "folder": dataset.folder,
            "files": str(self._paths.files(dataset.id)),
            "uploads": [
                {"path": upload.path, "file": str(self._paths.upload(dataset.id, upload.id))}
                for upload in uploads
            ],
            "lock": str(self._paths.dataset(dataset.id) / ".lock"),
            "answer": str(self._answer),
            "room_bytes": limits.owner_bytes - others.bytes,
            "room_files": limits.owner_files - others.files - 1,
            "without_links": recording_roots.folders(
                self._paths.recording(dataset.id, dataset.folder), self._settings
            ),
            "limits": dataclasses.asdict(self._settings.limits),
        }

    def stop(self, *, for_good: bool) -> None:
        """Have it stop; it is begun anew later."""
        self._stopping = True
        self.child.end()

    def follow(self) -> bool:
        """False: it has ended."""
        code = self.child.ended()
        if code is None:
            if time.monotonic() > self._began + self._settings.limits.validation_s:
                self._late = True
                self.child.end()
            return True
        if self._stopping or code in (EXIT_LOCKED, EXIT_LEASE_EXPIRED):
            leases.lose(self._database, self.lease, "stopped")
        elif code == 0:
            self._settle(self._answered())
        else:
            _log.warning("%s: the check ended with %s", self.lease.id, messages.of_exit(code))
            self._settle({"error": self._died(code)})
        return False

    def _died(self, code: int) -> dict[str, str]:
        if self._late:
            return {
                "code": "too-much",
                "cause": f"the check took longer than {self._settings.limits.validation_s:.0f} s",
                "hint": "try with fewer or smaller files, or ask the server's administrator for more time",
            }
        if check_memory.ended(code, self._log, self._log_begin):
            return check_memory.said(self._settings.limits)
        return {
            "code": "crashed",
            "cause": f"the check failed: {messages.of_exit(code)}",
            "hint": "the files may be damaged, too large or too many; try with fewer of them",
        }

    def give_up(self, error: Exception) -> None:
        """End the check, which cannot be followed any more: the dataset is invalid."""
        self.child.end()
        self._settle({"error": _lost(messages.of_error(error), self._paths)})

    def _answered(self) -> dict[str, Any]:
        try:
            answer = json.loads(self._answer.read_text())
            return answer if isinstance(answer, dict) else {"error": self._died(0)}
        except (OSError, ValueError) as error:
            return {"error": _lost(messages.of_error(error), self._paths)}

    def _settle(self, answer: dict[str, Any]) -> None:
        if "facts" in answer:
            frames = self._paths.frames(self.lease.id)
            files.write_text(frames, json.dumps(answer["frames"]), durable=True)
            inspection = self._paths.inspection(self.lease.id)
            inspection.unlink(missing_ok=True)
            if "inspection" in answer:
                files.write_text(inspection, json.dumps(answer["inspection"]), durable=True)
        with self._database.write() as session:
            dataset = self.lease.row(session)
            if dataset is None:
                return
            self._database.order_owner(session, dataset.owner)
            if "facts" in answer and self._exceeds(session, dataset, answer):
                answer = {
                    "error": {"code": "quota", "cause": EXCEEDED, "hint": "remove some, or upload less"}
                }
            dataset.lease_owner, dataset.updated = None, now()
            dataset.error, dataset.facts = answer.get("error"), answer.get("facts")
            dataset.state = INVALID if dataset.facts is None else READY
            dataset.bytes, dataset.files = answer.get("bytes", 0), answer.get("files", 0)
        # cut short here, what is left is swept
        leftovers.discard(self._paths, dataset)

    def _exceeds(self, session: Session, dataset: Dataset, answer: dict[str, Any]) -> bool:
        """Whether its owner has got more meanwhile than goes with it."""
        others = quota.used(session, dataset.owner, but=dataset.id)
        return answer["bytes"] > 0 and quota.exceeds(
            others, self._settings.limits, answer["bytes"], answer["files"] + 1
        )


def _lost(cause: str, paths: Paths) -> dict[str, str]:
    shown = cause.replace(str(paths.root), "DATA")
    return {
        "code": "files",
        "cause": shown,
        "hint": "finish the dataset again; what is missing must be uploaded again",
    }
