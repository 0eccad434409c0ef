"""Names that users give to files: what is taken, and what is refused."""

import os
import re
import stat
import unicodedata
from io import BufferedReader
from pathlib import Path

from lvba.errors import InputError
from lvba.io import files, no_links
from service.system.printable import printable

_PART = re.compile(r"[^\x00-\x1f\x7f\\/:*?\"<>|\ud800-\udfff]{1,200}")
_MAX_BYTES, _MAX_PARTS = 400, 12
_MEND = "use relative paths with `/` between plain names, such as all_image/1.5.png"


def checked(path: str) -> str:
    """The path as it is kept: relative, `/` between its parts.

    Raises InputError: it could lead elsewhere, or not every file system holds it.
    """
    parts = path.split("/")
    for part in parts:
        if (
            part in ("", ".", "..")
            or not _PART.fullmatch(part)
            or part != part.strip()
            or printable(part) != part
        ):
            raise InputError(_shown(path), "is no plain relative path", _MEND)
        if len(part.encode()) > 200 or part.startswith("~"):
            raise InputError(_shown(path), "has a part that is no plain name", _MEND)
    if len(path.encode()) > _MAX_BYTES or len(parts) > _MAX_PARTS:
        raise InputError(_shown(path), "is too long", "use shorter paths")
    return path


_STRANGE = re.compile(r"[\\/:*?\"<>|]")
_RESERVED = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)
"""Names of devices on some systems, whatever comes after a dot."""


def is_plain(name: str) -> bool:
    """Whether a name that users see can be the name of a folder, and looks like what it is."""
    return (
        name != ""
        and name == name.strip()
        and name[0] not in ".~"
        and not any(letter in "/\\" for letter in name)
        and printable(name) == name
        and not _RESERVED.fullmatch(name)
    )


def plain(name: str, otherwise: str) -> str:
    """The name as every system takes it for one file or folder, at most 100 characters.

    otherwise: what comes back where nothing is left
    """
    seen = "".join(letter if printable(letter) == letter else "_" for letter in name)
    kept = _STRANGE.sub("_", seen).strip(" .~")[:100].rstrip(" .")
    return f"_{kept}" if _RESERVED.fullmatch(kept) else kept or otherwise


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


def opened(folder: Path, path: str) -> BufferedReader:
    """The file of this name below the folder, open for reading; no part of either is a link (see `no_links`).

    Raises InputError: the name leads elsewhere, there is no such file, or it is a link or no regular file.
    """
    file = folder / checked(path)
    with files.as_input_error(path):
        stream = os.fdopen(_descriptor(file, path), "rb")
    if not stat.S_ISREG(os.fstat(stream.fileno()).st_mode):
        stream.close()
        raise InputError(_shown(path), "is no file", "name a file")
    return stream


def _descriptor(file: Path, path: str) -> int:
    try:
        handle = no_links.descriptor(file)
    except InputError as error:
        raise InputError(
            _shown(path), error.problem, error.mend, error.lack
        ) from None  # without folders of the server
    if stat.S_ISDIR(os.fstat(handle).st_mode):
        os.close(handle)
        raise InputError(_shown(path), "is a folder", "name a file")
    return handle


def _shown(path: str) -> str:
    return repr(path if len(path) < 100 else path[:100] + "...")
