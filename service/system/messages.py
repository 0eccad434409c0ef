"""What is said to people about processes and files, without what is not theirs to know."""

import re
import signal
from pathlib import Path

from lvba.errors import InputError
from service.system.paths import Paths

_IMPORTED = re.compile(r"DATA/datasets/\w+/imports/[0-9a-f]+")
"""The recording that a job made of a bag."""


def of_exit(code: int) -> str:
    """How a process ended that said nothing itself."""
    if code >= 0:
        return f"the process ended with code {code}"
    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = f"signal {-code}"
    return f"the process was killed ({name})"


def of_error(error: Exception) -> str:
    """What went wrong with a file, or with what should be in it."""
    if isinstance(error, InputError):
        return f"{error.where}: {error.problem}"
    if isinstance(error, OSError):
        return f"{error.filename or 'a file'}: {(error.strerror or str(error)).lower()}"
    return f"{type(error).__name__}: {error}"


def without_paths(text: str, paths: Paths, job_id: str, recording: Path | None) -> str:
    """The text with folders of the server replaced by what they are."""
    root = str(paths.root.absolute())
    known = {str(paths.out(job_id).absolute()): "OUT", root: "DATA"}
    if recording is not None:
        known = {str(recording.absolute()): "DATASET", **known}
    for path, name in known.items():
        text = text.replace(path, name)
    return _IMPORTED.sub("RECORDING", text)
