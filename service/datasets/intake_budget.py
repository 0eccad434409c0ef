"""What comes of an upload while it is put together, unpacked or fetched, counted against all that limits it."""

import errno
import os
from dataclasses import dataclass, field
from pathlib import Path

from lvba.errors import InputError
from service.datasets import file_names
from service.settings import Limits
from service.system import disk_space

_SMALL = 1 << 20
"""Bytes that anything may decompress to: what is small harms nobody, and text packs well."""


EXCEEDED = "the datasets and results of this owner would be too large, or too many files"


class TooLargeError(Exception):
    """More than its owner may have."""

    def __init__(self) -> None:
        super().__init__(EXCEEDED)


@dataclass
class IntakeBudget:
    """Of one dataset: names may not be there twice; files, folders and bytes not beyond a limit, a quota or the disk."""

    folder: Path
    """Where it is put together."""
    limits: Limits
    room_bytes: float = float("inf")
    """That its owner may still have."""
    room_files: float = float("inf")
    files: int = 0
    bytes: int = 0
    _folders: set[str] = field(default_factory=set)
    _taken: set[str] = field(default_factory=set)
    _packed: int | None = None
    _unpacked: tuple[int, int] = (0, 0)
    """Files and folders, and bytes, that were there before the archive."""

    def begin_archive(self, size: int) -> None:
        """What comes from now on comes out of an archive of so many bytes."""
        self._packed, self._unpacked = size, (self.files + len(self._folders), self.bytes)

    def add_file(self, name: str, mend: str = "give it another name") -> None:
        """One more, before it is there.

        Raises InputError: its name cannot be, or there are more files than are allowed. TooLargeError, OSError: no room.
        """
        file_names.take(name, self._taken, mend)
        self.files += 1
        parts = name.split("/")[:-1]
        self._folders.update("/".join(parts[: number + 1]) for number in range(len(parts)))
        entries = self.files + len(self._folders) - self._unpacked[0]
        if self._packed is not None and entries > self.limits.archive_entries:
            allowed = f"{self.limits.archive_entries} files and folders"
            raise InputError("the archive", f"holds more than {allowed}", "split it into datasets")
        self._check_room()

    def add_bytes(self, count: int) -> None:
        """Of a file, before they are there.

        Raises InputError: more than is allowed. TooLargeError, OSError: no room.
        """
        self.bytes += count
        if self._packed is not None:
            self._check_archive(self._packed, self.bytes - self._unpacked[1])
        self._check_room()

    def _check_archive(self, packed: int, unpacked: int) -> None:
        if unpacked > self.limits.archive_bytes:
            allowed = f"{self.limits.archive_bytes} bytes"
            raise InputError("the archive", f"holds more than {allowed}", "split it into datasets")
        if unpacked > _SMALL + self.limits.archive_ratio * packed:
            raise InputError(
                "the archive",
                f"is more than {self.limits.archive_ratio:g} times smaller than what it holds",
                "it looks like a decompression bomb: upload the files themselves",
            )

    def _check_room(self) -> None:
        if self.bytes > self.room_bytes or self.files > self.room_files:
            raise TooLargeError
        # what one owner sends must not leave the others without a disk
        if disk_space.lacking(self.folder, max(self.limits.disk_reserve_bytes, disk_space.LEAST_FREE)):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
