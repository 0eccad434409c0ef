"""Which reader a bag or folder of another program gets."""

import os
from collections.abc import Callable
from pathlib import Path

from lvba.errors import InputError
from lvba.sources import contents, folders
from lvba.sources.bags.bag_source import open_bag
from lvba.sources.source import Source

_READERS: tuple[Callable[[Path], Source | None], ...] = (open_bag, folders.find)
"""In this order: each gives a source, or None where the path is nothing that it knows."""


def find_source(path: Path) -> Source | None:
    """The source at a path; None: it is nothing that is read here.

    Raises InputError: it is one, and damaged past use.
    """
    return next((source for read in _READERS if (source := read(path)) is not None), None)


def open_source(path: Path) -> Source:
    """The source at a path.

    Raises InputError: it is nothing that is read here, or damaged past use.
    """
    if (source := find_source(path)) is not None:
        return source
    problem, mend = (
        "is neither a bag nor a folder of a kind that is known",
        "docs/sources.md lists what is read",
    )
    if os.path.isdir(path):
        seen = contents.look(path)
        problem, mend = f"{problem}: it holds {seen.holds()}", seen.hint() or mend
    raise InputError(path, problem, mend)
