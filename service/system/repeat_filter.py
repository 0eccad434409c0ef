"""A log that does not repeat itself: what happens again and again is told a few times a minute, with how often it was."""

import logging
import threading
import time

_MINUTE_S = 60.0
_MOST = 10
"""Records of one kind in a minute."""
_KINDS = 1000


class RepeatFilter(logging.Filter):
    """Lets pass what is no warning, and of each kind of warning the first few in a minute."""

    def __init__(self) -> None:
        super().__init__()
        self._kinds: dict[tuple[str, int, str, str], tuple[float, int]] = {}
        self._lock = threading.Lock()

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether a record is to be told."""
        if record.levelno < logging.WARNING:
            return True
        now = time.monotonic()
        with self._lock:
            begin, count = self._kinds.get(kind := _kind(record), (now, 0))
            if now - begin > _MINUTE_S:
                missed, begin, count = max(count - _MOST, 0), now, 0
                if missed:
                    record.msg, record.args = f"{record.getMessage()} (and {missed} times more before)", None
            if kind not in self._kinds and len(self._kinds) >= _KINDS:
                self._kinds.clear()
            self._kinds[kind] = begin, count + 1
        if count + 1 == _MOST:
            text = f"{record.getMessage()} (more of this kind in this minute are only counted)"
            record.msg, record.args = text, None
        return count < _MOST


def _kind(record: logging.LogRecord) -> tuple[str, int, str, str]:
    """What is equal for records that say the same of different things."""
    first = str(record.msg).split("\n", 1)[0][:100]
    raised = record.exc_info[0].__name__ if record.exc_info and record.exc_info[0] else ""
    return record.name, record.levelno, first, raised
