"""The folder that a recording is written to: empty, or of the same import, which then continues where it was stopped."""

import json
import os
from pathlib import Path

from lvba.errors import InputError
from lvba.io import files

STATE = ".import.json"
RECORDING = "recording.yaml"
SCANS, IMAGES = "all_pcd_body", "all_image"
_MEND = "give --out a folder that is empty or not there yet, or remove this one"


def prepare(out: Path, key: str) -> bool:
    """Makes the folder ready for the import with this key; whether all of it is there already.

    One of another import that ended before it wrote a frame, as for a missing option, is taken over.
    Raises InputError: it holds something else, or cannot be written.
    """
    files.make_folder(out)
    names = files.names_in(out)
    state = _state(out / STATE) if STATE in names else {}
    if names and not state:
        raise InputError(out, "is not empty, and not of an import", _MEND)
    if state and state.get("key") != key and (state.get("done") or _has_frames(out)):
        raise InputError(out, "holds an import of another source, or with other options", _MEND)
    if state.get("done"):
        return True
    files.write_text(out / STATE, _text(key, done=False))
    for name in (SCANS, IMAGES):
        files.make_folder(out / name)
    for folder in (out, out / SCANS, out / IMAGES):
        for name in files.names_in(folder):
            if name.startswith(".") and name.endswith(".partial"):  # of a process that was killed
                with files.as_input_error(folder / name):
                    os.unlink(folder / name)
    return False


def finish(out: Path, key: str) -> None:
    """Notes that all is there. Raises InputError: it cannot be written."""
    if not files.names_in(out / IMAGES):
        with files.as_input_error(out / IMAGES):
            os.rmdir(out / IMAGES)
    files.write_text(out / STATE, _text(key, done=True), durable=True)


def _has_frames(out: Path) -> bool:
    return any((out / name).is_dir() and files.names_in(out / name) for name in (SCANS, IMAGES))


def _text(key: str, done: bool) -> str:
    return json.dumps({"key": key, "done": done}) + "\n"


def _state(path: Path) -> dict[str, object]:
    try:
        facts = json.loads(files.read_text(path, 4096))
    except (InputError, ValueError):
        return {}
    return facts if isinstance(facts, dict) else {}
