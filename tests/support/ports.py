"""Ports for servers that are stopped and started again."""

import random
import socket


def free_port():
    """A port that nothing else takes meanwhile: below those that systems give to outgoing connections.

    A client that tries again and again where nobody listens is at last given the very same port for its own end.
    """
    for port in random.sample(range(20_000, 32_000), 1000):
        with socket.socket() as tried:
            try:
                tried.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port
    raise OSError("no free port")
