"""The process that looks into a bag of which pieces have been sent, such as its begin and its end: what strangers sent is
decoded here, under limits, and not in the service.

    python -m service.datasets.inspection_process FOLDER NAME BODY LARGEST

BODY: a file; its first line is JSON, {"files": [{"path", "size", "pieces": [[begin, end], ...]}]}, in bytes; then the
pieces themselves. LARGEST: bytes of a file.
Prints {"inspection": null | {...}, "needs": [{"path", "begin", "end"}], "later": text, "error": null | {...}}: pieces
without which nothing can be said; why nothing can be said before all is there; what is wrong, as of a dataset.
"""

import json
import resource
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from lvba.errors import InputError
from lvba.io import partial_files
from lvba.io.partial_files import PartialFile
from service.datasets import file_names, inspection_facts, recording_names, source_check
from service.system import process_limits
from service.system.threads import limit_threads

SECONDS = 60
_MEMORY = 4 << 30
_AHEAD = 4 << 20
"""Bytes that are asked for where one was not there."""
_MOST_FILES = 100_000
_MOST_HEAD = 16 << 20
_LATER = "what is in it is known when all of it has arrived"


def main(folder: str, name: str, body: str, largest: int) -> int:
    """0: the answer is printed."""
    process_limits.limit(_MEMORY, SECONDS)
    limit_threads(1)
    root = Path(folder) / name
    root.mkdir()
    answer: dict[str, Any] = {"inspection": None, "needs": [], "later": "", "error": None}
    sent: list[_Sent] = []
    try:
        with open(body, "rb") as stream:
            sent = _lay_out(root, stream, largest)
        # holes take no room; what is unpacked from what was sent does
        resource.setrlimit(resource.RLIMIT_FSIZE, (_MEMORY, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
        answer |= _look(recording_names.without_wrapping(root), sent)
    except InputError as error:
        if not (needs := _needs(sent)):
            cause = f"{error.where}: {error.problem}".replace(str(root), "DATASET")
            answer["error"] = {
                "code": "input",
                "cause": cause,
                "hint": error.mend.replace(str(root), "DATASET"),
            }
        answer["needs"] = needs
    json.dump(answer, sys.stdout)
    return 0


@dataclass(frozen=True)
class _Sent:
    """A file; partial: None where all of it is here."""

    name: str
    path: Path
    size: int
    partial: PartialFile | None


def _look(root: Path, sent: list[_Sent]) -> dict[str, Any]:
    from lvba.sources.bags.bag_files import needs_all
    from lvba.sources.bags.bag_source import said_by_metadata
    from lvba.sources.inspection import by_names

    if any(each.partial and needs_all(each.path, each.path.open("rb").read(16)) for each in sent):
        recording_names.check(root)
        said = said_by_metadata(root)
        if said is None:
            return {"later": _LATER}
        facts = inspection_facts.facts(by_names(said))
        notes = [*facts["notes"], f"by metadata.yaml alone: {_LATER}"]
        return {"inspection": {**facts, "notes": notes, "file": "", "beside": source_check.beside(root, "")}}
    opened = source_check.source_at(root)
    if opened is None:
        recording_names.check(root)
        return {"later": _LATER}
    facts = source_check.look(opened[0], root, opened[1])["inspection"]
    needs = _needs(sent)
    return {"needs": needs} if needs else {"inspection": facts}


def _needs(sent: list[_Sent]) -> list[dict[str, Any]]:
    """Pieces that were read and are not here, a few megabytes each."""
    needs: list[dict[str, Any]] = []
    for each in sent:
        until = 0
        for place in sorted(each.partial.absent if each.partial else ()):
            if place >= until:
                until = min(place + _AHEAD, each.size)
                needs.append({"path": each.name, "begin": place, "end": until})
    return needs


def _lay_out(root: Path, body: IO[bytes], largest: int) -> list[_Sent]:
    """Raises InputError: the list of files is invalid, or names what cannot be."""
    taken: set[str] = set()
    sent = []
    for name, size, pieces in _files(body, largest):
        path = root / file_names.take(name, taken)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("wb") as file:
                for begin, end in pieces:
                    file.seek(begin)
                    file.write(body.read(end - begin))
                file.truncate(size)
        except (FileExistsError, NotADirectoryError, IsADirectoryError):
            raise InputError(repr(name), "is there as a file and as a folder", "rename one") from None
        partial = partial_files.declare(path, pieces)
        sent.append(_Sent(name, path, size, partial if partial.end_of(0) < size else None))
    return sent


def _files(body: IO[bytes], largest: int) -> list[tuple[str, int, list[tuple[int, int]]]]:
    wrong = InputError(
        "the list of files", "is invalid", 'send {"files": [{"path", "size", "pieces"}]}, then the bytes'
    )
    try:
        listed = json.loads(body.readline(_MOST_HEAD))["files"]
        files = [
            (str(each["path"]), int(each["size"]), [(int(begin), int(end)) for begin, end in each["pieces"]])
            for each in listed
        ]
    except (ValueError, KeyError, TypeError, RecursionError):
        raise wrong from None
    for _, size, pieces in files:
        if not 0 <= size <= largest or any(not 0 <= begin <= end <= size for begin, end in pieces):
            raise wrong
    if len(files) > _MOST_FILES:
        raise InputError("the recording", f"has more than {_MOST_FILES} files", "upload it as it is")
    return files


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], sys.argv[2], sys.argv[3], int(sys.argv[4])))
