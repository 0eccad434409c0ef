"""What the commands do, and how every way to fail ends: one line on stderr and an exit code."""

import argparse
import errno
import logging
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from lvba.errors import InputError, Lack, LvbaError
from lvba.io import files
from service.cli import server_parser, stopping
from service.cli.progress import Display
from service.jobs.run_events import EndReason
from service.system.printable import printable

_USERS_TO_MEND = {errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EPERM, errno.EROFS, errno.EFBIG}
"""Failures of the system that whoever started the command can do something about."""
_REASONS = {None: EndReason.INPUT, Lack.DISK: EndReason.DISK_FULL, Lack.MEMORY: EndReason.OUT_OF_MEMORY}
_NO_CACHE = "no locator available"
"""What numba says where it can write neither to NUMBA_CACHE_DIR, nor beside the kernels, nor in the home folder."""
_NOT_KEPT = "compiled kernels: no folder for them can be written; set NUMBA_CACHE_DIR to one that can"
_OUT_OF_MEMORY = "out of memory: finished stages are kept; free memory or use fewer frames"


def main(arguments: argparse.Namespace) -> int:
    """The exit code of a command."""
    try:
        display = _display(arguments)
    except InputError as error:
        return _end(Display(), str(error), 2, _why(error))
    stopping.say_at_last(lambda: _end(display, _stopped(arguments), stopping.code(), EndReason.STOPPED))
    try:
        return _run(arguments, display)
    finally:
        stopping.heard()
        display.clear()


def _display(arguments: argparse.Namespace) -> Display:
    events = getattr(arguments, "events", None)
    if events is None:
        return Display(quiet=arguments.quiet, check=stopping.check)
    from service.cli.event_display import EventDisplay

    return EventDisplay(events, quiet=arguments.quiet, check=stopping.check)


def _run(arguments: argparse.Namespace, display: Display) -> int:
    try:
        with _log_to(display, arguments.verbose):
            _command(arguments.command)(arguments, display)
        display.end(0, EndReason.DONE, "", None)
        return 0
    except KeyboardInterrupt:
        return _end(display, _stopped(arguments), stopping.code(), EndReason.STOPPED)
    except InputError as error:
        return _end(display, str(error), 2, _why(error), error)
    except LvbaError as error:
        return _end(display, str(error), 1, EndReason.FAILED, error)
    except MemoryError:
        return _end(display, _OUT_OF_MEMORY, 1, EndReason.OUT_OF_MEMORY)
    except BrokenPipeError:
        return 1
    except OSError as error:
        if error.errno not in _USERS_TO_MEND:
            display.end(1, EndReason.UNEXPECTED, f"{type(error).__name__}: {error}", None)
            raise
        where = error.filename or getattr(arguments, "out", None) or "output"
        mended = files.input_error(where, error)
        return _end(display, str(mended), 2, _why(mended), mended)
    except Exception as error:
        if _NO_CACHE in str(error):
            return _end(display, _NOT_KEPT, 2, EndReason.INPUT)
        # nobody foresaw it: whoever listens learns it here, whoever reads the log finds where it comes from
        display.end(1, EndReason.UNEXPECTED, f"{type(error).__name__}: {error}", None)
        raise


def _command(name: str) -> Callable[[argparse.Namespace, Display], None]:
    # imported by name: `simulate` must not load what only `run` needs
    if name == "import":
        from service.cli import import_command

        return import_command.import_recording
    if name == "run":
        from service.cli import run_command

        return run_command.run
    if name == "batch":
        from service.cli import batch_command

        return batch_command.batch
    if name == "worker":
        from service.cli import worker_command

        return worker_command.work
    if name == "evaluate":
        from service.cli import evaluate_command

        return evaluate_command.evaluate
    if name == "simulate":
        from service.cli import simulate_command

        return simulate_command.simulate
    if name == "inspect":
        from service.cli import inspect_command

        return inspect_command.inspect
    if name == "view":
        from service.cli import view_command

        return view_command.view
    if name == "warm":
        from service.cli import warm_command

        return warm_command.warm
    if name == "serve":
        from service.cli import serve_command

        return serve_command.serve
    if name == "admin":
        from service.cli import admin_command

        return admin_command.admin
    if server_parser.is_asked(name):
        from service.cli import client_commands

        return client_commands.ask
    from service.cli import export_command

    return export_command.export


def _stopped(arguments: argparse.Namespace) -> str:
    if arguments.command == "run":
        return f"stopped; finished stages are kept in {arguments.out}: the same command continues from there"
    if arguments.command == "import":
        return f"stopped; what is written is kept in {arguments.out}: the same command continues from there"
    return "stopped"


def _why(error: InputError) -> EndReason:
    """The machine, where it lacked something; else the input."""
    return _REASONS[error.lack]


def _end(display: Display, message: str, code: int, reason: EndReason, error: LvbaError | None = None) -> int:
    display.clear()
    one_line = printable(" ".join(message.split()))
    sys.stderr.write(f"lvba: {one_line}\n")
    display.end(code, reason, one_line, error)
    return code


@contextmanager
def _log_to(display: Display, verbose: bool) -> Iterator[None]:
    """What the library logs, as lines between the progress."""
    handler = _Lines(display)
    logger = logging.getLogger()
    before = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.WARNING)
    for name in ("lvba", "workers", "service"):
        logging.getLogger(name).setLevel(logging.DEBUG if verbose else logging.WARNING)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before)


class _Lines(logging.Handler):
    def __init__(self, display: Display) -> None:
        super().__init__()
        self._display = display

    def emit(self, record: logging.LogRecord) -> None:
        kind = "warning: " if record.levelno >= logging.WARNING else ""
        self._display.note(f"{kind}{record.getMessage()}")
