"""What is said to people about processes and files, without what is not theirs to know."""

import signal
from pathlib import Path

from service.server.places import Places


def of_exit(code: int) -> str:
    """How a process ended that said nothing itself."""
    if code >= 0:
        return f"the process ended with code {code}"
    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = f"signal {-code}"
    return f"the process was killed ({name})"


def without_paths(text: str, places: Places, job_id: str, recording: Path | None) -> str:
    """The text with folders of the server replaced by what they are."""
    root = str(places.root.absolute())
    known = {str(places.out(job_id).absolute()): "OUT", root: "DATA"}
    if recording is not None:
        known = {str(recording.absolute()): "DATASET", **known}
    for path, name in known.items():
        text = text.replace(path, name)
    return text
