"""One request to an address that a user gave: to a public address only, and over after a time that is set beforehand.

A name is looked up, every answer must be public, and the connection goes to just the address that was checked: a name
that answers otherwise a moment later changes nothing. No redirects; the answer is not read beyond its status.
"""

import http.client
import socket
import ssl
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from urllib.parse import SplitResult

from lvba.errors import InputError
from service.jobs.public_addresses import is_public


def post(
    parts: SplitResult, body: bytes, headers: Mapping[str, str], seconds: float, *, trusted: bool
) -> int:
    """The status of the answer.

    seconds: for all of it, whatever the other end does
    trusted: the address need not be public
    Raises InputError: no public address; OSError, http.client.HTTPException, ValueError: no answer.
    """
    line = _Line(time.monotonic() + seconds)
    host, port = parts.hostname or "", parts.port or (443 if parts.scheme == "https" else 80)
    address = host if trusted else public_address(host, port)
    timer = threading.Timer(line.left(), line.cut)
    timer.daemon = True
    timer.start()
    try:
        connection = http.client.HTTPConnection(host, port)
        connection.sock = line.connect(address, port, host if parts.scheme == "https" else None)
        path = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
        connection.request("POST", path, body, dict(headers))
        status = connection.getresponse().status
        line.left()  # a head that was cut looks like one that came to its end
        return status
    except (OSError, ValueError, http.client.HTTPException):
        line.left()  # if that is why, it is said
        raise
    finally:
        timer.cancel()
        line.close()


def public_address(host: str, port: int) -> str:
    """The address to connect to.

    Raises InputError: the name is not known, or any of its addresses is not public.
    """
    try:
        addresses = {str(info[4][0]) for info in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)}
    except OSError:
        raise InputError("webhook.url", "its host is not known", "check the name") from None
    if not addresses or not all(is_public(address) for address in addresses):
        raise InputError("webhook.url", "its host is not public", "give an address of the internet")
    return min(addresses)


class _Line:
    """A connection that is cut at its time: timeouts of sockets are those of single bytes."""

    def __init__(self, until: float) -> None:
        self._until = until
        self._socket: socket.socket | None = None

    def left(self) -> float:
        """Seconds.

        Raises TimeoutError: none.
        """
        left = self._until - time.monotonic()
        if left <= 0:
            raise TimeoutError
        return left

    def connect(self, address: str, port: int, name: str | None) -> socket.socket:
        """name: what the certificate must be for; None: without TLS"""
        self._socket = socket.create_connection((address, port), self.left())
        if name is not None:
            secured = ssl.create_default_context().wrap_socket(
                self._socket, server_hostname=name, do_handshake_on_connect=False
            )
            self._socket = secured
            self.left()
            secured.do_handshake()
        self.left()
        return self._socket

    def cut(self) -> None:
        """Have whoever reads from it find its end."""
        if self._socket is not None:
            with suppress(OSError):  # it has ended by itself
                # of the socket below TLS, which another thread uses at this moment
                socket.socket.shutdown(self._socket, socket.SHUT_RDWR)

    def close(self) -> None:
        """It is not needed any more."""
        if self._socket is not None:
            self._socket.close()
