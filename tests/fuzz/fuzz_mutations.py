"""Files made worse: bits, cuts, doubled lines, numbers blown up, pieces of other files; checksums made right again."""

import bz2
import gzip
import lzma
import random
import re
import struct
import zlib

Files = dict[str, bytes]
"""Path below the case's folder, to content."""

NUMBERS = b"""
0 -0 1 -1 7 255 256 65535 65536 2147483647 2147483648 4294967295 4294967296 9223372036854775807 18446744073709551615
99999999999999999999 nan -nan inf -inf 1e308 -1e308 1e309 1e-320 1e5 1e8 1e16 0x10 1_0 1e 1.5.2 .
""".split()
_WORDS = [struct.pack(f"{order}{kind}", value) for order in "<>" for kind, values in (
    ("H", (0, 1, 0x7FFF, 0x8000, 0xFFFF)), ("I", (0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0x10000000)),
    ("Q", (0, 1, 1 << 62, (1 << 64) - 1)), ("f", (float("nan"), float("inf"), 1e38, -1e38)), ("d", (1e308, float("nan"))),
) for value in values]  # fmt: skip
_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
_MAX_BYTES = 100_000


def mutate(rng: random.Random, files: Files, others: list[Files], tokens: list[bytes]) -> Files:
    """The files with a few changes to one or two of them; what is longer than 100 kB is cut.

    others: seeds to take pieces from; tokens: words that mean something in such files
    """
    result = dict(files)
    for _ in range(rng.choice((1, 1, 1, 2))):
        name = rng.choice(sorted(result))
        content = bytearray(result[name])
        for _ in range(rng.choice((1, 1, 1, 2, 3, 6))):
            rng.choice(_CHANGES)(rng, content, others, tokens)
        result[name] = bytes(content[:_MAX_BYTES])
    return result


def _place(rng: random.Random, content: bytearray) -> int:
    near_start = rng.random() < 0.3  # where headers are
    return rng.randrange(min(len(content), 300) if near_start else len(content)) if content else 0


def _flip(rng: random.Random, content: bytearray, others: list[Files], tokens: list[bytes]) -> None:
    for _ in range(rng.choice((1, 1, 4))):
        if content:
            content[_place(rng, content)] ^= 1 << rng.randrange(8)


def _set_byte(rng: random.Random, content: bytearray, others: list[Files], tokens: list[bytes]) -> None:
    if content:
        content[_place(rng, content)] = rng.choice((0, 10, 32, 127, 128, 255, rng.randrange(256)))


def _set_word(rng: random.Random, content: bytearray, others: list[Files], tokens: list[bytes]) -> None:
    word, at = rng.choice(_WORDS), _place(rng, content)
    content[at : at + len(word)] = word


def _set_number(rng: random.Random, content: bytearray, others: list[Files], tokens: list[bytes]) -> None:
    found = list(_NUMBER.finditer(content[:20_000]))
    if found:
        start, stop = rng.choice(found).span()
        content[start:stop] = rng.choice(NUMBERS)


def _cut(rng: random.Random, content: bytearray, others: list[Files], tokens: list[bytes]) -> None:
    at = _place(rng, content)
    del content[at : at + rng.choice((1, 2, 4, 16, 100, 1000, 100_000))]


def _double(rng: random.Random, content: bytearray, others: list[Files], tokens: list[bytes]) -> None:
    at = _place(rng, content)
    piece = content[at : at + rng.choice((1, 4, 30, 300))]
    content[at:at] = piece * min(
        rng.choice((1,) * 10 + (3, 3, 100, 5000)), 1 + _MAX_BYTES // max(1, len(piece))
    )


def _double_line(rng: random.Random, content: bytearray, others: list[Files], tokens: list[bytes]) -> None:
    lines = bytes(content).split(b"\n")
    line = rng.choice(lines)
    at = rng.randrange(len(lines) + 1)
    lines[at:at] = [line] * min(rng.choice((1,) * 10 + (2, 2, 1000)), 1 + _MAX_BYTES // max(1, len(line)))
    content[:] = b"\n".join(lines)


def _drop_line(rng: random.Random, content: bytearray, others: list[Files], tokens: list[bytes]) -> None:
    lines = bytes(content).split(b"\n")
    del lines[rng.randrange(len(lines))]
    content[:] = b"\n".join(lines)


def _splice(rng: random.Random, content: bytearray, others: list[Files], tokens: list[bytes]) -> None:
    other = rng.choice(list(rng.choice(others).values()))
    start = rng.randrange(len(other)) if other else 0
    at = _place(rng, content)
    content[at : at + rng.choice((0, 10, 100, 100_000))] = other[
        start : start + rng.choice((10, 100, 100_000))
    ]


def _token(rng: random.Random, content: bytearray, others: list[Files], tokens: list[bytes]) -> None:
    at = _place(rng, content)
    if tokens:
        content[at : at + rng.choice((0, 0, 1, 5))] = rng.choice(tokens) * rng.choice(
            (1,) * 20 + (2, 3, 2000)
        )


_CHANGES = (
    *(_flip, _flip, _set_byte, _set_byte, _set_word, _set_number, _set_number, _set_number),
    *(_cut, _double, _double_line, _drop_line, _splice, _token, _token),
)


def right_png(content: bytes) -> bytes:
    """The PNG with the checksum of each whole part made right, so that damage gets as far as the decoder."""
    result, position = bytearray(content), 8
    while position + 12 <= len(content):
        end = position + 12 + int.from_bytes(content[position : position + 4], "big")
        if end > len(content):
            break
        result[end - 4 : end] = zlib.crc32(content[position + 4 : end - 4]).to_bytes(4, "big")
        position = end
    return bytes(result)


def right_tar(content: bytes) -> bytes:
    """The tar with the checksum of each block made right that looks like a header."""
    result = bytearray(content)
    for start in range(0, len(content) - 511, 512):
        if content[start + 257 : start + 262] == b"ustar":
            result[start + 148 : start + 156] = b" " * 8
            result[start + 148 : start + 156] = b"%06o\0 " % sum(result[start : start + 512])
    return bytes(result)


def right_zip(content: bytes) -> bytes:
    """The zip with the sum over each entry's stored data made right in its local header."""
    result, position = bytearray(content), 0
    while (position := result.find(b"PK\3\4", position)) >= 0 and position + 30 <= len(result):
        method, length, name, extra = (int.from_bytes(result[position + at : position + at + size], "little")
                                       for at, size in ((8, 2), (18, 4), (26, 2), (28, 2)))  # fmt: skip
        start = position + 30 + name + extra
        if method == 0:
            checksum = zlib.crc32(result[start : start + length]).to_bytes(4, "little")
            for place in (position + 14, _central(result, position)):
                if place >= 0:
                    result[place : place + 4] = checksum
        position += 4
    return bytes(result)


def _central(content: bytearray, local: int) -> int:
    """Where the central directory holds the checksum of the entry at this place, or -1."""
    at = content.find(b"PK\1\2")
    while at >= 0 and at + 46 <= len(content):
        if int.from_bytes(content[at + 42 : at + 46], "little") == local:
            return at + 16
        at = content.find(b"PK\1\2", at + 4)
    return -1


def packed(rng: random.Random, content: bytes) -> bytes:
    """The bytes as they are, or compressed."""
    return rng.choice((bytes, gzip.compress, bz2.compress, lzma.compress))(content)
