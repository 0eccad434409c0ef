"""Reading along in a file that another process adds to, also after somebody has removed it."""

import os
from pathlib import Path

_LAST = 1 << 16


class Tail:
    """The lines of a file as they come. It is made if it is not there, and held: removed, it can still be read."""

    def __init__(self, file: Path) -> None:
        self._stream = os.fdopen(os.open(file, os.O_RDONLY | os.O_CREAT | os.O_CLOEXEC, 0o644), "rb")

    def lines(self) -> list[bytes]:
        """Whole lines that came since the last call."""
        begin = self._stream.tell()
        data = self._stream.read()
        whole = data[: data.rfind(b"\n") + 1]
        self._stream.seek(begin + len(whole))
        return whole.splitlines()

    def close(self) -> None:
        """Let it go."""
        self._stream.close()


def size(file: Path) -> int:
    """Bytes of a file; 0: there is none."""
    try:
        return file.stat().st_size
    except OSError:
        return 0


def last_line(file: Path) -> str:
    """The last line with something in it; empty where the file is gone or holds none."""
    try:
        with file.open("rb") as stream:
            stream.seek(max(size(file) - _LAST, 0))
            lines = stream.read().decode("utf-8", "replace").splitlines()
    except OSError:
        return ""
    return next((line for line in reversed(lines) if line.strip()), "")
