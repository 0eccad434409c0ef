"""The clock of a sensor that stamps its packets itself, laid onto the clock of the recorder where it is another one."""

from collections import deque

_OF_DAY = (10**18, 4 * 10**18)
"""ns since 1970, of 2001 and 2096: such stamps are by the time of day, all others since the sensor started."""
_NEAR_NS, _FAR_NS = 10 * 10**9, 100 * 10**9
_WHOLE_NS = 250_000_000
"""Times of day that are apart by between these, and by so nearly a whole number of seconds, differ by leap seconds."""
_JUMP_NS = 10 * 10**9
"""By which packets cannot be late, so that a clock was set, or began anew."""
_PIECE_NS, _PIECES = 10**9, 10
_DRIFT = 1e-4
"""Clocks drift by less."""
_SECOND = 10**9


class SensorClock:
    """Packets may come late, and never early: where the sensor counts since its start, the least late ones of some
    seconds tell how far its clock is from the recorder's, and the difference follows its drift slowly.

    Stamps by the time of day stay, but for leap seconds (PTP counts TAI, which Ouster's driver corrects, too).
    """

    def __init__(self) -> None:
        self._apart: int | None = None
        self._own = False
        self._before = self._recorded = 0
        self._least: deque[tuple[int, int]] = deque(maxlen=_PIECES)

    def see(self, stamp: int, recorded: int) -> None:
        """A packet with a stamp of the sensor was recorded. Both: ns"""
        late = recorded - stamp
        if self._apart is None or abs(late - self._before) > _JUMP_NS:
            self._begin(stamp, late)
        elif self._own:
            self._follow(late, recorded)
        self._before, self._recorded = late, recorded

    def apart(self) -> int:
        """ns, to add to stamps of the sensor."""
        return self._apart or 0

    def _begin(self, stamp: int, late: int) -> None:
        self._least.clear()
        self._own = not _OF_DAY[0] < stamp < _OF_DAY[1]
        seconds = round(late / _SECOND)
        leap = _NEAR_NS < abs(late) < _FAR_NS and abs(late - seconds * _SECOND) < _WHOLE_NS
        self._apart = late if self._own else seconds * _SECOND if leap else 0

    def _follow(self, late: int, recorded: int) -> None:
        assert self._apart is not None
        piece = recorded // _PIECE_NS
        if self._least and self._least[-1][0] == piece:
            self._least[-1] = piece, min(late, self._least[-1][1])
        else:
            self._least.append((piece, late))
        least = min(each for _, each in self._least)
        if len(self._least) < _PIECES:
            self._apart = min(self._apart, least)
            return
        most = max(recorded - self._recorded, 0) * _DRIFT
        self._apart = min(least, self._apart + round(most))
