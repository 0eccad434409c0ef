"""Where things lie in the data folder, and names for them. Nothing here is named by a user."""

import os
import secrets
import shutil
import time
from dataclasses import dataclass
from pathlib import Path

from service.server import store_urls

LEAST_FREE = 64 << 20
"""Bytes of disk without which nothing is begun."""


def new_id(kind: str) -> str:
    """A name that nobody can guess, such as `job_3f...`."""
    return f"{kind}_{secrets.token_hex(9)}"


def now() -> float:
    """Seconds since 1970 UTC."""
    return time.time()


@dataclass(frozen=True)
class Places:
    """The data folder."""

    root: Path

    def make(self) -> None:
        """Make the folders that must be there; only this user may look into them."""
        for folder in (self.root, self.instances, self.root / "datasets", self.root / "jobs", self.trash):
            folder.mkdir(parents=True, exist_ok=True)
        self.root.chmod(0o700)

    @property
    def instances(self) -> Path:
        """A locked file for each service that lives."""
        return self.root / "instances"

    @property
    def trash(self) -> Path:
        """What is being removed."""
        return self.root / "trash"

    def dataset(self, dataset_id: str) -> Path:
        """Folder of an uploaded dataset."""
        return self.root / "datasets" / dataset_id

    def upload(self, dataset_id: str, upload_id: str) -> Path:
        """A file that is arriving."""
        return self.dataset(dataset_id) / "uploads" / upload_id

    def files(self, dataset_id: str) -> Path:
        """The recording, once it is checked."""
        return self.dataset(dataset_id) / "files"

    def recording(self, dataset_id: str, source: str | None) -> Path:
        """Where the files of a dataset are; source: the folder or URL that was registered, None: uploaded."""
        return Path(source) if source and not store_urls.is_url(source) else self.files(dataset_id)

    def frames(self, dataset_id: str) -> Path:
        """JSON: time and path of each image."""
        return self.dataset(dataset_id) / "frames.json"

    def job(self, job_id: str) -> Path:
        """Folder of a job."""
        return self.root / "jobs" / job_id

    def out(self, job_id: str) -> Path:
        """Its result folder."""
        return self.job(job_id) / "out"

    def log(self, job_id: str) -> Path:
        """What it said."""
        return self.job(job_id) / "log.txt"

    def events(self, job_id: str, attempt: int) -> Path:
        """What one attempt told."""
        return self.job(job_id) / f"events-{attempt}.jsonl"

    def remove(self, folder: Path) -> None:
        """Remove a folder below the root; cut short, it is at least gone from its place."""
        if not folder.is_relative_to(self.root) or not folder.exists():
            return
        doomed = self.trash / f"{folder.name}-{secrets.token_hex(4)}"
        folder.rename(doomed)
        shutil.rmtree(doomed, ignore_errors=True)

    def empty_trash(self) -> None:
        """Remove what an earlier removal left."""
        for folder in self.trash.iterdir():
            shutil.rmtree(folder, ignore_errors=True)


def free_bytes(folder: Path) -> int:
    """What the disk of a folder has left."""
    return shutil.disk_usage(folder).free


def size_of(folder: Path) -> int:
    """Bytes of all files below a folder."""
    return sum(
        os.lstat(os.path.join(top, name)).st_size
        for top, _, names in os.walk(folder)
        for name in names
        if os.path.lexists(os.path.join(top, name))
    )
