"""How a bag is imported by a job: the options of `lvba import` as the network may give them.

Files are those of the dataset, by their names in it. A command as odometry is never taken: it would run here.
"""

import dataclasses
import hashlib
import json
import re
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from lvba import config
from lvba.errors import InputError
from lvba.sources.importing.options import AUTO, ImportOptions, parse_conventions
from service.datasets import file_names

_WHERE = "import"
_TOPICS = ("lidar", "image", "imu")
_OPTION = re.compile(r"(?:--|^)(lidar|image|imu|odometry|calibration|camera|preset|convention)\b")


def read(values: Mapping[str, Any]) -> ImportOptions:
    """Options of JSON: types, ranges, names of files.

    Raises InputError: no such option, a wrong value, or what the network may not give.
    """
    options = config.from_mapping(ImportOptions, values, _WHERE)
    if not isinstance(options.conventions, dict) or not all(
        isinstance(each, str) for each in options.conventions.values()
    ):
        raise InputError(f"{_WHERE}: conventions", "is no object of texts", 'write {"pose_of": "lidar"}')
    answers = parse_conventions([f"{name}={value}" for name, value in options.conventions.items()])
    if "{" in options.odometry or "}" in options.odometry:
        raise InputError(
            "--odometry",
            "a server runs no commands of its users",
            "run it yourself, and give the TUM file that it writes: upload it beside the bag",
        )
    for name in options.calibration:
        try:
            file_names.checked(name)
        except InputError as error:
            raise InputError(f"--calibration {error.where}", error.problem, error.mend) from None
    return dataclasses.replace(options, conventions=answers)


def check(options: ImportOptions, inspection: Mapping[str, Any], name: str) -> None:
    """Whether a source has what is chosen of it. inspection: as the check of the dataset left it; name: of the dataset

    Raises InputError: a topic or file that is not there, several that fit, or none.
    """
    # knows the method, for which the rest of a server need not wait
    from lvba.sources.importing import data_set, streams
    from service.datasets import inspection_facts

    description = inspection_facts.description_of(dict(inspection), name)
    beside = list(inspection.get("beside", ()))
    for file in options.calibration:
        if file not in beside:
            raise InputError(f"--calibration {file}", "is not in the dataset", _upload(beside))
    asked = options.odometry
    known = {stream.name for stream in description.streams}
    if asked in beside:
        options = dataclasses.replace(options, odometry=AUTO)
    elif asked and asked != AUTO and asked not in known:
        raise InputError(
            f"--odometry {asked[:80]}",
            "is no stream of poses, and no file in the dataset",
            f"choose one of {', '.join(_poses(inspection)) or 'none there'}; auto; or a TUM file: {_upload(beside)}",
        )
    if options.camera and not options.calibration:
        raise InputError("--camera", "says nothing without a calibration", "choose a calibration too")
    streams.choose(description, options, data_set.of_source(description, options).topics)


def _poses(inspection: Mapping[str, Any]) -> list[str]:
    return [each["name"] for each in inspection["streams"] if each["kind"] == "poses"]


def _upload(beside: list[str]) -> str:
    there = f"; there are {', '.join(beside[:10])}" if beside else ""
    return f"upload it beside the bag{there}"


def place(error: InputError) -> str:
    """The option that an error is about, such as import.lidar; "import" where it is about all."""
    if isinstance(error, config.SettingError):
        return f"{_WHERE}.{error.setting}"
    match = _OPTION.search(f"{error.where} {error.problem} {error.mend}")
    name = {"convention": "conventions"}.get(match[1], match[1]) if match else ""
    return f"{_WHERE}.{name}" if name else _WHERE


def resolved(options: ImportOptions, root: Path, inspection: Mapping[str, Any]) -> ImportOptions:
    """The options with paths in the place of names of files. root: folder of the dataset"""
    odometry = options.odometry
    if odometry in inspection.get("beside", ()):
        odometry = str(root / file_names.checked(odometry))
    calibration = tuple(str(root / file_names.checked(name)) for name in options.calibration)
    return dataclasses.replace(options, odometry=odometry, calibration=calibration)


def key(options: ImportOptions) -> str:
    """Equal for imports of one dataset that give the same recording."""
    text = json.dumps([config.to_dict(options), metadata.version("lvba")], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:32]
