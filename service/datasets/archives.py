"""Unpacking archives of strangers: only plain files, only below the folder, only as much as is allowed."""

import bz2
import errno
import gzip
import io
import lzma
import stat
import tarfile
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from lvba.errors import InputError
from service.datasets import file_names
from service.datasets.intake_budget import IntakeBudget

_PIECE = 1 << 20
_NOISE = ("__MACOSX",)
_BROKEN = (
    zipfile.BadZipFile,
    tarfile.TarError,
    zlib.error,
    lzma.LZMAError,
    OverflowError,
    EOFError,
    ValueError,
    NotImplementedError,
)
_PACK_AGAIN = "pack the files of the recording anew, as .zip or .tar.gz"
_COMPRESSIONS: dict[bytes, Any] = {b"\x1f\x8b": gzip, b"BZh": bz2, b"\xfd7zXZ\0": lzma}
_ZIP_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2)


def unpack(archive: Path, folder: Path, budget: IntakeBudget) -> None:
    """Put every file of a zip or tar archive, told apart by content, below the folder.

    budget: counts what comes out
    Raises InputError: a name that leads elsewhere, a link or device, more than is allowed, a broken archive.
    TooLargeError: more than its owner may have. OSError: no room on the disk.
    """
    budget.begin_archive(archive.stat().st_size)
    try:
        if zipfile.is_zipfile(archive):
            _unpack_zip(archive, folder, budget)
        else:
            _unpack_tar(archive, folder, budget)
    except _BROKEN as error:
        raise InputError("the archive", f"cannot be read ({type(error).__name__})", _PACK_AGAIN) from None
    except RecursionError:
        raise InputError("the archive", "cannot be read", _PACK_AGAIN) from None
    except OSError as error:
        # bz2 says so of damaged data, seek of a place that is none; a full disk has another number
        if error.errno not in (None, errno.EINVAL):
            raise
        raise InputError("the archive", "is damaged", _PACK_AGAIN) from None


def _unpack_zip(archive: Path, folder: Path, budget: IntakeBudget) -> None:
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
            if entry.compress_type not in _ZIP_METHODS:  # LZMA takes as much memory as its header asks for
                raise InputError(repr(entry.orig_filename), "is packed by a rare method", _PACK_AGAIN)
            name = _name(entry.orig_filename)
            if name is None or entry.is_dir():
                continue
            budget.add_file(name, _PACK_AGAIN)
            with packed.open(entry) as stream:
                _copy(stream, folder, name, budget)


def _unpack_tar(archive: Path, folder: Path, budget: IntakeBudget) -> None:
    with (
        _decompressed(archive) as stream,
        tarfile.TarFile(fileobj=_ShortReads(stream), errorlevel=2) as packed,
    ):
        for entry in packed:
            if not (entry.isreg() or entry.isdir()):
                raise InputError(repr(entry.name), "is a link or a device", _PACK_AGAIN)
            name = _name(entry.name)
            if name is None or entry.isdir():
                continue
            budget.add_file(name, _PACK_AGAIN)
            content = packed.extractfile(entry)
            if content is not None:
                with content:
                    _copy(content, folder, name, budget)
            packed.members = []  # type: ignore[attr-defined]  # it would keep them all in memory


class _ShortReads(io.BufferedReader):
    """A stream that no more than a piece is read from at a time: entries may announce names as long as a disk."""

    def read(self, size: int | None = -1, /) -> bytes:
        if size is None or not 0 <= size <= _PIECE:
            raise tarfile.ReadError("something that is read at once is too long")
        return super().read(size)


def _decompressed(archive: Path) -> Any:
    with archive.open("rb") as file:
        start = file.read(6)
    for magic, module in _COMPRESSIONS.items():
        if start.startswith(magic):
            return module.open(archive, "rb")
    return archive.open("rb")


def _name(written: str) -> str | None:
    """The checked path of an entry; None: nobody's file, such as what some systems add."""
    path = written.removeprefix("./").removesuffix("/")
    if path in ("", "."):
        return None
    file_names.checked(path)
    parts = path.split("/")
    if parts[0] in _NOISE or parts[-1] == ".DS_Store" or parts[-1].startswith("._"):
        return None
    return path


def _copy(stream: IO[bytes], folder: Path, name: str, budget: IntakeBudget) -> None:
    target = folder / name
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with target.open("xb") as file:
            for piece in _pieces(stream):
                budget.add_bytes(len(piece))
                file.write(piece)
    except (FileExistsError, NotADirectoryError, IsADirectoryError):
        raise InputError(repr(name), "is there as a file and as a folder, or twice", _PACK_AGAIN) from None


def _pieces(stream: IO[bytes]) -> Iterator[bytes]:
    while piece := stream.read(_PIECE):
        yield piece
