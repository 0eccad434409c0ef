"""What lies in a folder of no known kind: files by their endings, and sources one or two folders down.

Names alone are looked at, and no more than some of them; no symbolic link is followed.
"""

import os
from collections import Counter
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

from lvba.errors import InputError
from lvba.io import bags
from lvba.sources import folders
from lvba.sources.folders import recordings
from lvba.wording import joined

_LEVELS = 2
_MOST_FOLDERS = 200
_MOST_NAMES = 100_000
"""Of all folders together: that many are read in some tenths of a second."""
_NAMED = 3
"""Endings and sources that are named; others are counted."""
_LONGEST_ENDING = 12


@dataclass
class Contents:
    """endings: number of files by the ending of their names, "" without one; sources: what can be opened further down

    partial: there is more than was looked at
    """

    endings: Counter[str] = field(default_factory=Counter)
    sources: list[Path] = field(default_factory=list)
    partial: bool = False

    def holds(self) -> str:
        """For people: "80 .jpg, 76 .pkl and 3 .json files"."""
        order = sorted(self.endings.items(), key=lambda each: (-each[1], each[0]))
        named = [(ending, count) for ending, count in order if ending][:_NAMED]
        others = self.endings.total() - sum(count for _, count in named)
        words = [f"{count} {ending}" for ending, count in named]
        words += [f"{others} other" if named else f"{others}"] if others else []
        if not words:
            return "no files"
        noun = "file" if self.endings.total() == 1 else "files"
        return f"{'at least ' if self.partial else ''}{joined(words)} {noun}"

    def hint(self) -> str:
        """For people: which sources may be meant; "" without any."""
        if not self.sources:
            return ""
        more = len(self.sources) - _NAMED
        names = [str(path) for path in self.sources[:_NAMED]]
        return f"did you mean {joined(names, 'or')}{f' ({more} more)' if more > 0 else ''}?"


def look(path: Path) -> Contents:
    """What lies in a folder, and in those in it; what cannot be read is passed over."""
    contents, names_left, folders_left = Contents(), _MOST_NAMES, _MOST_FOLDERS
    level = [path]
    for depth in range(_LEVELS + 1):
        below: list[Path] = []
        for folder in level:
            file_names, inside, count = _names(folder, names_left)
            names_left -= count
            contents.endings.update(_ending(name) for name in file_names)
            source = _source(folder, file_names) if depth and names_left else None
            if source is not None:
                contents.sources.append(source)
            else:
                below += [folder / name for name in inside]
        if depth == _LEVELS:
            break
        contents.partial |= len(below) > folders_left
        level = below[:folders_left]
        folders_left -= len(level)
    contents.partial |= not names_left
    return contents


def _names(folder: Path, most: int) -> tuple[list[str], list[str], int]:
    """Names of files (and links) and of folders in a folder, in order, and how many names were read, `most` at most."""
    file_names, inside, count = list[str](), list[str](), 0
    try:
        with os.scandir(folder) as entries:
            for entry in islice(entries, most):
                count += 1
                if not entry.name.startswith(".") and entry.name.isprintable():
                    (inside if entry.is_dir(follow_symlinks=False) else file_names).append(entry.name)
    except OSError:
        pass
    return sorted(file_names), sorted(inside), count


def _ending(name: str) -> str:
    ending = os.path.splitext(name)[1].lower()
    known = 1 < len(ending) <= _LONGEST_ENDING and ending[1:].isalnum() and not ending[1:].isdigit()
    return ending if known else ""


def _source(folder: Path, file_names: list[str]) -> Path | None:
    """What can be opened there: the folder, or the only bag in it."""
    there = [name for name in file_names if bags.kind_of_name(name)]
    if there:
        return folder if len(there) > 1 or bags.METADATA in file_names else folder / there[0]
    try:
        return folder if folders.is_known(folder) or recordings.is_one(folder) else None
    except (InputError, OSError):
        return None
