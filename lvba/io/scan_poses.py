"""What a file of scan poses says of itself in its first line: of what it is, and whether the scans were deskewed by it.

The line goes with the poses: poses of another origin, put in their place, do not have it.
"""

import re
from collections.abc import Iterable

from lvba.dataset import DESKEWED_BY

_OF_BODY = "body (the scans' frame) to world at the time of each scan: t tx ty tz qx qy qz qw"
_STATED = re.compile(r"\bscans deskewed by these poses: ([a-z, ]+)")


def comment(deskewed_by: Iterable[str]) -> str:
    """The first line of a file of scan poses, without '#'. deskewed_by: of `DESKEWED_BY`"""
    parts = ", ".join(deskewed_by)
    return _OF_BODY + (f"; scans deskewed by these poses: {parts}" if parts else "")


def deskewed_by(comments: Iterable[str]) -> tuple[str, ...]:
    """With what of a file's poses scans were deskewed, of `DESKEWED_BY`, as its comments say; (): they do not."""
    stated = next((match[1] for line in comments if (match := _STATED.search(line))), "")
    said = {part.strip() for part in stated.split(",")}
    return tuple(part for part in DESKEWED_BY if part in said)
