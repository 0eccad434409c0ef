"""Which addresses are of the internet: where a stranger may send the server without reaching the server's own network."""

import ipaddress

_IPV4 = [
    ipaddress.IPv4Network(network)
    for network in (
        "0.0.0.0/8", "10.0.0.0/8", "100.64.0.0/10", "127.0.0.0/8", "169.254.0.0/16", "172.16.0.0/12", "192.0.0.0/24",
        "192.0.2.0/24", "192.31.196.0/24", "192.52.193.0/24", "192.88.99.0/24", "192.168.0.0/16", "192.175.48.0/24",
        "198.18.0.0/15", "198.51.100.0/24", "203.0.113.0/24", "224.0.0.0/4", "240.0.0.0/4",
    )
]  # fmt: skip
"""Not public: the registry of special addresses of the IANA (RFC 6890), multicast, and what is reserved."""
_IPV6_PUBLIC = ipaddress.IPv6Network("2000::/3")
"""Outside are, for example, ::1, ::a.b.c.d, ::ffff:a.b.c.d, 64:ff9b::/96, fc00::/7, fe80::/10, fec0::/10, ff00::/8."""
_IPV6 = [
    ipaddress.IPv6Network(network)
    for network in ("2001::/23", "2001:db8::/32", "2002::/16", "2620:4f:8000::/48", "3fff::/20")
]
"""Of these, not public: protocols such as Teredo, documentation, and 6to4, which leads to any IPv4 address."""
_ISATAP = (0x00005EFE, 0x02005EFE)
"""Before an IPv4 address, in the lower half of an IPv6 address: a tunnel to it (RFC 5214)."""


def is_public(text: str) -> bool:
    """Whether an address is one of the internet, and stands for no other."""
    try:
        address = ipaddress.ip_address(text)
    except ValueError:  # also with a zone, as fe80::1%eth0
        return False
    if isinstance(address, ipaddress.IPv4Address):
        return not any(address in network for network in _IPV4)
    if address not in _IPV6_PUBLIC or any(address in network for network in _IPV6):
        return False
    return (int(address) >> 32) & 0xFFFFFFFF not in _ISATAP
