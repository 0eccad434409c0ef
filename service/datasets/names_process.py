"""The process that looks at the names and small texts of a recording before it is uploaded: what strangers sent is read
here, under limits, and not in the service. Names become empty files in a folder that the service removes.

    python -m service.datasets.names_process FOLDER NAME MOST_FILES < LINES

LINES: a JSON object each, {"path", "text"?}. Prints {"error": null | {"code", "cause", "hint", "path"}}.
"""

import json
import re
import sys
from collections.abc import Iterable
from pathlib import Path

from lvba.errors import InputError
from service.datasets import file_names, recording_names
from service.system import process_limits
from service.system.threads import limit_threads

SECONDS = 60
_MEMORY = 4 << 30


def main(folder: str, name: str, most: int) -> int:
    """0: the answer is printed."""
    process_limits.limit(_MEMORY, SECONDS)
    limit_threads(1)
    root = Path(folder) / name
    root.mkdir()
    error: dict[str, str | None] | None = None
    try:
        _lay_out(root, sys.stdin.buffer, most)
        recording_names.check(root)
    except InputError as caught:
        cause = f"{caught.where}: {caught.problem}"
        error = {"code": "input", "cause": _hidden(cause, root), "hint": _hidden(caught.mend, root)}
        error["path"] = _inside(_hidden(caught.where, root))
    json.dump({"error": error}, sys.stdout)
    return 0


def _lay_out(root: Path, lines: Iterable[bytes], most: int) -> None:
    taken: set[str] = set()
    for line in lines:
        try:
            entry = json.loads(line)
            path, text = str(entry["path"]), str(entry.get("text", ""))
        except (ValueError, KeyError, TypeError, AttributeError):
            raise InputError("the list of files", "has an invalid line", "send {path, text}") from None
        file = root / file_names.take(path, taken)
        if len(taken) > most:
            raise InputError("the recording", f"has more than {most} files", "split it into datasets")
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text, encoding="utf-8")
        except (FileExistsError, NotADirectoryError, IsADirectoryError):
            raise InputError(
                repr(path), "is there as a file and as a folder", "give one another name"
            ) from None


def _hidden(text: str, root: Path) -> str:
    return text.replace(str(root), "DATASET").replace(str(root.parent), "the folder above")


def _inside(where: str) -> str | None:
    if not where.startswith("DATASET/"):
        return None
    return re.sub(r"(:\d+)+$", "", where.removeprefix("DATASET/"))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], sys.argv[2], int(sys.argv[3])))
