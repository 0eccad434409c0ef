"""Opening files without following a symbolic link, in any part of their path.

Whoever may write into a folder could put a link there, before or while it is read, and have this program read a file that
only the program may read. Each part of the path is opened below the one before: no moment lies between check and use.
"""

import errno
import os
import stat
from collections.abc import Iterable
from pathlib import Path

from lvba.errors import InputError

_FOLDER = os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC | getattr(os, "O_PATH", os.O_RDONLY)
"""Folders on the way need not be readable, only passable, where the system can tell the two apart."""
_refused: tuple[str, ...] = ()


def refuse_below(folders: Iterable[str | Path]) -> None:
    """From now on this process follows no link at or below these folders, nor on the way to them; elsewhere it does."""
    global _refused
    _refused = tuple(os.path.abspath(folder) for folder in folders)


def refused() -> tuple[str, ...]:
    """The folders of `refuse_below`."""
    return _refused


def are_refused(path: str | Path) -> bool:
    """Whether the path lies in or below a folder of `refuse_below`."""
    whole = os.path.abspath(path)
    return any(whole == folder or whole.startswith(folder.rstrip("/") + "/") for folder in _refused)


def descriptor(path: str | Path, flags: int = os.O_RDONLY) -> int:
    """A descriptor of the file or folder at a path without links; a pipe does not block.

    Raises: InputError where a part of the path is a link; OSError as `os.open` does
    """
    first, *parts = Path(os.path.abspath(path)).parts
    folder = os.open(first, os.O_DIRECTORY | os.O_CLOEXEC | getattr(os, "O_PATH", os.O_RDONLY))
    try:
        for index, part in enumerate(parts):
            last = index == len(parts) - 1
            wanted = flags | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK if last else _FOLDER
            inner = _open(part, wanted, folder, Path(first, *parts[: index + 1]))
            os.close(folder)
            folder = inner
    except BaseException:
        os.close(folder)
        raise
    return folder


def _open(part: str, flags: int, folder: int, path: Path) -> int:
    try:
        return os.open(part, flags, dir_fd=folder)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.ENOTDIR, errno.EMLINK) and _is_link(part, folder):
            mend = "put the file or folder itself in its place, or mount it there"
            raise InputError(path, "is a symbolic link, which is not followed here", mend) from None
        error.filename = str(path)
        raise


def _is_link(part: str, folder: int) -> bool:
    try:
        return stat.S_ISLNK(os.stat(part, dir_fd=folder, follow_symlinks=False).st_mode)
    except OSError:
        return False
