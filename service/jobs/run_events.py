"""`--events FILE`: what a run does, for programs. One JSON object a line, added to the file as it happens.

    {"event": "stages", "names": [...]}                                  all stages in order, before the first; of a bag
                                                                         again when it is imported: then all are known
    {"event": "stage", "name", "index", "total", "reused": bool|null}    one begins
    {"event": "progress", "stage", "what", "done", "total"}              at most a few a second
    {"event": "record", "name", "seconds", "peak_memory_mb", "reused"}   how each went, at the end
    {"event": "end", "code", "reason", "message", "where", "problem", "mend"}    the last; what is not known is empty

Every line has `time`, seconds since 1970. `reason` is an `EndReason`; `message`, `problem` and `mend` are for people, and
programs do not look into them.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

IMPORT = "import"
"""Name of the stage that makes the recording of a bag; it comes first, and the stages after it are not known yet."""
VIEWER = "viewer"
"""Name of the stage that comes last where it is asked for: the result is whole before it."""


class EndReason(StrEnum):
    """Why a run ended."""

    DONE = "done"
    STOPPED = "stopped"
    """Ctrl-C or SIGTERM; finished stages are kept."""
    INPUT = "input"
    """What the user gave is wrong, and the message says how to mend it."""
    DISK_FULL = "disk-full"
    OUT_OF_MEMORY = "out-of-memory"
    FAILED = "failed"
    """An error that lvba raises on purpose, such as too little to solve for anything."""
    UNEXPECTED = "unexpected"
    """An error that nobody foresaw."""


_BY_CODE = {0: EndReason.DONE, 2: EndReason.INPUT, 130: EndReason.STOPPED}
"""For lines of versions that gave no reason: the exit code says less, but no sentence is parsed."""


@dataclass(frozen=True)
class RunEnd:
    """The last line of a run."""

    code: int
    reason: EndReason
    message: str
    where: str = ""
    problem: str = ""
    mend: str = ""


def run_end(line: Mapping[str, Any]) -> RunEnd:
    """The line of the event `end`, of this version, an earlier or a later one."""
    code, given = int(line["code"]), line.get("reason")
    reason = EndReason(given) if given in set(EndReason) else _BY_CODE.get(code, EndReason.FAILED)
    texts = {name: str(line.get(name) or "") for name in ("message", "where", "problem", "mend")}
    return RunEnd(code, reason, **texts)
