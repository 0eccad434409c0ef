"""Where things lie in the data folder, and names for them. Nothing here is named by a user."""

import os
import secrets
import shutil
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from service.system import durable, store_urls


def new_id(kind: str) -> str:
    """A name that nobody can guess, such as `job_3f...`."""
    return f"{kind}_{secrets.token_hex(9)}"


def now() -> float:
    """Seconds since 1970 UTC."""
    return time.time()


@dataclass(frozen=True)
class Paths:
    """The data folder."""

    root: Path

    def make(self) -> None:
        """Make the folders that must be there; only this user may look into them."""
        for folder in (self.root, self.instances, self.root / "datasets", self.root / "jobs", self.trash):
            durable.make_folder(folder)
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

    def uploads(self, dataset_id: str) -> Path:
        """What arrives of a dataset."""
        return self.dataset(dataset_id) / "uploads"

    def upload(self, dataset_id: str, upload_id: str) -> Path:
        """A file that is arriving."""
        return self.uploads(dataset_id) / upload_id

    def files(self, dataset_id: str) -> Path:
        """The recording, once it is checked."""
        return self.dataset(dataset_id) / "files"

    def recording(self, dataset_id: str, source: str | None) -> Path:
        """Where the files of a dataset are; source: the folder or URL that was registered, None: uploaded."""
        return Path(source) if source and not store_urls.is_url(source) else self.files(dataset_id)

    def partial(self, dataset_id: str) -> Path:
        """The recording while it is put together or fetched."""
        return self.dataset(dataset_id) / "files.partial"

    def frames(self, dataset_id: str) -> Path:
        """JSON: time and path of each image."""
        return self.dataset(dataset_id) / "frames.json"

    def inspection(self, dataset_id: str) -> Path:
        """JSON: what a bag holds (`source_check.look`); not there: the dataset is a recording."""
        return self.dataset(dataset_id) / "inspection.json"

    def imports(self, dataset_id: str) -> Path:
        """Folder of the recordings that jobs made of a bag."""
        return self.dataset(dataset_id) / "imports"

    def imported(self, dataset_id: str, key: str) -> Path:
        """The recording that choices with this key make of a bag; its lock lies beside it."""
        return self.imports(dataset_id) / key

    def job(self, job_id: str) -> Path:
        """Folder of a job."""
        return self.root / "jobs" / job_id

    def out(self, job_id: str) -> Path:
        """Its result folder."""
        return self.job(job_id) / "out"

    def log(self, job_id: str) -> Path:
        """What it said."""
        return self.job(job_id) / "log.txt"

    def notes(self, job_id: str) -> Path:
        """JSON: sizes and digests of its results, as its process wrote them down."""
        return self.job(job_id) / "results.json"

    def events(self, job_id: str, attempt: int) -> Path:
        """What one attempt told."""
        return self.job(job_id) / f"events-{attempt}.jsonl"

    def discard(self, folder: Path) -> None:
        """Have a folder below the root be gone from its place at once; its files go later."""
        if folder.is_relative_to(self.root) and folder.exists():
            folder.rename(self.trash / f"{folder.name}-{secrets.token_hex(4)}")

    def empty_trash(self) -> None:
        """Remove the files of all that was discarded."""
        for folder in self.trash.iterdir():
            shutil.rmtree(folder, ignore_errors=True)


def count_of(folder: Path) -> int:
    """Files below a folder."""
    return sum(len(names) for _, _, names in os.walk(folder))


def size_of(folder: Path) -> int:
    """Bytes of all files below a folder; what goes meanwhile counts as nothing."""
    total = 0
    for top, _, names in os.walk(folder):
        for name in names:
            with suppress(OSError):
                total += os.lstat(os.path.join(top, name)).st_size
    return total
