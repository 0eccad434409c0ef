"""Files written piece by piece: whole at the end, or not there."""

import contextlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from lvba.io import files


@contextlib.contextmanager
def writer(path: str | Path, *, durable: bool = True) -> Iterator[BinaryIO]:
    """A binary file open for writing under a temporary name, renamed to `path` when the block ends well.

    durable: also wait until it is on the disk.
    Raises: InputError if it cannot be written; nothing is left behind then.
    """
    path = Path(path)
    with files.as_input_error(path):
        handle, temporary = tempfile.mkstemp(
            prefix=f".{path.name[:100]}.", suffix=".partial", dir=path.parent
        )
        mode = 0o666 & ~files._umask()  # mkstemp makes files that only the owner reads
    try:
        with files.as_input_error(path), os.fdopen(handle, "wb") as file:
            os.fchmod(file.fileno(), mode)
            yield file
            file.flush()
            if durable:
                os.fsync(file.fileno())
        with files.as_input_error(path):
            os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(temporary)
        raise
