"""Bytes from and to disk: every failure is an InputError, and a file is either whole or not there."""

import codecs
import contextlib
import errno
import hashlib
import os
import stat
import tempfile
from collections.abc import Iterator
from io import BufferedReader
from pathlib import Path

from lvba.errors import InputError, Lack
from lvba.io import no_links, partial_files

MAX_TEXT_BYTES = 64 * 1024**2
"""Longest text file read (a pose file with half a million lines)."""
MAX_BINARY_BYTES = 1024**3
"""Longest scan or image file read."""

_MENDS = {
    errno.ENOENT: "check the path",
    errno.ENOTDIR: "a part of the path is a file, not a folder: check the path",
    errno.EACCES: "give yourself permission to use it, or choose another path",
    errno.EPERM: "give yourself permission to use it, or choose another path",
    errno.EROFS: "choose a path on a disk that can be written",
    errno.ENOSPC: "free some space, or choose a path on another disk",
    errno.EDQUOT: "free some space, or choose a path on another disk",
    errno.EFBIG: "raise the limit on file sizes (ulimit -f), or choose a path on another disk",
    errno.EEXIST: "a file is in its place: remove it, or choose another path",
    errno.EISDIR: "give the path of a file",
    errno.ELOOP: "remove the symbolic link that points at itself",
    errno.ENAMETOOLONG: "choose a shorter path",
}
_LACKS = {errno.ENOSPC: Lack.DISK, errno.EDQUOT: Lack.DISK, errno.ENOMEM: Lack.MEMORY}


def input_error(path: object, error: OSError | ValueError) -> InputError:
    """The InputError that tells of a failed system call on a path."""
    if isinstance(error, OSError):
        problem = (error.strerror or str(error)).lower()
        number = error.errno or 0
        mend = _MENDS.get(number, "check the disk and the path")
        return InputError(path, problem, mend, _LACKS.get(number))
    return InputError(repr(str(path)), "not a path that the system accepts", "check the path")


@contextlib.contextmanager
def as_input_error(path: object) -> Iterator[None]:
    """Turns failures of system calls in its body into InputErrors that name the path; other errors pass."""
    try:
        yield
    except OSError as error:
        raise input_error(path, error) from error
    except ValueError as error:
        if not isinstance(error, UnicodeError) and "\0" not in str(path):
            raise
        raise input_error(path, error) from error


def size(path: str | Path, limit: int = MAX_BINARY_BYTES) -> int:
    """The size in bytes of a regular file (or link to one).

    Raises: InputError if it is none (a pipe would block forever), or longer than the limit.
    """
    with as_input_error(path):
        status = _status(path)
    if stat.S_ISDIR(status.st_mode):
        raise InputError(path, "is a folder", "give the path of a file")
    if not stat.S_ISREG(status.st_mode):
        raise InputError(path, "is not a regular file", "replace it by a file")
    if status.st_size > limit:
        raise InputError(path, f"{status.st_size} bytes, more than {limit}", "check what it is, or split it")
    return status.st_size


def read_bytes(path: str | Path, limit: int = MAX_BINARY_BYTES) -> bytes:
    """The whole content of a regular file of at most `limit` bytes.

    Raises: InputError
    """
    length = size(path, limit)
    with as_input_error(path), _opened(path) as file:
        return file.read(length)  # allocates as much as it is asked for


def sha256(path: str | Path, limit: int = MAX_BINARY_BYTES) -> str:
    """The digest of a regular file of at most `limit` bytes, hexadecimal; it is read piece by piece.

    Raises: InputError
    """
    size(path, limit)
    with as_input_error(path), _opened(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_start(path: str | Path, length: int) -> bytes:
    """The first bytes of a regular file, at most `length`.

    Raises: InputError
    """
    length = min(length, size(path))
    with as_input_error(path), _opened(path) as file:
        return file.read(length)


def read_end(path: str | Path, length: int) -> bytes:
    """The last bytes of a regular file, at most `length`.

    Raises: InputError
    """
    total = size(path)
    with as_input_error(path), _opened(path) as file:
        file.seek(max(0, total - length))
        return file.read(length)


def read_text(path: str | Path, limit: int = MAX_TEXT_BYTES) -> str:
    """The whole text of a UTF-8 file, with or without byte order mark.

    Raises: InputError
    """
    content = read_bytes(path, limit)
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise InputError(path, "is UTF-16 text", "save it as UTF-8")
    if b"\0" in content[:4096]:
        raise InputError(path, "is binary, not text", "give the text file")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise InputError(
            f"{path}:{line}", "is not UTF-8 text", "give the text file, saved as UTF-8"
        ) from error


def names_in(folder: str | Path) -> list[str]:
    """Names of all that a folder holds, sorted.

    Raises: InputError
    """
    with as_input_error(folder):
        if not no_links.are_refused(folder):
            return sorted(os.listdir(folder))
        handle = no_links.descriptor(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            return sorted(os.listdir(handle))
        finally:
            os.close(handle)


def open_binary(path: str | Path) -> BufferedReader:
    """A regular file of any length, open for reading, to be closed by the caller.

    Raises: InputError
    """
    size(path, limit=2**63)
    with as_input_error(path):
        return _opened(path)


def _opened(path: str | Path) -> BufferedReader:
    """The file, open for reading."""
    if (pieces := partial_files.opened(path)) is not None:
        return pieces
    if no_links.are_refused(path):
        return os.fdopen(no_links.descriptor(path), "rb")
    return open(path, "rb")


def _status(path: str | Path) -> os.stat_result:
    if not no_links.are_refused(path):
        return os.stat(path)
    handle = no_links.descriptor(path)
    try:
        return os.fstat(handle)
    finally:
        os.close(handle)


def write_bytes(path: str | Path, content: bytes, *, durable: bool = False) -> None:
    """Writes a file under a temporary name beside it and renames: readers see the old file, the new one, or none.

    durable: also wait until it is on the disk, so that it survives a power cut.
    Raises: InputError if it cannot be written; nothing is left behind then.
    """
    path = Path(path)
    with as_input_error(path):
        handle, temporary = tempfile.mkstemp(
            prefix=f".{path.name[:100]}.", suffix=".partial", dir=path.parent
        )
    try:
        with as_input_error(path):
            _write_and_close(handle, content, durable)
            os.replace(temporary, path)
            if durable:
                sync(path.parent)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(temporary)
        raise


def write_text(path: str | Path, text: str, *, durable: bool = False) -> None:
    """`write_bytes` of the text in UTF-8."""
    write_bytes(path, text.encode(), durable=durable)


def make_folder(path: str | Path) -> Path:
    """The folder, made with its parents if it was not there.

    Raises: InputError
    """
    folder = Path(path)
    with as_input_error(path):
        for part in (folder, *folder.parents):
            if os.path.islink(part) and not os.path.exists(part):
                raise InputError(
                    part,
                    f"is a symbolic link to {os.readlink(part)}, which does not exist",
                    "make that folder, or choose another path",
                )
        folder.mkdir(parents=True, exist_ok=True)
    return folder


def try_to_write(folder: str | Path) -> None:
    """Passes if a file can be made and filled in the folder; removes it again.

    Raises: InputError
    """
    with as_input_error(folder):
        handle, temporary = tempfile.mkstemp(prefix=".writable.", suffix=".partial", dir=folder)
    try:
        with as_input_error(folder):
            _write_and_close(handle, b"\0" * 4096, durable=True)
    finally:
        os.unlink(temporary)


def _temporary(path: Path) -> tuple[int, str]:
    """The handle and name of a new empty file beside the path."""
    with as_input_error(path):
        return tempfile.mkstemp(prefix=f".{path.name[:100]}.", suffix=".partial", dir=path.parent)


def _write_and_close(handle: int, content: bytes, durable: bool) -> None:
    with os.fdopen(handle, "wb") as file:
        file.write(content)
        file.flush()
        os.fchmod(file.fileno(), 0o666 & ~_umask())  # mkstemp makes files that only the owner reads
        if durable:
            os.fsync(file.fileno())


def _umask() -> int:
    """The process's umask, read without changing it (setting and restoring it would race with other threads)."""
    try:
        with open("/proc/self/status", encoding="ascii") as status:
            return next(int(line.split()[1], 8) for line in status if line.startswith("Umask"))
    except (OSError, StopIteration, ValueError):
        return 0o022


def sync(path: Path) -> None:
    """Wait until the content of a file, or the names in a folder, are on the disk.

    Raises: OSError
    """
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
