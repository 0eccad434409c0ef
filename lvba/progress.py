"""How long work tells what it has done, and how it is asked to stop."""

from collections.abc import Callable

Progress = Callable[[str, int, int], None]
"""Called as progress(what, done, total) between small pieces of work. May raise to cancel: callers let it through."""


def silent(what: str, done: int, total: int) -> None:
    """The progress nobody watches."""
