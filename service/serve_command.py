"""`lvba serve`: the job service in one process."""

import argparse
import logging
import sys

from lvba.errors import InputError
from service import clusters
from service.progress import Display
from service.server.settings import load
from service.server_cli import settings_given


def serve(arguments: argparse.Namespace, display: Display) -> None:
    """Serve until a signal comes."""
    settings = load(settings_given(arguments))
    clusters.check(argparse.Namespace(**vars(settings)))
    if settings.port > 65535:
        raise InputError(f"--port {settings.port}", "there is no such port", "give one of 1..65535")
    from service.server import serving

    if not arguments.quiet:
        _log(verbose=arguments.verbose)
    serving.serve(settings)


def _log(*, verbose: bool) -> None:
    """What happens, as lines on stderr."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s %(message)s"))
    for name in ("service", "uvicorn.error"):
        logger = logging.getLogger(name)
        logger.addHandler(handler)
        logger.propagate = False
        logger.setLevel(logging.DEBUG if verbose else logging.INFO)
