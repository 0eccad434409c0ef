"""The list of recordings of a batch, and the order in which they get their turn."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lvba import config
from lvba.errors import InputError
from lvba.io import files, plain_yaml
from lvba.sources.importing.options import ImportOptions, parse_conventions

_FIELDS = {"dataset", "name", "config", "set", "import", "reference", "group"}
MAX_BYTES = 4 * 1024**2
"""Longest manifest read: some ten thousand recordings."""
_MEND = "see lvba batch --help"


@dataclass(frozen=True)
class Entry:
    """One recording with what it is run with. Paths are as they can be opened.

    imported: options of its import, None: it needs none, or none beside those by default
    """

    name: str
    dataset: Path
    config: Path | None = None
    settings: tuple[str, ...] = ()
    reference: Path | None = None
    group: str = ""
    imported: ImportOptions | None = None


def read(manifest: Path) -> list[Entry]:
    """The entries in the order of the file.

    Raises InputError: no list of recordings, an unknown field, two entries of one name.
    """
    document = plain_yaml.load(files.read_text(manifest, MAX_BYTES), manifest, "mend it")
    if not isinstance(document, list) or not document:
        raise InputError(manifest, "is not a list of recordings", _MEND)
    entries = [_entry(f"{manifest}, entry {i + 1}", manifest.parent, item) for i, item in enumerate(document)]
    for number, entry in enumerate(entries):
        if any(entry.name == other.name for other in entries[:number]):
            raise InputError(
                manifest, f"two entries are named {entry.name!r}", "give one of them another `name`"
            )
    return entries


def in_turns(entries: Sequence[Entry]) -> list[Entry]:
    """The entries so that groups take turns, each in its own order: a long list does not hold up a short one."""
    groups: dict[str, list[Entry]] = {}
    for entry in entries:
        groups.setdefault(entry.group, []).append(entry)
    rounds = max(map(len, groups.values()), default=0)
    return [members[turn] for turn in range(rounds) for members in groups.values() if turn < len(members)]


def _entry(where: str, folder: Path, item: Any) -> Entry:
    if not isinstance(item, dict) or not isinstance(item.get("dataset"), str):
        raise InputError(where, "has no `dataset`", _MEND)
    unknown = set(item) - _FIELDS
    if unknown:
        raise InputError(where, f"has an unknown field {min(map(str, unknown))!r}", _MEND)
    dataset = folder / item["dataset"]
    name = str(item.get("name") or dataset.resolve().name)
    if Path(name).name != name or name.startswith("."):
        raise InputError(where, f"{name!r} cannot be the name of a folder", "give it another `name`")
    settings = item.get("set") or []
    if not isinstance(settings, list):
        raise InputError(where, "`set` is not a list", "write it as a list of NAME=VALUE")
    settings_file, reference = (
        folder / item[field] if item.get(field) else None for field in ("config", "reference")
    )
    return Entry(
        name=name,
        dataset=dataset,
        config=settings_file,
        settings=tuple(map(str, settings)),
        reference=reference,
        group=str(item.get("group") or ""),
        imported=_imported(where, folder, item["import"]) if item.get("import") else None,
    )


def _imported(where: str, folder: Path, values: Any) -> ImportOptions:
    """Options with the paths of files as they can be opened.

    Raises InputError: no such option, or a wrong value.
    """
    if not isinstance(values, dict):
        raise InputError(where, "`import` is no list of options and values", _MEND)
    options = config.from_mapping(ImportOptions, values, f"{where}, import")
    answers = [f"{question}={answer}" for question, answer in options.conventions.items()]
    file = folder / options.odometry
    return replace(
        options,
        conventions=parse_conventions(answers),
        calibration=tuple(str(folder / name) for name in options.calibration),
        odometry=str(file) if options.odometry and file.is_file() else options.odometry,
    )
