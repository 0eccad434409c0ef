"""How many connections there are. When there are too many, whoever has kept the server waiting longest has to go."""

import ipaddress
from collections import Counter
from typing import Protocol


class SlotHolder(Protocol):
    """A connection."""

    def abort(self) -> None:
        """Break it off at once."""


class ConnectionSlots:
    """The connections of one service. A connection waits while no request of it is being answered."""

    def __init__(self, most: int, most_of_one: int, proxies: tuple[str, ...] = ()) -> None:
        """most_of_one: of one address, proxies excepted; never all"""
        self._most, self._most_of_one = most, min(most_of_one, most - most // 4)
        self._proxies = [ipaddress.ip_network(proxy) for proxy in proxies]
        self._places: dict[SlotHolder, str | None] = {}
        self._idle: dict[SlotHolder, None] = {}
        """Longest first."""
        self._counts: Counter[str | None] = Counter()

    def take(self, holder: SlotHolder, address: str) -> bool:
        """Whether there is room for one more, after somebody else was sent away for it if need be."""
        place = self._place(address)
        if (
            place is not None
            and self._counts[place] >= self._most_of_one
            and not self._abort_longest_idle(place)
        ):
            return False
        if len(self._places) >= self._most and not self._abort_longest_idle(None):
            return False
        self._places[holder] = place
        self._counts[place] += 1
        self._idle[holder] = None
        return True

    def _place(self, address: str) -> str | None:
        """What counts as one: an address, or the network of a customer. None: others stand behind it."""
        try:
            found = ipaddress.ip_address(address.partition("%")[0])
        except ValueError:
            return None
        found = getattr(found, "ipv4_mapped", None) or found
        if any(found in network for network in self._proxies):
            return None
        return str(found) if found.version == 4 else str(ipaddress.ip_network((int(found), 64), strict=False))

    def _abort_longest_idle(self, place: str | None) -> bool:
        """place: of whom; None: anybody"""
        holder = next((one for one in self._idle if place in (None, self._places[one])), None)
        if holder is None:
            return False
        self.release(holder)
        holder.abort()
        return True

    def mark_idle(self, holder: SlotHolder) -> None:
        """A connection's request is answered."""
        if holder in self._places:
            self._idle.setdefault(holder)

    def mark_busy(self, holder: SlotHolder) -> None:
        """A request has come over a connection."""
        self._idle.pop(holder, None)

    def release(self, holder: SlotHolder) -> None:
        """A connection has ended."""
        if holder in self._places:
            place = self._places.pop(holder)
            self._idle.pop(holder, None)
            self._counts[place] -= 1
            if not self._counts[place]:
                del self._counts[place]
