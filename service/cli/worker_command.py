"""`lvba worker`: a process that does steps of other people's runs."""

import argparse

from service.cli import clusters
from service.cli.progress import Display


def work(arguments: argparse.Namespace, display: Display) -> None:
    """Serve the scheduler until told to stop."""
    scheduler = clusters.connections().at(arguments.address, clusters.tls(arguments))
    from workers import worker

    worker.serve(scheduler.address, scheduler.security, clusters.memory_bytes(arguments), display.note)
