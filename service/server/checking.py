"""One dataset that is being checked: its process, and what becomes of the dataset."""

import dataclasses
import json
import logging
import time
from typing import Any

from sqlalchemy import select

from service.server import leases, quota, words
from service.server.child import Child
from service.server.database import Database
from service.server.leases import Lease
from service.server.lifeline import BUSY, STRANDED
from service.server.places import Places, now
from service.server.settings import Settings
from service.server.tables import INVALID, READY, Dataset, Upload

_log = logging.getLogger(__name__)


class DatasetCheck:
    """A dataset under a lease of this service."""

    def __init__(
        self, database: Database, places: Places, settings: Settings, dataset: Dataset, owner: str
    ) -> None:
        self._database, self._places, self._settings = database, places, settings
        self.lease = Lease(Dataset, dataset.id, owner, dataset.attempt)
        self._answer = places.dataset(dataset.id) / f"check-{dataset.attempt}.json"
        self._began = time.monotonic()
        self._stopping = False
        folder = places.dataset(dataset.id)
        folder.mkdir(parents=True, exist_ok=True)
        task = folder / "task.json"
        task.write_text(json.dumps(self._task(dataset)))
        self.child = Child(
            "service.server.check_process", [str(task)], folder / "check.log", settings.lease_s * 0.7
        )

    def _task(self, dataset: Dataset) -> dict[str, Any]:
        with self._database.read() as session:
            room = self._settings.limits.owner_bytes - quota.used_bytes(session, dataset.owner)
            uploads = session.scalars(select(Upload).where(Upload.dataset_id == dataset.id)).all()
        return {
            "folder": dataset.folder,
            "files": str(self._places.files(dataset.id)),
            "uploads": [
                {"path": upload.path, "file": str(self._places.upload(dataset.id, upload.id))}
                for upload in uploads
            ],
            "lock": str(self._places.dataset(dataset.id) / ".lock"),
            "answer": str(self._answer),
            "room": room,
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
                self.child.end()
            return True
        if self._stopping or code in (BUSY, STRANDED):
            leases.lose(self._database, self.lease, "stopped")
        elif code == 0:
            self._settle(json.loads(self._answer.read_text()))
        else:
            _log.warning("%s: the check ended with %s", self.lease.id, words.of_exit(code))
            self._settle({"error": _died(code)})
        return False

    def _settle(self, answer: dict[str, Any]) -> None:
        if "facts" in answer:
            frames = self._places.frames(self.lease.id)
            frames.write_text(json.dumps(answer["frames"]))
        with self._database.write() as session:
            dataset = self.lease.row(session)
            if dataset is None:
                return
            dataset.lease_owner, dataset.updated = None, now()
            dataset.error, dataset.facts = answer.get("error"), answer.get("facts")
            dataset.state = INVALID if dataset.facts is None else READY
            if dataset.facts is not None:
                dataset.bytes, dataset.files = answer["bytes"], answer["files"]
            ready = dataset.state == READY
        if ready:
            # the files hold the bytes now; what arrived as an archive is not needed any more
            self._places.remove(self._places.dataset(self.lease.id) / "uploads")


def _died(code: int) -> dict[str, str]:
    return {
        "code": "crashed",
        "cause": f"the check failed: {words.of_exit(code)}",
        "hint": "the files may be damaged, too large or too many; try with fewer of them",
    }
