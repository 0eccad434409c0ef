"""A dataset that must be imported before it is run, a bag or a folder of another program: what is in it and beside it."""

import os
from pathlib import Path
from typing import Any

from lvba.errors import InputError
from lvba.io import bags, files
from lvba.sources.inspection import inspect
from lvba.sources.opening import find_source
from lvba.sources.source import Source
from service.datasets import inspection_facts, recording_names

_BESIDE = (".yaml", ".yml", ".txt", ".json", ".csv", ".xml", ".tum")
_MOST_BESIDE = 200
_LARGEST_BESIDE = 64 << 20


def source_at(root: Path) -> tuple[Source, str] | None:
    """The source that a dataset is, with the name of its file ("": the dataset itself); None: it is run as it is.

    Raises InputError: it is one, and damaged past use.
    """
    if recording_names.is_recording(root):
        return None
    name = _only_bag(root)
    source = find_source(root / name if name else root)
    return (source, name) if source is not None else None


def _only_bag(root: Path) -> str:
    """The name of the bag of one file in a folder; "": there is none, or several files are one."""
    if not root.is_dir():
        return ""
    names = files.names_in(root)
    there = [name for name in names if bags.kind_of_name(name)]
    return there[0] if len(there) == 1 and "metadata.yaml" not in names else ""


def look(source: Source, root: Path, name: str) -> dict[str, Any]:
    """`facts` of a dataset, and its `inspection`. root: of the dataset, which is shown as DATASET

    Raises InputError: it has nothing to make a map from.
    """
    inspection = inspect(source)
    if not inspection.choice.lidar:
        topics = ", ".join(
            f"{each.stream.name} ({each.stream.message_type})" for each in inspection.streams[:20]
        )
        problems = [f"{each.stream.name}: {each.problem}" for each in inspection.streams if each.problem]
        said = f"it has {topics or 'no topics'}" + (f"; {problems[0]}" if problems else "")
        mend = next(iter(inspection.missing), "record a LiDAR")
        raise InputError(root / name if name else root, f"has no scans that can be read: {said}", mend)
    seen = inspection_facts.renamed(inspection_facts.facts(inspection), str(root), "DATASET")
    sentences = [*seen["notes"], *seen["missing"]]
    return {
        "facts": {
            **inspection_facts.counts(inspection),
            "format": seen["format"],
            "digest": "",
            "has_reference": False,
            "warnings": sentences,
        },
        "inspection": {**seen, "file": name, "beside": beside(root, name)},
    }


def beside(root: Path, name: str) -> list[str]:
    """Files of a dataset that may be calibrations or poses, by their names in it."""
    if not root.is_dir():
        return []
    names_there: list[str] = []
    for top, _, names in os.walk(root):
        for each in names:
            path = Path(top, each)
            fits = each.lower().endswith(_BESIDE) and each not in (name, "metadata.yaml")
            if fits and path.lstat().st_size <= _LARGEST_BESIDE:
                names_there.append(path.relative_to(root).as_posix())
    return sorted(names_there)[:_MOST_BESIDE]
