"""`lvba submit BAG`: looked at here, before anything of it is sent, by the reader that the server has."""

import dataclasses
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lvba import config
from lvba.errors import InputError
from lvba.sources.importing.options import ImportOptions
from service.cli import inspect_command
from service.cli.progress import Display
from service.datasets import file_names, import_choices, source_check


@dataclass(frozen=True)
class BagSubmission:
    """choices: of the import, as the server takes them; files: to send, with their names in the dataset"""

    choices: dict[str, Any]
    files: tuple[tuple[Path, str], ...]


def prepare(options: ImportOptions, recording: Path, display: Display) -> BagSubmission | None:
    """What is sent of a bag, or a folder of another program, after it was looked at; None: it is a recording.

    Raises InputError: it is damaged, does not have what is chosen of it, or several streams fit.
    """
    if "{" in options.odometry:
        problem = "a server runs no commands of its users"
        raise InputError("--odometry", problem, "run it here, and give the TUM file that it writes")
    opened = source_check.source_at(recording)
    if opened is None:
        if options != ImportOptions():
            raise InputError(
                recording, "is no bag, and needs no import", "leave the options of an import out"
            )
        return None
    source, name = opened
    display.stage("inspect", 0, 3)
    inspection = source_check.look(source, recording, name)["inspection"]
    for line in inspect_command.text_lines(recording, source):
        display.tell(line)
    files = dict(_own_files(recording))
    named = dataclasses.replace(
        options,
        calibration=tuple(_beside(Path(each), files) for each in options.calibration),
        odometry=_beside(Path(options.odometry), files)
        if options.odometry and os.path.isfile(options.odometry)
        else options.odometry,
    )
    beside = sorted({*inspection["beside"], *named.calibration, named.odometry} & files.keys())
    import_choices.check(named, {**inspection, "beside": beside}, str(recording))
    return BagSubmission(changed(named), tuple((path, name) for name, path in sorted(files.items())))


def changed(options: ImportOptions) -> dict[str, Any]:
    """What of the options is not as by default."""
    defaults = config.to_dict(ImportOptions())
    return {name: value for name, value in config.to_dict(options).items() if value != defaults[name]}


def _own_files(recording: Path) -> Iterator[tuple[str, Path]]:
    if recording.is_file():
        yield recording.name, recording
        return
    for path in sorted(recording.rglob("*")):
        name = path.relative_to(recording).as_posix()
        if path.is_file() and not any(part.startswith(".") for part in name.split("/")):
            yield name, path


def _beside(path: Path, files: dict[str, Path]) -> str:
    """The name in the dataset of a file that is given beside it; it is sent too.

    Raises InputError: it is not there, or another file has its name.
    """
    if not path.is_file():
        raise InputError(path, "there is no such file", "give the path of a file")
    known = {os.path.realpath(inner): name for name, inner in files.items()}
    if (inside := known.get(os.path.realpath(path))) is not None:
        return inside
    name = file_names.plain(path.name, "given.txt")
    if name in files:
        raise InputError(path, "has the name of another file of the recording", "rename one of the two")
    files[name] = path
    return name
