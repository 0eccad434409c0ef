"""Artifacts under a URL that fsspec knows, such as s3://bucket/folder: the same files as in a folder.

Each artifact is made, and read, as a folder on this machine's disk. Its manifest goes up last: a process killed at any
moment leaves either all of it or something without a manifest, which does not count.
"""

import json
import os
import socket
import tempfile
import threading
import time
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from lvba.errors import InputError
from workers.store import MANIFEST, ZarrStore

LEASE_SECONDS = 30.0
"""How long a lock holds that is not renewed: what a driver killed on another machine blocks."""
_LOCK = ".lock.json"


def open_store(place: str | Path) -> ZarrStore:
    """The store in a folder or under a URL.

    Raises InputError: a URL that cannot be used.
    """
    if "://" not in str(place):
        return ZarrStore(place)
    return UrlStore(str(place))


class UrlStore(ZarrStore):
    """Artifacts by key. What was written or read stays on the local disk, and in memory, until `release`d."""

    def __init__(self, url: str) -> None:
        self._scratch = tempfile.TemporaryDirectory(prefix="lvba-")
        super().__init__(self._scratch.name)
        self.url = url.rstrip("/")
        with _as_input_error(self.url):
            from fsspec.core import url_to_fs

            # others write there too: never answer from memory
            self._files, self._root = url_to_fs(self.url, use_listings_cache=False, skip_instance_cache=True)

    @property
    def place(self) -> str:
        """What `open_store` finds this store by."""
        return self.url

    def _fetched(self, key: str) -> bool:
        if super()._fetched(key):
            return True
        if not self._exists(key):
            return False
        self._fetch(key)
        return True

    def put(self, key: str, value: Any, facts: Mapping[str, Any]) -> None:
        """Store an artifact; the facts (seconds, memory, versions) go into its manifest."""
        super().put(key, value, facts)
        if self._exists(key):
            return  # another worker made it too, and was faster: the same key means the same bytes
        self._remove(key)
        artifact = self.folder / key
        names = [p.relative_to(artifact).as_posix() for p in artifact.rglob("*") if p.is_file()]
        names.remove(MANIFEST)
        self._files.put([str(artifact / name) for name in names], [self._path(key, name) for name in names])
        self._files.put_file(str(artifact / MANIFEST), self._path(key, MANIFEST))

    def __delitem__(self, key: str) -> None:
        there = self._remove(key)
        with suppress(KeyError):
            super().__delitem__(key)
            there = True
        if not there:
            raise KeyError(key)

    def __iter__(self) -> Iterator[str]:
        with suppress(FileNotFoundError):
            entries = self._files.ls(self._root, detail=True)
            names = (entry["name"].rstrip("/").rsplit("/", 1)[-1] for entry in entries if _is_folder(entry))
            yield from sorted(name for name in names if name[0] != ".")

    def release(self, key: str) -> None:
        """Forget the value in memory and on the local disk; it stays under the URL."""
        with suppress(KeyError):
            super().__delitem__(key)

    def version(self, key: str) -> str | None:
        """The version that an artifact's manifest names; None where it names none or cannot be read."""
        try:
            manifest = json.loads(self._files.cat_file(self._path(key, MANIFEST)))
            version = manifest.get("version")
        except (OSError, ValueError, AttributeError):
            return None
        return None if version is None else str(version)

    @contextmanager
    def lock(self, out: Path | None = None) -> Iterator[None]:
        """Hold the store for writing. The lock is an object that is renewed as long as this process lives.

        Raises InputError: another process holds it, or the URL cannot be written.
        """
        lease = _Lease(self._files, f"{self._root}/{_LOCK}", self.url)
        with _as_input_error(self.url):
            self._files.makedirs(self._root, exist_ok=True)
            lease.take()
        try:
            yield
        finally:
            lease.give_back()

    def _exists(self, key: str) -> bool:
        return bool(self._files.exists(self._path(key, MANIFEST)))

    def _path(self, key: str, name: str) -> str:
        return f"{self._root}/{key}/{name}"

    def _fetch(self, key: str) -> None:
        remote = self._files.find(f"{self._root}/{key}")
        partial = self.folder / f".partial-{uuid.uuid4().hex}"
        prefix = f"{self._root}/{key}/"
        local = [partial / path.removeprefix(prefix) for path in remote]
        for path in local:
            path.parent.mkdir(parents=True, exist_ok=True)
        self._files.get(remote, [str(path) for path in local])
        partial.rename(self.folder / key)

    def _remove(self, key: str) -> bool:
        """Whether there was anything to remove. The manifest goes first: what is left without it does not count."""
        paths = self._files.find(f"{self._root}/{key}")
        for path in sorted(paths, key=lambda path: not path.endswith(MANIFEST)):
            with suppress(FileNotFoundError):
                self._files.rm_file(path)
        return bool(paths)


class _Lease:
    """An object that says who writes until when, renewed by a thread."""

    def __init__(self, files: Any, path: str, shown: str) -> None:
        self._files, self._path, self._shown = files, path, shown
        self._me = {"host": socket.gethostname(), "pid": os.getpid(), "id": uuid.uuid4().hex}
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._renew, daemon=True)

    def take(self) -> None:
        """Raises InputError: somebody else has it."""
        self._refuse_if(_is_held(self._read()))
        self._write()
        # of two that came at the same moment, the one that wrote last has it
        time.sleep(0.1)
        self._refuse_if(self._read().get("id") != self._me["id"])
        self._thread.start()

    def give_back(self) -> None:
        """Others may write now."""
        self._ended.set()
        self._thread.join()
        with suppress(OSError):
            self._files.rm_file(self._path)

    def _refuse_if(self, held: bool) -> None:
        if held:
            raise InputError(
                self._shown,
                "another run is writing here",
                "wait until it has ended, or choose another --store",
            )

    def _renew(self) -> None:
        while not self._ended.wait(LEASE_SECONDS / 3):
            with suppress(OSError):
                self._write()

    def _write(self) -> None:
        content = json.dumps({**self._me, "until": time.time() + LEASE_SECONDS})
        self._files.pipe_file(self._path, content.encode())

    def _read(self) -> dict[str, Any]:
        try:
            lease = json.loads(self._files.cat_file(self._path))
        except (FileNotFoundError, ValueError):
            return {}
        return lease if isinstance(lease, dict) else {}


def _is_held(lease: dict[str, Any]) -> bool:
    if not lease or lease.get("until", 0.0) < time.time():
        return False
    return lease.get("host") != socket.gethostname() or _is_alive(int(lease.get("pid", 0)))


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _is_folder(entry: dict[str, Any]) -> bool:
    return entry.get("type") == "directory"


@contextmanager
def _as_input_error(url: str) -> Iterator[None]:
    try:
        yield
    except InputError:
        raise
    except ImportError as error:
        raise InputError(
            url,
            f"needs a package that is not here ({error})",
            "pip install it; for s3: pip install 'lvba[s3]'",
        ) from None
    except Exception as error:  # every file system has errors of its own
        problem = f"cannot be used ({type(error).__name__}: {error})"
        raise InputError(url, problem, "check the address and who may write there") from error
