"""`lvba worker`: a process that does steps of other people's runs."""

import argparse

from lvba.errors import InputError
from service import clusters
from service.progress import Display


def work(arguments: argparse.Namespace, display: Display) -> None:
    """Serve the scheduler until told to stop."""
    scheduler = clusters.connections().at(arguments.address, clusters.tls(arguments))
    from workers import worker

    worker.serve(scheduler.address, scheduler.security, _memory(arguments.memory_limit), display.note)


def _memory(text: str | None) -> int | None:
    """Bytes; None: no limit given.

    Raises InputError: not an amount of memory.
    """
    from dask.utils import parse_bytes

    try:
        return None if text is None else int(parse_bytes(text))
    except ValueError:
        raise InputError(
            f"--memory-limit {text}", "is not an amount of memory", "write for example 8GB"
        ) from None
