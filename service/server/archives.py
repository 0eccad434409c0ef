"""Unpacking archives of strangers: only plain files, only below the folder, only as much as is allowed."""

import stat
import tarfile
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from lzma import LZMAError
from pathlib import Path
from typing import IO

from lvba.errors import InputError
from service.server import names
from service.server.settings import Limits

_PIECE = 1 << 20
_NOISE = ("__MACOSX",)
_BROKEN = (
    zipfile.BadZipFile,
    tarfile.TarError,
    zlib.error,
    LZMAError,
    EOFError,
    ValueError,
    NotImplementedError,
)
_PACK_AGAIN = "pack the files of the recording anew, as .zip or .tar.gz"
_SMALL = 1 << 20
"""Bytes that anything may inflate to: what is small harms nobody, and text packs well."""


@dataclass
class _Tally:
    """What has come out of an archive so far."""

    limits: Limits
    packed: int
    files: int = 0
    bytes: int = 0
    places: set[str] = field(default_factory=set)

    def add_file(self, name: str) -> None:
        self.files += 1
        if self.files > self.limits.archive_entries:
            raise InputError(
                "the archive", f"holds more than {self.limits.archive_entries} files", "split it"
            )
        place = names.same_place(name)
        if place in self.places:
            raise InputError(
                repr(name), "is in the archive twice, or differs in letter case only", _PACK_AGAIN
            )
        self.places.add(place)

    def add_bytes(self, count: int) -> None:
        self.bytes += count
        if self.bytes > self.limits.archive_bytes:
            raise InputError(
                "the archive", f"holds more than {self.limits.archive_bytes} bytes", "split it into datasets"
            )
        if self.bytes > _SMALL + self.limits.archive_ratio * self.packed:
            raise InputError(
                "the archive",
                f"is more than {self.limits.archive_ratio:g} times smaller than what it holds",
                "it looks like a bomb: upload the files themselves",
            )


def unpack(archive: Path, folder: Path, limits: Limits) -> None:
    """Put every file of a zip or tar archive, told apart by content, below the folder.

    Raises InputError: a name that leads elsewhere, a link or device, more than is allowed, a broken archive.
    """
    tally = _Tally(limits, archive.stat().st_size)
    try:
        if zipfile.is_zipfile(archive):
            _unpack_zip(archive, folder, tally)
        else:
            _unpack_tar(archive, folder, tally)
    except _BROKEN as error:
        raise InputError("the archive", f"cannot be read ({type(error).__name__})", _PACK_AGAIN) from None
    except RecursionError:
        raise InputError("the archive", "cannot be read", _PACK_AGAIN) from None


def _unpack_zip(archive: Path, folder: Path, tally: _Tally) -> None:
    with zipfile.ZipFile(archive) as packed:
        for entry in packed.infolist():
            # the name as it is written there: ZipInfo cuts it at a NUL, which would hide what it is
            if "\x00" in entry.orig_filename:
                raise InputError(repr(entry.orig_filename), "is no plain relative path", _PACK_AGAIN)
            kind = stat.S_IFMT(entry.external_attr >> 16)
            if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
                raise InputError(repr(entry.orig_filename), "is a link or a device", _PACK_AGAIN)
            if entry.flag_bits & 1:
                raise InputError(repr(entry.orig_filename), "is encrypted", "pack it without a password")
            name = _name(entry.orig_filename)
            if name is None or entry.is_dir():
                continue
            tally.add_file(name)
            with packed.open(entry) as stream:
                _copy(stream, folder, name, tally)


def _unpack_tar(archive: Path, folder: Path, tally: _Tally) -> None:
    with tarfile.open(archive, mode="r:*", errorlevel=2) as packed:
        for entry in packed:
            if not (entry.isreg() or entry.isdir()):
                raise InputError(repr(entry.name), "is a link or a device", _PACK_AGAIN)
            name = _name(entry.name)
            if name is None or entry.isdir():
                continue
            tally.add_file(name)
            stream = packed.extractfile(entry)
            if stream is not None:
                with stream:
                    _copy(stream, folder, name, tally)
            packed.members = []  # type: ignore[attr-defined]  # it would keep them all in memory


def _name(written: str) -> str | None:
    """The checked path of an entry; None: nobody's file, such as what some systems add."""
    path = written.removeprefix("./").removesuffix("/")
    if path in ("", "."):
        return None
    names.checked(path)
    parts = path.split("/")
    if parts[0] in _NOISE or parts[-1] == ".DS_Store" or parts[-1].startswith("._"):
        return None
    return path


def _copy(stream: IO[bytes], folder: Path, name: str, tally: _Tally) -> None:
    target = folder / name
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with target.open("xb") as file:
            for piece in _pieces(stream):
                tally.add_bytes(len(piece))
                file.write(piece)
    except (FileExistsError, NotADirectoryError, IsADirectoryError):
        raise InputError(repr(name), "is there as a file and as a folder, or twice", _PACK_AGAIN) from None


def _pieces(stream: IO[bytes]) -> Iterator[bytes]:
    while piece := stream.read(_PIECE):
        yield piece
