"""An odometry that the user has installed, run as a program of its own: it reads the source and writes TUM poses."""

import os
import shlex
import signal
import subprocess
import tempfile
from collections import deque
from collections.abc import Callable
from pathlib import Path

from lvba.errors import InputError
from lvba.io import tum
from lvba.trajectory import Trajectory

INPUT, OUTPUT = "{bag}", "{out}"
_WAIT_S = 0.2
_GRACE_S = 10.0
_LAST_LINES = 3


def is_command(text: str) -> bool:
    """Whether `--odometry` is a command: it has the places for the source and for what is written."""
    return INPUT in text and OUTPUT in text


def run(command: str, source: Path, check: Callable[[], None]) -> Trajectory:
    """The poses that the command writes, as TUM lines, to the file in the place of {out}.

    command: program and arguments, with {bag} and {out} in them; no shell reads it
    check: called some times a second; it may raise, which ends the program
    Raises InputError: the program is not there, fails, or writes no poses.
    """
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise InputError("odometry", f"the command cannot be read: {error}", "balance its quotes") from error
    with tempfile.TemporaryDirectory(prefix="lvba-odometry-") as folder:
        out, log = Path(folder) / "poses.txt", Path(folder) / "log"
        filled = [word.replace(INPUT, str(source)).replace(OUTPUT, str(out)) for word in words]
        code = _run(filled, log, check)
        said = _last_lines(log)
        if code:
            raise InputError(
                words[0], f"ended with exit code {code}{said}", "run it alone to see what it needs"
            )
        if not out.is_file():
            raise InputError(words[0], f"has written no file in the place of {OUTPUT}{said}", _HOW)
        return tum.read_trajectory(out)


_HOW = f"let it write TUM lines (t tx ty tz qx qy qz qw) to {OUTPUT}"


def _run(words: list[str], log: Path, check: Callable[[], None]) -> int:
    with log.open("wb") as said:
        try:
            process = subprocess.Popen(
                words,
                stdin=subprocess.DEVNULL,
                stdout=said,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # so that what it starts itself ends with it
            )
        except OSError as error:
            problem = f"cannot be run: {error.strerror}"
            raise InputError(words[0], problem, "install it, or give its whole path") from error
        try:
            while True:
                try:
                    return process.wait(_WAIT_S)
                except subprocess.TimeoutExpired:
                    check()
        finally:
            _end(process)


def _end(process: "subprocess.Popen[bytes]") -> None:
    if process.poll() is not None:
        return
    os.killpg(process.pid, signal.SIGTERM)
    try:
        process.wait(_GRACE_S)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def _last_lines(log: Path) -> str:
    """What a program said last, for an error; "" where it said nothing."""
    with log.open(errors="replace") as lines:
        last = deque((line.strip() for line in lines if line.strip()), _LAST_LINES)
    return f": {' / '.join(last)}" if last else ""
