"""The scan or image files of a recording: found by name, checked cheaply, and fingerprinted."""

import hashlib
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from lvba.errors import InputError
from lvba.io import files, timestamps

THREADS = 4
"""Files read at a time: enough to keep a disk busy, few enough for memory."""
HASHED_BYTES = 2 * 1024**3
"""Recordings up to this size are fingerprinted by content, longer ones by the size and change time of each file."""
_NAMED = 3
Facts = TypeVar("Facts")


@dataclass(frozen=True)
class Frame:
    """A file and the time in its name, s; stamp: with all its digits, "" if it was not in the name."""

    path: Path
    time: float
    stamp: str = ""


@dataclass(frozen=True)
class Checked(Generic[Facts]):
    """What a check found in a frame's file, and its fingerprint; or the error it met."""

    facts: Facts | None
    fingerprint: str
    error: InputError | None


def find(folder: Path, suffixes: tuple[str, ...], kind: str) -> tuple[list[Frame], list[str]]:
    """Files with one of the suffixes in time order, and a sentence about those left out.

    Raises: InputError if the folder cannot be read or holds none.
    """
    names = [
        name
        for name in files.names_in(folder)
        if name.lower().endswith(suffixes) and not name.startswith(".")
    ]
    if not names:
        mend = f"put the {kind} files there, named by their times"
        mend += ", or remove the folder to use scans alone" if kind == "image" else ""
        raise InputError(folder, f"holds no {kind}s ({', '.join(suffixes)})", mend)
    frames, nameless, repeated = [], [], []
    seen: set[float] = set()
    for name in names:
        stamp = timestamps.stamp(name) if name.isprintable() else None
        if stamp is None:
            nameless.append(name)
        elif float(stamp) in seen:
            repeated.append(name)
        else:
            seen.add(float(stamp))
            frames.append(Frame(folder / name, float(stamp), stamp))
    if not frames:
        raise InputError(folder, f"no {kind} file name carries a time", f"name them <seconds>{suffixes[0]}")
    warnings = left_out(nameless, f"{kind} files without a time in the name", folder)
    warnings += left_out(repeated, f"{kind} files with the time of another", folder)
    return sorted(frames, key=lambda frame: frame.time), warnings


def left_out(names: Sequence[str], what: str, where: object) -> list[str]:
    """No sentence, or one about what was left out, with the first few names."""
    if not names:
        return []
    shown = ", ".join(ascii(name)[1:-1] for name in names[:_NAMED]) + (", ..." if len(names) > _NAMED else "")
    return [f"{where}: left out {len(names)} {what}: {shown}."]


def total_bytes(frames: Sequence[Frame]) -> int:
    """The size of all files that there are."""
    total = 0
    for frame in frames:
        try:
            total += os.stat(frame.path).st_size
        except OSError:
            continue  # the check of this frame will tell
    return total


def check_all(
    frames: Sequence[Frame], check: Callable[[Path, bytes | None], Facts], hashed: bool
) -> list[Checked[Facts]]:
    """Each frame's check, in order.

    check: takes the path and the content, or None where it is not read; returns facts or raises InputError
    hashed: read and hash the contents
    """
    with ThreadPoolExecutor(THREADS) as pool:
        return list(pool.map(lambda frame: _check(frame.path, check, hashed), frames))


def split_bad(
    frames: Sequence[Frame], checks: Sequence[Checked[Facts]], kind: str
) -> tuple[list[int], list[str]]:
    """Indices of good frames, and a sentence about each bad one.

    Raises: the first InputError if more than half of the frames are bad.
    """
    bad = [(index, check.error) for index, check in enumerate(checks) if check.error is not None]
    if 2 * len(bad) > len(frames):
        first = bad[0][1]
        others = f" (and {len(bad) - 1} more of {len(frames)} {kind}s are bad)" if len(bad) > 1 else ""
        raise InputError(first.where, first.problem + others, first.mend, first.lack)
    unusable = {index for index, _ in bad}
    good = [index for index in range(len(frames)) if index not in unusable]
    messages = [f"{error.where}: left out this {kind}: {error.problem}." for _, error in bad[:_NAMED]]
    if len(bad) > _NAMED:
        messages.append(f"{frames[0].path.parent}: left out {len(bad) - _NAMED} more {kind}s that are bad.")
    return good, messages


def _check(path: Path, check: Callable[[Path, bytes | None], Facts], hashed: bool) -> Checked[Facts]:
    try:
        content = files.read_bytes(path) if hashed else None
        facts = check(path, content)
        return Checked(facts, _fingerprint(path, content), None)
    except InputError as error:
        return Checked(None, "", error)


def _fingerprint(path: Path, content: bytes | None) -> str:
    if content is not None:
        return f"{len(content)} {hashlib.sha256(content).hexdigest()}"
    with files.as_input_error(path):
        status = os.stat(path)
    return f"{status.st_size} {status.st_mtime_ns}"
