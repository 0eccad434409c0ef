"""Every error that lvba raises on purpose.

LvbaError
├── InputError               something the user gave is missing, malformed or contradictory
├── DegenerateProblemError   the input is well formed, but holds too little to solve for anything
└── ArtifactError            an intermediate result is missing, truncated or altered
"""

from enum import StrEnum
from typing import Any


class LvbaError(Exception):
    """Base of all errors raised on purpose; str(error) is one line for the user."""


_LONGEST = 600


def _shortened(text: object) -> str:
    """Its start and end: what is quoted of a file of strangers may be as long as the file."""
    text = str(text)
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST // 2]} ... {text[-_LONGEST // 2 :]}"


class Lack(StrEnum):
    """What the machine lacks, where the input is not to blame."""

    DISK = "disk"
    MEMORY = "memory"


class InputError(LvbaError):
    """Bad input. The message names the file (and line), says what is wrong, and how to mend it.

    lack: what the machine lacked while it worked on this file; None: the file itself is wrong
    """

    def __init__(self, where: object, problem: str, mend: str, lack: Lack | None = None) -> None:
        self.lack = lack
        self.where, self.problem, self.mend = map(_shortened, (where, problem, mend))
        line = " ".join(f"{self.where}: {self.problem}; {self.mend}".splitlines())
        super().__init__(
            line.encode("utf-8", "backslashreplace").decode()
        )  # names of files may hold any bytes

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.where, self.problem, self.mend, self.lack)


class DegenerateProblemError(LvbaError):
    """Too few planes, scene points or frames to determine the unknowns."""


class ArtifactError(LvbaError):
    """An intermediate result cannot be used as it is."""
