"""Being told to stop, by Ctrl-C or by SIGTERM."""

import signal
from types import FrameType
from typing import NoReturn

_asked: list[int] = []


def install() -> None:
    """From now on both signals raise KeyboardInterrupt, and `asked` says that one came."""
    signal.signal(signal.SIGINT, _stop)
    signal.signal(signal.SIGTERM, _stop)


def asked() -> bool:
    """Whether a signal came. An interrupt inside compiled libraries can surface as any other error: ask this then."""
    return bool(_asked)


def _stop(number: int, frame: FrameType | None) -> NoReturn:
    _asked.append(number)
    raise KeyboardInterrupt
