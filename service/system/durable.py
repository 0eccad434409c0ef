"""Having files and folders on the disk before anybody is told that they are there: a power cut takes what is not."""

import ctypes
import os
import sys
from pathlib import Path

from lvba.io import files


def make_folder(folder: Path) -> None:
    """Make a folder, with its parents, whose names are on the disk."""
    missing = [folder, *folder.parents]
    missing = missing[: next(number for number, each in enumerate(missing) if each.is_dir())]
    folder.mkdir(parents=True, exist_ok=True)
    for each in reversed(missing):
        files.sync(each.parent)


def sync_all(folder: Path) -> None:
    """Wait until everything below a folder is on the disk, however many files that are.

    Raises OSError: the disk could not take it.
    """
    if sys.platform != "linux":
        os.sync()
        return
    # one call for the file system of the folder: one for each file takes milliseconds, and some have 100,000 files
    handle = os.open(folder, os.O_RDONLY)
    try:
        if ctypes.CDLL(None, use_errno=True).syncfs(handle):
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()), str(folder))
    finally:
        os.close(handle)
