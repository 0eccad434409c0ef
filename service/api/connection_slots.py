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
        self._networks: dict[SlotHolder, str | None] = {}
        self._idle: dict[SlotHolder, None] = {}
        """Longest first."""
        self._counts: Counter[str | None] = Counter()
        self.closed = False
        """The service is ending: whoever comes now is sent away."""

    def close(self) -> None:
        """Let nobody in any more."""
        self.closed = True

    def take(self, holder: SlotHolder, address: str) -> bool:
        """Whether there is room for one more, after somebody else was sent away for it if need be."""
        network = self._network(address)
        if (
            network is not None
            and self._counts[network] >= self._most_of_one
            and not self._abort_longest_idle(network)
        ):
            return False
        if len(self._networks) >= self._most and not self._abort_longest_idle(None):
            return False
        self._networks[holder] = network
        self._counts[network] += 1
        self._idle[holder] = None
        return True

    def _network(self, address: str) -> str | None:
        """What counts as one: an address, or the network of a customer. None: others stand behind it."""
        try:
            parsed = ipaddress.ip_address(address.partition("%")[0])
        except ValueError:
            return None
        parsed = getattr(parsed, "ipv4_mapped", None) or parsed
        if any(parsed in network for network in self._proxies):
            return None
        return (
            str(parsed) if parsed.version == 4 else str(ipaddress.ip_network((int(parsed), 64), strict=False))
        )

    def _abort_longest_idle(self, network: str | None) -> bool:
        """network: of whom; None: anybody"""
        holder = next((one for one in self._idle if network in (None, self._networks[one])), None)
        if holder is None:
            return False
        self.release(holder)
        holder.abort()
        return True

    def mark_idle(self, holder: SlotHolder) -> None:
        """A connection's request is answered."""
        if holder in self._networks:
            self._idle.setdefault(holder)

    def mark_busy(self, holder: SlotHolder) -> None:
        """A request has come over a connection."""
        self._idle.pop(holder, None)

    def release(self, holder: SlotHolder) -> None:
        """A connection has ended."""
        if holder in self._networks:
            network = self._networks.pop(holder)
            self._idle.pop(holder, None)
            self._counts[network] -= 1
            if not self._counts[network]:
                del self._counts[network]
