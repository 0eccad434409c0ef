"""`lvba import`: a bag, or a folder of another program, to a recording folder; continues where it was stopped."""

import argparse
import contextlib
import shlex
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from lvba import config
from lvba.errors import InputError
from lvba.io import bags, files, kitti
from lvba.io.dataset import SCAN_FOLDERS
from lvba.sources import folders
from lvba.sources.folders import recordings
from lvba.sources.importing.importer import ImportReport, import_source
from lvba.sources.importing.options import ImportOptions, parse_conventions
from lvba.sources.opening import open_source
from lvba.sources.source import Source, SourceDescription
from service.cli.progress import Display
from service.jobs.run_events import IMPORT
from service.system import file_lock
from service.system.printable import printable
from workers import local

_WAIT_S = 0.5
RECORDING = "recording"
"""In OUT: what `lvba run` makes of a bag first."""


def import_recording(arguments: argparse.Namespace, display: Display) -> None:
    """Write the recording folder, and say what was decided."""
    options, source = options_of(arguments), open_source(arguments.source)
    _check_needed(source.describe(), options)
    report = _imported(source, arguments.out, options, display)
    display.clear()
    sys.stdout.write(summary(report, arguments.out))


def is_needed(path: Path) -> bool:
    """Whether a path that `lvba run` is given must be imported first: a bag, or a folder of another program."""
    if bags.kind(path):
        return True
    if not path.is_dir() or kitti.is_kitti(path) or any((path / name).is_dir() for name in SCAN_FOLDERS):
        return False
    return folders.find(path) is not None


def of_run(arguments: argparse.Namespace, display: Display) -> Path | None:
    """The recording folder of what `lvba run` is given, imported into its OUT or --recording; None: it is one already.

    Raises InputError: it cannot be imported without choices, or options are given for what needs no import.
    """
    path: Path = arguments.dataset
    started = time.perf_counter()
    if arguments.import_options is None and not is_needed(path):
        if arguments.recording is not None:
            raise InputError(path, "is a recording folder already", "leave --recording out")
        return None
    options = ImportOptions()
    if arguments.import_options is not None:
        text = files.read_text(arguments.import_options)
        options = config.load(ImportOptions, text, where=str(arguments.import_options))
    recording: Path = arguments.recording or arguments.out / RECORDING
    display.first_stages([IMPORT, "input"])
    with _alone(recording, display):
        report = _imported(open_source(path), recording, options, display)
    for line in summary(report, recording).splitlines():
        display.tell(line)
    seconds, memory = round(time.perf_counter() - started, 3), round(local.peak_memory_mb(), 1)
    display.record(IMPORT, seconds, memory, report.reused)
    return recording


@contextlib.contextmanager
def _alone(recording: Path, display: Display) -> Iterator[None]:
    """No other run imports into the same folder meanwhile."""
    files.make_folder(recording.parent)
    lock = recording.with_name(f"{recording.name}.lock")
    with contextlib.ExitStack() as held:
        while True:
            try:
                held.enter_context(file_lock.exclusive(lock, patience=0.0))
                break
            except BlockingIOError:
                display.progress("waits for another import of the same", 0, 0)
                time.sleep(_WAIT_S)
        yield


def summary(report: ImportReport, out: Path) -> str:
    """Lines that say what an import made, and what it decided by what."""
    facts = report.facts
    written = facts.get("written", {})
    state = "imported before" if report.reused else "imported"
    lines = [f"{out}: {written.get('scans', 0)} scans and {written.get('images', 0)} images, {state}"]
    if "times_of_points" in facts:
        lines.append(f"times of points: {facts['times_of_points'].get('read_as', '')}")
    for question, decided in facts.get("conventions", {}).items():
        if decided.get("by") != "only":
            lines.append(f"{question}: {decided['taken']} ({_by(decided)})")
    lines += [f"left out: {loss}" for loss in facts.get("losses", [])]
    return "".join(f"{printable(line)}\n" for line in lines)


def _check_needed(description: SourceDescription, options: ImportOptions) -> None:
    """Raises InputError: it is a recording already, and no option asks for a change of it."""
    if description.format == recordings.RECORDING and options == ImportOptions():
        path = description.path
        problem = "is a recording folder already, and needs no import"
        raise InputError(path, problem, f"run it as it is: lvba run {shlex.quote(path)} --out RESULT")


def _by(decided: dict[str, object]) -> str:
    by = str(decided.get("by"))
    scores = decided.get("scores")
    if by != "data" or not isinstance(scores, dict):
        return {"option": "as said", "default": "the data cannot tell"}.get(by, f"by {by}")
    order = sorted(scores.values())
    words = {"m": "{:.1f} cm against {:.1f} cm", "rad/s": "{:.3f} rad/s against {:.3f} rad/s"}
    digits = words.get(str(decided.get("unit")), "unlikeness {:.3f} against {:.3f}")
    factor = 100 if decided.get("unit") == "m" else 1
    return "by the data: " + digits.format(factor * order[0], factor * order[1])


def _imported(source: Source, out: Path, options: ImportOptions, display: Display) -> ImportReport:
    """Its passes are shown as counts of one stage."""
    current = [""]

    def announce(name: str, index: int, total: int) -> None:
        current[0] = f"{name} ({index + 1} of {total}): "

    def progress(what: str, done: int, total: int) -> None:
        display.progress(current[0] + what, done, total)

    display.stage(IMPORT, 0, 1)
    report = import_source(source, out, options, progress, announce)
    for warning in report.warnings:
        display.note(f"warning: {warning}")
    return report


def options_of(arguments: argparse.Namespace) -> ImportOptions:
    """The options that a command line gives.

    Raises InputError: there is no such convention or answer.
    """
    conventions = parse_conventions(arguments.convention)
    if arguments.time_convention != "auto":
        conventions["time"] = arguments.time_convention
    return ImportOptions(
        lidar=arguments.lidar,
        image=arguments.image,
        imu=arguments.imu,
        odometry=arguments.odometry,
        calibration=tuple(arguments.calibration),
        camera=arguments.camera,
        preset=arguments.preset,
        conventions=conventions,
        start=arguments.start,
        stop=arguments.stop,
        every=arguments.every,
        rate=arguments.rate,
    )
