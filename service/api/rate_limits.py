"""How often somebody may ask: a bucket that fills steadily, and is emptied by one a request."""

import math
import threading
import time

from service.problems import Problem

_MANY = 10_000


class Rates:
    """Buckets by name, for this service alone."""

    def __init__(self) -> None:
        self._buckets: dict[str, tuple[float, float]] = {}
        self._lock = threading.Lock()

    def take(self, name: str, per_s: float, at_once: float) -> None:
        """One request more.

        Raises Problem: too many.
        """
        now = time.monotonic()
        with self._lock:
            level, since = self._buckets.get(name, (at_once, now))
            level = min(at_once, level + (now - since) * per_s)
            if level >= 1:
                self._buckets[name] = (level - 1, now)
            if len(self._buckets) > _MANY:
                self._forget(now)
        if level < 1:
            wait = math.ceil((1 - level) / per_s)
            raise Problem(
                "too-many-requests", "too many requests in a short time", headers={"Retry-After": str(wait)}
            )

    def _forget(self, now: float) -> None:
        self._buckets = {name: bucket for name, bucket in self._buckets.items() if now - bucket[1] < 60.0}
