"""`lvba serve`: the job service in one process."""

import argparse
import logging
import sys

from lvba.errors import InputError
from service.cli import clusters
from service.cli.progress import Display
from service.cli.server_parser import settings_given
from service.settings import load
from service.system.repeat_filter import RepeatFilter


def serve(arguments: argparse.Namespace, display: Display) -> None:
    """Serve until a signal comes."""
    settings = load(settings_given(arguments))
    clusters.check(argparse.Namespace(**vars(settings)))
    if settings.port > 65535:
        raise InputError(f"--port {settings.port}", "there is no such port", "give one of 1..65535")
    from service.api import serving

    _log(logging.WARNING if arguments.quiet else logging.DEBUG if arguments.verbose else logging.INFO)
    serving.serve(settings)


def _log(level: int) -> None:
    """What happens, as lines on stderr."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s %(message)s"))
    handler.addFilter(RepeatFilter())
    logging.getLogger().handlers = [
        handler
    ]  # instead of that of a run; what libraries warn of comes here, too
    for name in ("service", "uvicorn.error"):
        logging.getLogger(name).setLevel(level)
