"""What a job made: names, sizes and digests, noted when it ends, and compared whenever a file is read."""

import dataclasses
import hashlib
import json
import os
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from io import BufferedReader
from pathlib import Path

from sqlalchemy import delete, insert, select
from sqlalchemy.orm import Session

from lvba.errors import InputError
from lvba.io import files
from service.datasets import file_names
from service.db.tables import Result
from service.problems import Problem

ALWAYS = ("config.yaml", "lidar_poses.txt", "map.ply", "report.json")
"""What every result holds."""
_MOST = 100_000
"""Files whose digests are remembered."""


@dataclass(frozen=True)
class Noted:
    """A file of a result as its run left it."""

    name: str
    bytes: int
    sha256: str | None
    """In hexadecimal; None: its run was killed before it could take it."""
    stamp: str
    """Changes whenever the file is written or replaced."""


def stamp(status: os.stat_result) -> str:
    """What tells a file that nobody has touched from one that must be read again to know."""
    return f"{status.st_ino:x}-{status.st_size:x}-{status.st_mtime_ns:x}-{status.st_ctime_ns:x}"


def result_names(out: Path) -> Iterator[str]:
    """Names of all files of a result folder, sorted; what stages made is not among them, nor are links."""
    names: list[str] = []
    for folder, folders, here in os.walk(out):
        inside = os.path.relpath(folder, out)
        folders[:] = [name for name in folders if name[0] != "." and not (inside == "." and name == "stages")]
        plain = [name for name in here if name[0] != "." and not os.path.islink(os.path.join(folder, name))]
        names += [os.path.normpath(os.path.join(inside, name)) for name in plain]
    yield from sorted(names)


def is_result(name: str) -> bool:
    """Whether a file of a result folder is shown: not what stages made, nor what is hidden."""
    parts = name.split("/")
    return parts[0] != "stages" and not any(part.startswith(".") for part in parts)


def note(out: Path, file: Path) -> None:
    """Write down every file of a result folder with its digest."""
    notes = []
    for name in result_names(out):
        with file_names.opened(out, name) as stream:
            notes.append(_noted(name, stream, hashlib.file_digest(stream, "sha256").hexdigest()))
    files.write_text(file, json.dumps([dataclasses.asdict(each) for each in notes]), durable=True)


def read_notes(out: Path, file: Path) -> list[Noted]:
    """What `note` wrote; of files that it did not see, the size alone.

    Raises InputError, OSError: the files cannot be read.
    """
    try:
        noted = {each["name"]: Noted(**each) for each in json.loads(files.read_text(file))}
    except (InputError, ValueError, TypeError, KeyError):
        noted = {}
    notes = []
    for name in result_names(out):
        if name not in noted:
            with file_names.opened(out, name) as stream:
                noted[name] = _noted(name, stream, None)
        notes.append(noted[name])
    return notes


def _noted(name: str, stream: BufferedReader, sha256: str | None) -> Noted:
    status = os.fstat(stream.fileno())
    return Noted(name, status.st_size, sha256, stamp(status))


def keep(session: Session, job_id: str, noted: Sequence[Noted]) -> None:
    """Have these be the files of the job, and no others."""
    session.execute(delete(Result).where(Result.job_id == job_id))
    if noted:
        session.execute(insert(Result), [{"job_id": job_id, **dataclasses.asdict(each)} for each in noted])


def of_job(session: Session, job_id: str, out: Path) -> dict[str, Result | None]:
    """The files of a job by their names, sorted; None: of a job that ended before digests were kept."""
    rows = session.scalars(select(Result).where(Result.job_id == job_id)).all()
    return {row.name: row for row in sorted(rows, key=lambda row: row.name)} or dict.fromkeys(
        result_names(out)
    )


def one(session: Session, job_id: str, name: str) -> Result | None:
    """A file of a job; None: of a job that ended before digests were kept.

    Raises Problem: the job made no such file.
    """
    row = session.get(Result, (job_id, name))
    known = row or session.scalars(select(Result.name).where(Result.job_id == job_id).limit(1)).one_or_none()
    if row is None and (known or not is_result(name)):
        raise Problem("not-found", "there is no such result", "see the list of results")
    return row


class Checker:
    """Opens results, each only as its run left it. A file is hashed only where its stamp has changed, and then once."""

    def __init__(self) -> None:
        self._right: set[tuple[str, str]] = set()
        self._hashing = threading.Lock()

    def opened(self, out: Path, name: str, row: Result | None) -> BufferedReader:
        """The file, for reading.

        row: as of `of_job`
        Raises Problem: there is none (any more), or it is another than the run left.
        """
        try:
            stream = file_names.opened(out, name)
        except InputError as error:
            if row is None:
                raise Problem("not-found", "there is no such result", "see the list of results") from None
            raise Problem("damaged", f"{name}: {error.problem}", name=name) from None
        if row is not None:
            try:
                self._check(stream, row)
            except BaseException:
                stream.close()
                raise
        return stream

    def _check(self, stream: BufferedReader, row: Result) -> None:
        status = os.fstat(stream.fileno())
        if status.st_size != row.bytes:
            said = f"{row.name} has {status.st_size} bytes instead of {row.bytes}"
            raise Problem("damaged", said, name=row.name)
        seen = (row.sha256 or "", stamp(status))
        if row.sha256 is None or seen[1] == row.stamp or seen in self._right:
            return
        with self._hashing:
            if seen in self._right:  # while waiting
                return
            if hashlib.file_digest(stream, "sha256").hexdigest() != row.sha256:
                raise Problem("damaged", f"{row.name} is not what the job made", name=row.name)
            stream.seek(0)
            if len(self._right) > _MOST:
                self._right.clear()
            self._right.add(seen)
