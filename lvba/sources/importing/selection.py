"""Which scans and images of a source are wanted."""

from dataclasses import dataclass, replace

import numpy as np

from lvba.sources.importing import stamp_order
from lvba.sources.importing.options import ImportOptions

_ABSOLUTE_S = 1e8


@dataclass
class Selection:
    """Asked for each record of one kind in their order. zero: ns, of the first scan; every, rate as of the options.

    in_order: (N,) bool, of each record, whether its stamp is in order; None: all are
    unordered: how many were not wanted because theirs is not
    """

    zero: int
    start: float | None
    stop: float | None
    every: int
    rate: float
    in_order: np.ndarray | None = None
    unordered: int = 0
    _seen: int = 0
    _next: float = 0.0

    @classmethod
    def of(
        cls, options: ImportOptions, zero: int, every: int, in_order: np.ndarray | None = None
    ) -> "Selection":
        """By the options."""
        return cls(zero, options.start, options.stop, every, options.rate, in_order)

    def widened(self, seconds: float) -> "Selection":
        """One of the time that is wanted, and so much before and after it."""
        start, stop = (
            None if end is None else end + more
            for end, more in ((self.start, -seconds), (self.stop, seconds))
        )
        return replace(self, start=start, stop=stop)

    def inside(self, stamp: int) -> bool:
        """Whether a stamp (ns) is within the time that is wanted."""
        seconds, absolute = (stamp - self.zero) * 1e-9, stamp * 1e-9
        if self.start is not None and (absolute if self.start > _ABSOLUTE_S else seconds) < self.start:
            return False
        return self.stop is None or (absolute if self.stop > _ABSOLUTE_S else seconds) <= self.stop

    def wants(self, stamp: int) -> bool:
        """Whether the record with this stamp (ns) is wanted; stamps out of order are not."""
        number, self._seen = self._seen, self._seen + 1
        if self.in_order is not None and not stamp_order.is_in_order(self.in_order, number):
            self.unordered += 1
            return False
        if not self.inside(stamp) or number % self.every:
            return False
        if self.rate:
            seconds = (stamp - self.zero) * 1e-9
            # a hair early is in time: stamps of sensors jitter
            if seconds < self._next - 0.1 / self.rate:
                return False
            self._next = max(self._next + 1 / self.rate, seconds)
        return True
