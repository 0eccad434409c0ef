"""Names of fields of points that have their times, in clouds of bags and in files."""

from collections.abc import Iterable

import numpy as np

_TIMES: tuple[tuple[str, ...], ...] = (
    *(("time",), ("t",), ("timestamp",), ("time_stamp",), ("offset_time",), ("time_offset",)),
    *(("timeoffset",), ("t_offset",), ("point_time",), ("point_timestamp",), ("stamp",), ("dt",)),
    *(("offset_time_ns",), ("timestampsec", "timestampnsec"), ("timestamp_sec", "timestamp_nsec")),
    *(("time_sec", "time_nsec"), ("t_sec", "t_nsec"), ("sec", "nsec"), ("seconds", "nanoseconds")),
    *(("time_offset_ns",), ("timestamp_ns",), ("point_time_offset",), ("relative_time",)),
)
"""In lower case, the first that is there counts; of two, one has whole seconds, the other the ns beyond them.

Only names that say so: some drivers hide times in `curvature` or `normal_x`, others put there what the name says.
"""


def times_of(names: Iterable[str]) -> tuple[str, ...]:
    """The fields among `names` that have the times of points, in their own spelling: none, one, or seconds and ns."""
    spelled: dict[str, str] = {}
    for name in names:
        spelled.setdefault(name.lower(), name)
    group = next((group for group in _TIMES if all(name in spelled for name in group)), ())
    return tuple(spelled[name] for name in group)


def joined(columns: list[np.ndarray]) -> np.ndarray | None:
    """(N,): times of points by columns (N,) of the fields of `times_of`, in the unit of one, ns of two; None: of none.

    Whole seconds and ns become int64, which holds times since 1970 to a ns.
    """
    if not columns:
        return None
    if len(columns) == 1:
        return columns[0]
    kind = np.int64 if all(column.dtype.kind in "iu" for column in columns) else np.float64
    seconds, nanoseconds = (column.astype(kind) for column in columns)
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(seconds * 10**9 + nanoseconds)
