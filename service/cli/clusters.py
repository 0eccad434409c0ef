"""The cluster that a command line asks for: its own workers, or a scheduler that runs elsewhere."""

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from lvba.errors import InputError

if TYPE_CHECKING:
    from workers.connection import Scheduler, Tls


_LEAST_MEMORY_BYTES = 100_000_000
"""Less than this does not even hold the libraries."""


def check(arguments: argparse.Namespace) -> None:
    """That what the command line says of a cluster can be meant.

    Raises InputError: it cannot.
    """
    if arguments.scheduler is not None:
        connections().at(arguments.scheduler, tls(arguments))
    if arguments.scheduler is None and _tls_files(arguments) != [None, None, None]:
        raise InputError("--tls-ca", "means nothing without --scheduler", "give --scheduler tls://HOST:PORT")
    if memory_bytes(arguments) is not None and arguments.workers is None:
        raise InputError("--memory-limit", "means nothing without --workers", "give --workers N")


@contextmanager
def scheduler(arguments: argparse.Namespace) -> "Iterator[Scheduler]":
    """The scheduler of --workers or --scheduler, for as long as the block runs.

    Raises InputError: options that do not fit together.
    """
    connection = connections()
    if arguments.scheduler is not None:
        yield connection.at(arguments.scheduler, tls(arguments))
        return
    with connection.local(arguments.workers, arguments.threads, memory_bytes(arguments)) as own:
        yield own


def memory_bytes(arguments: argparse.Namespace) -> int | None:
    """What --memory-limit says, bytes; a number alone means GB. None: it is not given.

    Raises InputError: not an amount of memory.
    """
    text: str | None = getattr(arguments, "memory_limit", None)
    if text is None:
        return None
    from dask.utils import parse_bytes

    try:
        size = int(parse_bytes(f"{text} GB" if text.replace(".", "", 1).isdigit() else text))
    except ValueError:
        size = 0
    if size < _LEAST_MEMORY_BYTES:
        raise InputError(
            f"--memory-limit {text}", "is not an amount of memory to work with", "write for example 8GB"
        )
    return size


def tls(arguments: argparse.Namespace) -> "Tls | None":
    """What --tls-ca, --tls-cert and --tls-key say; None where they say nothing.

    Raises InputError: some of them are missing.
    """
    given = _tls_files(arguments)
    if given == [None, None, None]:
        return None
    if None in given:
        raise InputError("--tls-ca, --tls-cert, --tls-key", "one of them is missing", "give all three")
    files: Tls = connections().Tls(*given)
    return files


def _tls_files(arguments: argparse.Namespace) -> list[Path | None]:
    return [arguments.tls_ca, arguments.tls_cert, arguments.tls_key]


def connections() -> ModuleType:
    """`workers.connection`, imported when a cluster is asked for: Dask takes its time."""
    from workers import connection

    return connection
