"""Names that users give to files: what is taken, and what is refused."""

import re
import unicodedata
from pathlib import Path

from lvba.errors import InputError

_PART = re.compile(r"[^\x00-\x1f\x7f\\/:*?\"<>|\ud800-\udfff]{1,200}")
_MAX_BYTES, _MAX_PARTS = 400, 12
_MEND = "use relative paths with `/` between plain names, such as all_image/1.5.png"


def checked(path: str) -> str:
    """The path as it is kept: relative, `/` between its parts.

    Raises InputError: it could lead elsewhere, or not every file system holds it.
    """
    parts = path.split("/")
    for part in parts:
        if part in ("", ".", "..") or not _PART.fullmatch(part) or part != part.strip():
            raise InputError(_shown(path), "is no plain relative path", _MEND)
        if len(part.encode()) > 200 or part.startswith("~"):
            raise InputError(_shown(path), "has a part that is no plain name", _MEND)
    if len(path.encode()) > _MAX_BYTES or len(parts) > _MAX_PARTS:
        raise InputError(_shown(path), "is too long", "use shorter paths")
    return path


def same_place(path: str) -> str:
    """What is equal for paths that some file system takes for one: letters of both cases, accents in both forms."""
    return unicodedata.normalize("NFC", path).casefold()


def take(path: str, taken: set[str], mend: str = "give it another name") -> str:
    """The path as it is kept (see `checked`), its place now among those taken.

    Raises InputError: also where some file system would put it in the place of another.
    """
    place = same_place(checked(path))
    if place in taken:
        raise InputError(_shown(path), "is there twice, or differs from another in letter case only", mend)
    taken.add(place)
    return path


def below(folder: Path, path: str) -> Path:
    """The file of this name in the folder.

    Raises InputError: the name leads out of it, also by a symbolic link.
    """
    found = (folder / checked(path)).resolve()
    if not found.is_relative_to(folder.resolve()):
        raise InputError(_shown(path), "lies elsewhere", "name a file of the folder itself")
    return found


def _shown(path: str) -> str:
    return repr(path if len(path) < 100 else path[:100] + "...")
