"""Writing files that a server names: below one folder, through no link, whoever put it there."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from lvba.errors import InputError
from lvba.io import files

_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC


class OutFolder:
    """A folder, made if it was not there.

    named_by_server: then it must be none that holds other things, nor a link
    Raises InputError: it cannot be used.
    """

    def __init__(self, path: Path, *, named_by_server: bool = False) -> None:
        self.path = path
        with files.as_input_error(path):
            if not named_by_server:
                path.mkdir(parents=True, exist_ok=True)
                self._handle = os.open(path, _FOLDER)
                return
            if not os.path.lexists(path):
                path.mkdir()
        with _no_link(path):
            self._handle = os.open(path, _FOLDER | os.O_NOFOLLOW)

    def holds_more_than(self, names: set[str]) -> bool:
        """Whether there is anything beside these files, their folders, and what is arriving of them."""
        known = {name.split("/")[0] for name in names}
        return any(name not in known and not name.endswith(".partial") for name in os.listdir(self._handle))

    @contextmanager
    def file(self, name: str) -> Iterator["OutFile"]:
        """The place of a file with this name, which may have folders in it, until the block ends.

        Raises InputError: a part of it is a link or a file, or cannot be written.
        """
        *folders, last = name.split("/")
        handle = os.dup(self._handle)
        try:
            for index, part in enumerate(folders):
                where = self.path.joinpath(*folders[: index + 1])
                with files.as_input_error(where), suppress(FileExistsError):
                    os.mkdir(part, dir_fd=handle)
                with _no_link(where):
                    inner = os.open(part, _FOLDER | os.O_NOFOLLOW, dir_fd=handle)
                os.close(handle)
                handle = inner
            with files.as_input_error(self.path / name):
                yield OutFile(handle, last)
        finally:
            os.close(handle)

    def close(self) -> None:
        """Let it go."""
        os.close(self._handle)


class OutFile:
    """Where a file is to be, and what has arrived of it, under another name."""

    def __init__(self, folder: int, name: str) -> None:
        self._folder, self._name, self._partial = folder, name, f".{name}.partial"

    def arrived(self) -> int:
        """Bytes that are there of it."""
        try:
            return os.stat(self._partial, dir_fd=self._folder, follow_symlinks=False).st_size
        except FileNotFoundError:
            return 0

    def opened(self, flags: int) -> int:
        """A descriptor of what has arrived; flags: beside those for links and modes."""
        return os.open(self._partial, flags | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666, dir_fd=self._folder)

    def forget(self) -> None:
        """Remove what has arrived."""
        with suppress(FileNotFoundError):
            os.unlink(self._partial, dir_fd=self._folder)

    def finish(self) -> None:
        """Give it its name."""
        os.replace(self._partial, self._name, src_dir_fd=self._folder, dst_dir_fd=self._folder)


@contextmanager
def _no_link(path: Path) -> Iterator[None]:
    try:
        with files.as_input_error(path):
            yield
    except InputError:
        if path.is_symlink():
            raise InputError(
                path, "is a symbolic link, which is not followed", "give another --out"
            ) from None
        raise
