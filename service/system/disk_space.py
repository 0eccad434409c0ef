"""What the disk has left, and whether that is enough to begin something."""

import errno
import os
from pathlib import Path

LEAST_FREE = 64 << 20
"""Bytes of disk without which nothing is begun."""
LEAST_FREE_FILES = 1000
"""Files that the disk must be able to take beside."""

EXIT_DISK_FULL = 74
"""Exit code: the disk was full, and so nothing else could be told."""


def says_full(error: BaseException) -> bool:
    """Whether an error says that the disk, or what its user may take of it, is full."""
    return isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT)


def is_full(error: BaseException | None) -> bool:
    """Whether an error, or one that led to it, says that the disk is full."""
    while error is not None:
        if says_full(error):
            return True
        error = error.__cause__ or error.__context__
    return False


def free_bytes(folder: Path) -> int:
    """What the disk of a folder has left for this user."""
    status = os.statvfs(folder)
    return status.f_bavail * status.f_frsize


def lacking(place: Path | int, needed: int = LEAST_FREE) -> str | None:
    """What the disk of a folder or open file lacks, in words; None: it has so many bytes left, and some files.

    Where a file system does not count its files, they never run out.
    """
    status = os.statvfs(place)
    free = status.f_bavail * status.f_frsize
    if free < needed:
        return f"{size(free)} are free, {size(needed)} are needed"
    if status.f_files and status.f_favail < LEAST_FREE_FILES:
        return f"the file system can take {status.f_favail} more files, {LEAST_FREE_FILES} are needed"
    return None


def size(count: float) -> str:
    """Bytes in words, such as 1.5 GB."""
    for power, unit in ((12, "TB"), (9, "GB"), (6, "MB"), (3, "kB")):
        if count >= 10**power:
            return f"{count / 10**power:.3g} {unit}"
    return f"{count:.0f} bytes"
