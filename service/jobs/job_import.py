"""The import that a job begins with where its dataset is a bag: where it lies, who uses it, what it takes.

The recording lies with the dataset, under a key of what was chosen, so that another job with the same choices finds it.
It is kept as long as a job that was made from it.
"""

import contextlib
from dataclasses import dataclass
from pathlib import Path

from sqlalchemy import select
from sqlalchemy.orm import Session

from lvba.errors import InputError
from lvba.sources.importing.options import ImportOptions
from service.datasets import import_choices, inspections
from service.db.database import Database
from service.db.tables import Dataset, Job
from service.system import durable, file_lock
from service.system.paths import Paths, size_of


@dataclass(frozen=True)
class JobImport:
    """source: bag or folder; out: the recording; options: with paths of files"""

    source: Path
    out: Path
    options: ImportOptions


def prepare(database: Database, paths: Paths, job: Job, dataset: Path) -> JobImport | None:
    """The import of a job, noted in its row so that it is kept; None: it needs none.

    dataset: folder or file of the dataset
    Raises InputError: what its check found is gone.
    """
    if job.import_options is None:
        return None
    inspection = inspections.read(paths, job.dataset_id)
    if inspection is None:
        raise InputError("the dataset", "has lost what its check found", "upload it again")
    options = import_choices.read(job.import_options)
    key = import_choices.key(options)
    with database.write() as session:
        session.get_one(Job, job.id).import_key = key
    out = paths.imported(job.dataset_id, key)
    durable.make_folder(out.parent)
    source = dataset / inspection["file"] if inspection["file"] else dataset
    return JobImport(source, out, import_choices.resolved(options, dataset, inspection))


def account(session: Session, paths: Paths, dataset_id: str) -> None:
    """Have what was imported of a dataset be on its owner's account."""
    dataset = session.get(Dataset, dataset_id)
    if dataset is not None and dataset.facts is not None:
        dataset.bytes = int(dataset.facts.get("bytes", 0)) + size_of(paths.imports(dataset_id))


def sweep(database: Database, paths: Paths) -> None:
    """Remove recordings that no job is made from any more."""
    for folder in (paths.root / "datasets").glob("*/imports/*"):
        if folder.is_dir():
            # whoever writes it holds this lock, and a job names it before that
            lock = file_lock.exclusive(folder.with_name(f"{folder.name}.lock"), patience=0.0)
            with contextlib.suppress(BlockingIOError, FileNotFoundError), lock:
                _discard_unless_used(database, paths, folder)


def _discard_unless_used(database: Database, paths: Paths, folder: Path) -> None:
    dataset_id = folder.parent.parent.name
    with database.read() as session:
        known = session.get(Dataset, dataset_id)
        wanted = select(Job.id).where(Job.dataset_id == dataset_id, Job.import_key == folder.name).limit(1)
        used = session.scalars(wanted).first()
    if known is None or used is not None:
        return
    paths.discard(folder)
    with database.write() as session:
        account(session, paths, dataset_id)
