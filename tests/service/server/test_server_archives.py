"""Damaged archives, and those that would take memory: refused as such, none of it a mistake of ours."""

import bz2
import gzip
import io
import lzma
import random
import tarfile
import tracemalloc
import zipfile

import pytest

from lvba.errors import InputError
from service.datasets import archives
from service.datasets.intake_budget import IntakeBudget
from service.settings import Limits


def packed_zip(method):
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        archive.writestr("a.txt", b"some text " * 500)
    return bytearray(stream.getvalue())


def damaged_bz2():
    """Its data are no bz2 data."""
    content = packed_zip(zipfile.ZIP_BZIP2)
    content[content.find(b"BZh") + 4] ^= 1
    return content


def elsewhere():
    """The directory says that the file begins before the archive does."""
    content = packed_zip(zipfile.ZIP_STORED)
    end = content.find(b"PK\5\6")
    content[end + 16 : end + 20] = (0x7FFFFFFF).to_bytes(4, "little")
    return content


def beyond_numbers():
    """A tar whose file has more bytes than any number of the system."""
    entry = tarfile.TarInfo("a")
    header = bytearray(entry.tobuf(tarfile.GNU_FORMAT))
    header[124:136] = b"\x80" + b"\x7f" * 11
    header[148:156] = b" " * 8
    header[148:156] = b"%06o\0 " % sum(header[:512])
    return bytes(header) + bytes(10240)


CONTENT = random.Random(0).randbytes(3_000_000)
DAMAGED = {
    "zip, data that are none": damaged_bz2,
    "zip, directory elsewhere": elsewhere,
    "zip, a method that takes the memory that it asks for": lambda: packed_zip(zipfile.ZIP_LZMA),
    "tar, a size beyond all numbers": beyond_numbers,
    "tar.gz, cut": lambda: gzip.compress(beyond_numbers())[:40],
    "tar.bz2, cut": lambda: bz2.compress(bytes(range(256)) * 99)[:40],
    "tar.xz, cut": lambda: lzma.compress(beyond_numbers())[:40],
}


@pytest.mark.parametrize("kind", DAMAGED)
def test_damaged_archive_is_refused(kind, tmp_path):
    (tmp_path / "archive").write_bytes(DAMAGED[kind]())
    with pytest.raises(InputError, match="pack the files of the recording anew"):
        archives.unpack(tmp_path / "archive", tmp_path / "out", IntakeBudget(tmp_path, Limits()))


@pytest.mark.parametrize("kind", [tarfile.GNUTYPE_LONGNAME, tarfile.XHDTYPE])
def test_name_as_long_as_a_disk_is_not_read(kind, tmp_path):
    entry = tarfile.TarInfo("x")
    entry.type, entry.size = kind, 64 << 20
    (tmp_path / "archive").write_bytes(gzip.compress(entry.tobuf(tarfile.GNU_FORMAT) + bytes(64 << 20), 1))
    tracemalloc.start()
    try:
        with pytest.raises(InputError):
            archives.unpack(tmp_path / "archive", tmp_path / "out", IntakeBudget(tmp_path, Limits()))
        assert tracemalloc.get_traced_memory()[1] < 8 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("pack", [bytes, gzip.compress, bz2.compress, lzma.compress])
def test_every_usual_compression_of_a_tar_is_unpacked(pack, tmp_path):
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w") as archive:
        entry = tarfile.TarInfo("a/b.txt")
        entry.size = 3_000_000
        archive.addfile(entry, io.BytesIO(CONTENT))
    (tmp_path / "archive").write_bytes(pack(stream.getvalue()))
    archives.unpack(tmp_path / "archive", tmp_path / "out", IntakeBudget(tmp_path, Limits()))
    assert (tmp_path / "out" / "a" / "b.txt").read_bytes() == CONTENT
