"""What is on the disk and of no use any more: of checks that were cut short or refused, of uploads that are checked."""

import fcntl
import time
from pathlib import Path

from sqlalchemy import select

from service.db.database import Database
from service.db.tables import ENDED, READY, VALIDATING, Dataset, Job, Upload
from service.system import file_lock, store_urls
from service.system.paths import Paths, size_of

_SURE_S = 3600.0
"""So old a file must be that no record names, for its record will not come any more."""


def sweep(database: Database, paths: Paths, *, uploads: bool) -> None:
    """Find what an end of the service or of the machine has left, and remove it.

    uploads: look also for files without a record among the uploads
    """
    with database.read() as session:
        datasets = session.scalars(select(Dataset).where(Dataset.state != VALIDATING)).all()
    for dataset in datasets:
        if any(folder.exists() for folder in _of(paths, dataset)):
            _discard_unless_checked(database, paths, dataset.id)
        if uploads and dataset.state != READY:
            _remove_strays(database, paths, dataset.id)
    _measure(database, paths)
    paths.empty_trash()


def discard(paths: Paths, dataset: Dataset) -> None:
    """Have what is of no use to a dataset be gone; nobody may be checking it."""
    for folder in _of(paths, dataset):
        paths.discard(folder)


def _of(paths: Paths, dataset: Dataset) -> list[Path]:
    made, partial, uploads = (folder(dataset.id) for folder in (paths.files, paths.partial, paths.uploads))
    if dataset.state == READY:
        return [uploads, partial]  # the files hold the bytes now
    if dataset.folder is None:
        return [made, partial]  # put together anew when it is checked again
    # what was fetched from an object store is gone on with, where it is on its owner's account
    return [made] if store_urls.is_url(dataset.folder) and dataset.bytes else [made, partial]


def _discard_unless_checked(database: Database, paths: Paths, dataset_id: str) -> None:
    try:
        # whoever checks it holds this lock, and its state is that it is being checked
        with file_lock.exclusive(paths.dataset(dataset_id) / ".lock", patience=0.0):
            with database.read() as session:
                dataset = session.get(Dataset, dataset_id)
            if dataset is not None and dataset.state != VALIDATING:
                discard(paths, dataset)
    except (BlockingIOError, FileNotFoundError):
        return


def _remove_strays(database: Database, paths: Paths, dataset_id: str) -> None:
    folder = paths.uploads(dataset_id)
    there = list(folder.iterdir()) if folder.is_dir() else []
    with database.read() as session:
        known = set(session.scalars(select(Upload.id).where(Upload.dataset_id == dataset_id)))
    for file in there:
        if file.name not in known:
            _remove_stray(file)


def _remove_stray(file: Path) -> None:
    try:
        with file.open("rb") as stream:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)  # a request holds it before there is a record
            if file.stat().st_mtime < time.time() - _SURE_S:
                file.unlink()
    except (BlockingIOError, FileNotFoundError):
        return


def _measure(database: Database, paths: Paths) -> None:
    """Put on their owners' account what jobs have left that ended with their service."""
    with database.read() as session:
        wanted = select(Job.id).where(Job.state.in_(ENDED), Job.bytes == 0, Job.attempt > 0)
        jobs = session.scalars(wanted).all()
    for job_id in jobs:
        size = size_of(paths.job(job_id))
        with database.write() as session:
            job = session.get(Job, job_id)
            if job is not None and job.state in ENDED:
                job.bytes = size
