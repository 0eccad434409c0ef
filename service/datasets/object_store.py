"""Bringing a recording from an object store to this machine's disk.

A run reads its recording many times, from several processes: it is copied once, when the dataset is checked. Where the
store is and who asks it (endpoint, keys) says the server's environment alone, never a request.
"""

import errno
import json
import os
import threading
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lvba.errors import InputError
from service.datasets import file_names
from service.datasets.intake_budget import TooLargeError
from service.settings import Limits
from service.system.disk_space import LEAST_FREE, free_bytes, says_full

_AT_ONCE = 8
"""Objects that are fetched at a time."""
_ARRIVING = ".arriving"
_LISTING = "listing.json"
_VERSION = ("size", "ETag", "etag", "md5Hash", "LastModified", "last_modified", "updated", "created")
"""What the stores call what changes with the content."""


@dataclass(frozen=True)
class _Object:
    """path: in the store; size: bytes; version: what tells this content from a later one, as far as the store says"""

    path: str
    size: int
    version: str


def fetch(
    url: str, folder: Path, limits: Limits, room_bytes: float, room_files: float = float("inf")
) -> None:
    """Have all objects below the URL as files below the folder; what an earlier fetch left there is not fetched again.

    room_bytes, room_files: that the owner may still have
    Raises InputError: nothing there, no access, names that are no plain paths, more than is allowed. TooLargeError: more
    than that. OSError: no room on the disk.
    """
    folder.mkdir(parents=True, exist_ok=True)
    listing = folder.with_name(folder.name + "." + _LISTING)
    store, root = _opened(url)
    objects = _listed(url, store, root, limits)
    total = sum(each.size for each in objects.values())
    if total > room_bytes or len(objects) > room_files:
        raise TooLargeError
    known = _known(listing)
    missing = {
        name: each for name, each in objects.items() if not _is_here(folder / name, each, known.get(name))
    }
    if sum(each.size for each in missing.values()) > free_bytes(folder) - max(
        LEAST_FREE, limits.disk_reserve_bytes
    ):
        raise OSError(errno.ENOSPC, "no room for the recording")
    _remove_others(folder, objects)
    listing.write_text(json.dumps({name: each.version for name, each in objects.items()}))
    _get_all(url, store, folder, missing)
    listing.unlink()


def _opened(url: str) -> tuple[Any, str]:
    try:
        from fsspec.core import url_to_fs

        store, root = url_to_fs(url, use_listings_cache=False, skip_instance_cache=True)
    except ImportError as error:
        raise InputError(
            url, f"needs a package that is not here ({error})", "ask the server's administrator"
        ) from None
    except Exception as error:  # every file system has errors of its own
        raise _unreadable(url, error) from error
    return store, str(root).rstrip("/")


def _unreadable(url: str, error: Exception) -> InputError:
    return InputError(
        url,
        f"cannot be read ({type(error).__name__})",
        "check the address, and that the server may read there",
    )


def _listed(url: str, store: Any, root: str, limits: Limits) -> dict[str, _Object]:
    """The objects by their paths below the root."""
    try:
        listing = store.find(root, detail=True)
    except Exception as error:
        raise _unreadable(url, error) from error
    objects: dict[str, _Object] = {}
    places: set[str] = set()
    total = 0
    for path, facts in sorted(listing.items()):
        if path.endswith("/") or facts.get("type") == "directory" or path == root:
            continue
        name = file_names.take(path.removeprefix(root + "/"), places)
        objects[name] = _Object(path, int(facts.get("size") or 0), _version(facts))
        total += objects[name].size
        if len(objects) > limits.archive_entries or total > limits.archive_bytes:
            allowed = f"{limits.archive_entries} files or {limits.archive_bytes} bytes"
            raise InputError(url, f"holds more than {allowed}", "name the folder of a single recording")
    if not objects:
        raise InputError(url, "holds no files", "name the folder of a recording")
    return objects


def _version(facts: Mapping[str, Any]) -> str:
    return " ".join(str(facts[name]) for name in _VERSION if facts.get(name))


def _known(listing: Path) -> dict[str, str]:
    try:
        digests: dict[str, str] = json.loads(listing.read_text())
        return digests
    except (OSError, ValueError):
        return {}


def _is_here(file: Path, wanted: _Object, version: str | None) -> bool:
    return version == wanted.version and file.is_file() and file.stat().st_size == wanted.size


def _remove_others(folder: Path, objects: Mapping[str, _Object]) -> None:
    for top, _, files in os.walk(folder):
        for file in files:
            path = Path(top, file)
            if path.relative_to(folder).as_posix() not in objects:
                path.unlink()


def _get_all(url: str, store: Any, folder: Path, wanted: Mapping[str, _Object]) -> None:
    failed = threading.Event()

    def get(name: str, each: _Object) -> None:
        if failed.is_set():
            return
        try:
            _get(url, store, folder / name, each)
        except BaseException:
            failed.set()
            raise

    with ThreadPoolExecutor(_AT_ONCE) as threads:
        for each in [threads.submit(get, *item) for item in wanted.items()]:
            each.result()


def _get(url: str, store: Any, file: Path, wanted: _Object) -> None:
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise InputError(
            repr(file.name), "is there as a file and as a folder", "give one another name"
        ) from None
    arriving = file.with_name(file.name + _ARRIVING)
    try:
        store.get_file(wanted.path, str(arriving))
    except OSError as error:
        if says_full(error):
            raise
        raise _unreadable(url, error) from error
    except Exception as error:
        raise _unreadable(url, error) from error
    if arriving.stat().st_size != wanted.size:
        raise InputError(url, "was changed while it was read", "register it again when nobody writes there")
    arriving.replace(file)
