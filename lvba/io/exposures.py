"""Relative exposures as CSV: timestamp,relative_exposure."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lvba.errors import InputError
from lvba.io import files
from lvba.io.tum import time_text

_HEADER = "timestamp,relative_exposure"


@dataclass(frozen=True)
class Exposures:
    """times: (I,) float64, s, strictly ascending; relative: (I,) float64, > 0"""

    times: np.ndarray
    relative: np.ndarray


def read_exposures(path: str | Path) -> Exposures:
    """The exposures of a CSV file, in time order.

    Raises: InputError with the line number.
    """
    rows: list[tuple[float, float]] = []
    for number, line in enumerate(files.read_text(path).split("\n"), 1):
        words = line.split("#", 1)[0].replace(",", " ").split()
        if words and not (not rows and words[0].lower().startswith(("t", "stamp"))):
            rows.append(_row(path, number, words))
    if not rows:
        raise InputError(path, "holds no exposures", f"write lines of {_HEADER}")
    table = np.array(sorted(rows))
    if np.any(np.diff(table[:, 0]) == 0):
        time = table[1:, 0][np.diff(table[:, 0]) == 0][0]
        raise InputError(path, f"two exposures for the time {time_text(time)}", "remove one of the lines")
    return Exposures(table[:, 0].copy(), table[:, 1].copy())


def write_exposures(
    path: str | Path, exposures: Exposures, *, durable: bool = False, stamps: Sequence[str] = ()
) -> None:
    """Writes a CSV file; times read back are the same floats.

    stamps: what to write for the times, none: their shortest text
    Raises: InputError if the file cannot be written.
    """
    times = stamps or [time_text(time) for time in exposures.times]
    rows = zip(times, exposures.relative, strict=True)
    lines = [f"{time},{relative:.9f}\n" for time, relative in rows]
    files.write_text(path, f"{_HEADER}\n{''.join(lines)}", durable=durable)


def _row(path: str | Path, number: int, words: list[str]) -> tuple[float, float]:
    try:
        time, relative = (float(word) for word in words)
    except ValueError as error:
        raise InputError(f"{path}:{number}", "not two numbers", f"write {_HEADER}") from error
    if not (np.isfinite(time) and np.isfinite(relative) and relative > 0):
        raise InputError(f"{path}:{number}", "not a time and an exposure above 0", f"write {_HEADER}")
    return time, relative
