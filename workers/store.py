"""Artifacts in a folder: one zarr group with a manifest each, complete or not there at all.

    STORE/<stage>-<digest>/zarr.json        zarr v3 group; the value around the arrays as JSON in its attributes
                           <array>/...      zarr v3 arrays
                           manifest.json    sha256 of every file above, versions, seconds, peak memory

An artifact is written to a partial folder, synced, and renamed: a process killed at any moment leaves either all of it
or nothing under its name. Whatever no longer matches its manifest is made again.
"""

import errno
import fcntl
import hashlib
import json
import logging
import os
import shutil
import uuid
from collections.abc import Iterator, Mapping, MutableMapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from lvba.errors import ArtifactError, InputError
from lvba.io.files import sync
from workers import codec

_log = logging.getLogger(__name__)
_PARTIAL = ".partial-"
_LOCK = ".lock"
MANIFEST = "manifest.json"
"""Name of the file that says that the others are all there."""
_CHUNK_BYTES = 1 << 28
"""Arrays up to this size are one file: few files, and one task owns one array."""
_SYNCS = 8
"""Files that are waited for at a time."""


class ZarrStore(MutableMapping[str, Any]):
    """Artifacts by key. What was written or read stays in memory until `release`d."""

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder)
        self._values: dict[str, Any] = {}
        self._verified: set[str] = set()
        self._known: set[str] = set()
        self._sizes: dict[str, int] = {}

    @property
    def place(self) -> str:
        """What `open_store` finds this store by."""
        return str(self.folder)

    def __contains__(self, key: object) -> bool:
        """Whether the artifact is there and matches its manifest; one that does not is removed."""
        if key in self._known:
            return True
        if not isinstance(key, str) or not self._fetched(key):
            return False
        if key in self._verified:
            return True
        try:
            verify(self.folder / key)
        except ArtifactError as error:
            self._give_up(key, error)
            return False
        self._verified.add(key)
        return True

    def _fetched(self, key: str) -> bool:
        """Whether there is something under this key in `folder`, unverified."""
        return (self.folder / key).exists()

    def _give_up(self, key: str, error: ArtifactError) -> None:
        _log.warning("%s; it is made again", error)
        with suppress(KeyError):  # another worker saw it too, and was faster
            del self[key]

    def __getitem__(self, key: str) -> Any:
        """Its files are checked after they were read: what is damaged in between is noticed too."""
        if key not in self._values:
            if not self._fetched(key):
                raise KeyError(key)
            try:
                value = read(self.folder / key)
                verify(self.folder / key)
            except ArtifactError as error:
                self._give_up(key, error)
                raise KeyError(key) from error
            self._verified.add(key)
            self._values[key] = value
        return self._values[key]

    def __setitem__(self, key: str, value: Any) -> None:
        self.put(key, value, {})

    def put(self, key: str, value: Any, facts: Mapping[str, Any]) -> None:
        """Store an artifact; the facts (seconds, memory, versions) go into its manifest.

        What is there under this key, and whole, stays as it is: the same key means the same bytes.
        """
        write(self.folder, key, value, facts)
        self._values[key] = value
        self._verified.add(key)

    def know(self, key: str, value: Any) -> None:
        """Take a value for what the store holds: one that was read before, or that is being written."""
        self._values[key] = value
        self._known.add(key)

    def __delitem__(self, key: str) -> None:
        self._values.pop(key, None)
        self._verified.discard(key)
        self._known.discard(key)
        # renamed first, so that a removal cut short leaves no half artifact under its name
        doomed = self.folder / f"{_PARTIAL}{uuid.uuid4().hex}"
        try:
            (self.folder / key).rename(doomed)
        except FileNotFoundError:
            raise KeyError(key) from None
        shutil.rmtree(doomed, ignore_errors=True)

    def __iter__(self) -> Iterator[str]:
        if self.folder.exists():
            yield from sorted(p.name for p in self.folder.iterdir() if p.is_dir() and p.name[0] != ".")

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def release(self, key: str) -> None:
        """Forget the value in memory; it stays on disk."""
        self._values.pop(key, None)
        self._known.discard(key)

    def held(self) -> list[str]:
        """Keys of the values that are in memory."""
        return list(self._values)

    def size(self, key: str) -> int:
        """Bytes of the files of an artifact that is held; 0 while it is being written."""
        if not self._sizes.get(key):
            files = (self.folder / key).rglob("*")
            self._sizes[key] = sum(path.stat().st_size for path in files if path.is_file())
        return self._sizes[key]

    def facts(self, key: str) -> dict[str, Any]:
        """The manifest of an artifact."""
        return _read_manifest(self.folder / key)

    def tidy(self, version: str | None = None) -> None:
        """Remove what killed processes left half-written. Call only while holding `lock`.

        version: if given, also remove artifacts whose manifest names another one: no step will ever ask for them
        """
        for folder in self.folder.glob(_PARTIAL + "*"):
            shutil.rmtree(folder, ignore_errors=True)
        for key in list(self) if version is not None else []:
            if self.version(key) != version:
                del self[key]

    def version(self, key: str) -> str | None:
        """The version that an artifact's manifest names; None where it names none or cannot be read."""
        try:
            return _read_manifest(self.folder / key).get("version")
        except ArtifactError:
            return None

    def lock(self, out: Path | None = None) -> AbstractContextManager[None]:
        """See `lock`."""
        return lock(self.folder, out)


@contextmanager
def lock(folder: Path, out: Path | None = None) -> Iterator[None]:
    """Hold the store for writing; two runs into one folder would undo each other.

    The lock belongs to the process: it is gone when the process is, however it ended. A folder in which nothing was
    made is removed with it.
    Raises InputError: another process holds it.
    """
    while True:
        folder.mkdir(parents=True, exist_ok=True)
        try:
            handle = (folder / _LOCK).open("a")
        except FileNotFoundError:
            continue  # a run that made nothing has just taken its folder away
        with handle:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise InputError(
                    out or folder,
                    "another run is writing here",
                    "wait until it has ended, or choose another --out",
                ) from None
            if not _is_at(handle.fileno(), folder / _LOCK):
                continue
            try:
                yield
            finally:
                with suppress(OSError):
                    if [path.name for path in folder.iterdir()] == [_LOCK]:
                        (folder / _LOCK).unlink()
                        folder.rmdir()
            return


def _is_at(handle: int, path: Path) -> bool:
    """Whether the open file is the one at the path."""
    try:
        return os.path.samestat(os.fstat(handle), path.stat())
    except FileNotFoundError:
        return False


def write(folder: Path, key: str, value: Any, facts: Mapping[str, Any]) -> None:
    """Write one artifact as `folder/key`, whole or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    partial = folder / f"{_PARTIAL}{uuid.uuid4().hex}"
    try:
        _write_group(partial, value)
        files = {name: _sha256(partial / name) for name in _files(partial)}
        manifest = {"key": key, "files": files, **facts}
        (partial / MANIFEST).write_text(json.dumps(manifest, indent=1, sort_keys=True) + "\n")
        _sync(partial)
        _move_into_place(partial, folder / key)
    except BaseException as error:
        shutil.rmtree(partial, ignore_errors=True)
        if isinstance(error, OSError) and error.filename is None:
            error.filename = str(folder)  # which disk is full
        raise


def read(artifact: Path) -> Any:
    """The value of one artifact.

    Raises ArtifactError: it cannot be read.
    """
    import zarr

    try:
        group = zarr.open_group(str(artifact), mode="r", zarr_format=3)
        attributes: dict[str, Any] = group.attrs.asdict()
        arrays = {name: _read_array(group[str(i)]) for i, name in enumerate(attributes["arrays"])}
        return codec.decode(attributes["value"], arrays)
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise ArtifactError(f"{artifact.name} cannot be read ({type(error).__name__}: {error})") from error


def _read_array(stored: Any) -> np.ndarray:
    return np.asarray(stored[...])


def verify(artifact: Path) -> None:
    """Check every file of an artifact against its manifest.

    Raises ArtifactError: a file is missing, altered or new.
    """
    expected = _read_manifest(artifact).get("files")
    present = _files(artifact)
    if not isinstance(expected, dict) or sorted(expected) != sorted(set(present) - {MANIFEST}):
        raise ArtifactError(f"{artifact.name} has not the files its manifest lists")
    for name, digest in expected.items():
        if _sha256(artifact / name) != digest:
            raise ArtifactError(f"{artifact.name}/{name} is not as it was written")


def _write_group(folder: Path, value: Any) -> None:
    import zarr

    arrays: dict[str, np.ndarray] = {}
    data = codec.encode(value, arrays)
    # numbered folders: names in the artifact may be long or hold letters a file system refuses
    attributes = {"value": data, "arrays": list(arrays)}
    group = zarr.open_group(str(folder), mode="w", zarr_format=3, attributes=attributes)
    for i, array in enumerate(arrays.values()):
        created = group.create_array(
            str(i),
            shape=array.shape,
            dtype=array.dtype,
            chunks=_chunks(array),
            compressors=None,
            filters=None,
            # else each chunk is looked through for whether it is all zeros, which takes longer than to write it
            config={"write_empty_chunks": True},
        )
        if array.size:
            created[...] = array


def _chunks(array: np.ndarray) -> tuple[int, ...]:
    shape = tuple(max(1, n) for n in array.shape)
    if not shape:
        return ()
    row_bytes = max(1, array.nbytes // shape[0])
    return (max(1, min(shape[0], _CHUNK_BYTES // row_bytes)), *shape[1:])


def _files(folder: Path) -> list[str]:
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())


def _read_manifest(artifact: Path) -> dict[str, Any]:
    try:
        manifest = json.loads((artifact / MANIFEST).read_text())
    except (OSError, ValueError):
        raise ArtifactError(f"{artifact.name} has no readable manifest") from None
    if not isinstance(manifest, dict):
        raise ArtifactError(f"{artifact.name} has no readable manifest")
    return manifest


def _sha256(path: Path) -> str:
    with path.open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def _sync(folder: Path) -> None:
    """Have the files and folders on disk before the rename says that they are.

    Many at a time: a file system commits together what waits for it together.
    """
    with ThreadPoolExecutor(_SYNCS) as pool:
        for _ in pool.map(sync, [*folder.rglob("*"), folder]):
            pass


def _move_into_place(partial: Path, artifact: Path) -> None:
    """What is whole under this name stays, manifest and all: others may have read it. What is damaged is replaced."""
    try:
        _rename_unless_taken(partial, artifact)
    except FileExistsError:
        if not _is_whole(artifact):
            _replace(artifact, partial)
        shutil.rmtree(partial, ignore_errors=True)
    descriptor = os.open(artifact.parent, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _rename_unless_taken(partial: Path, artifact: Path) -> None:
    try:
        partial.rename(artifact)
    except OSError as error:
        if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
            raise
        # two workers made the same artifact, and the other one was faster: the same key means the same bytes
        raise FileExistsError(errno.EEXIST, "is there already", str(artifact)) from None


def _is_whole(artifact: Path) -> bool:
    try:
        verify(artifact)
    except (ArtifactError, OSError):
        return False
    return True


def _replace(artifact: Path, partial: Path) -> None:
    aside = partial.with_name(f"{partial.name}-replaced")
    with suppress(FileNotFoundError):
        artifact.rename(aside)
    with suppress(FileExistsError):
        _rename_unless_taken(partial, artifact)
    shutil.rmtree(aside, ignore_errors=True)
