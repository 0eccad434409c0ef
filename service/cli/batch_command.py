"""`lvba batch`: many recordings, a few at a time, each in a process of its own."""

import argparse
import ctypes
import json
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lvba import config
from lvba.errors import LvbaError
from lvba.io import files, result_folder
from service.cli import batch_manifest, batch_summary, clusters, stopping
from service.cli.batch_manifest import Entry
from service.cli.batch_summary import DONE, FAILED, RUNNING, WAITING, Row
from service.cli.progress import Display

_WAIT_SECONDS = 0.1
_DIE_WITH_PARENT = 1
"""PR_SET_PDEATHSIG of Linux."""


def batch(arguments: argparse.Namespace, display: Display) -> None:
    """Run every recording of the manifest and write the summary.

    Raises LvbaError: some failed.
    """
    entries = batch_manifest.read(arguments.manifest)
    clusters.check(arguments)
    out = result_folder.prepare(arguments.out)
    rows = {entry.name: Row(entry.name, str(entry.dataset)) for entry in entries}
    display.stage("batch", 0, 1)
    if arguments.server is not None:
        from service.cli import batch_on_server

        batch_on_server.run(arguments, batch_manifest.in_turns(entries), rows, out, display)
    else:
        _run_here(Queue(arguments, batch_manifest.in_turns(entries), rows, out, display))
    display.clear()
    sys.stdout.write(batch_summary.table(list(rows.values())) + "\n")
    failed = sum(row.state == FAILED for row in rows.values())
    if failed:
        raise LvbaError(f"{failed} of {len(rows)} failed; see {out / 'summary.json'}")


def _run_here(queue: "Queue") -> None:
    try:
        queue.run()
    finally:
        queue.stop()


@dataclass
class Job:
    """A run that is under way."""

    entry: Entry
    process: "subprocess.Popen[bytes]"
    log: Path
    """What it wrote to stderr."""


class Queue:
    """Recordings that wait, run or have ended."""

    def __init__(
        self,
        arguments: argparse.Namespace,
        waiting: Sequence[Entry],
        rows: dict[str, Row],
        out: Path,
        display: Display,
    ) -> None:
        self._arguments, self._rows, self._out, self._display = arguments, rows, out, display
        self._waiting = list(waiting)
        self._jobs: list[Job] = []

    def run(self) -> None:
        """Until every recording is done or failed."""
        while self._waiting or self._jobs:
            stopping.check()
            ended = [job for job in self._jobs if job.process.poll() is not None]
            for job in ended:
                self._jobs.remove(job)
                self._end(job)
            started = self._start()
            if ended or started:
                self._show_progress()
            time.sleep(_WAIT_SECONDS)

    def stop(self) -> None:
        """Have what still runs stop; finished stages stay."""
        for job in self._jobs:
            job.process.terminate()
            self._rows[job.entry.name].state = WAITING
        batch_summary.write(self._out, list(self._rows.values()))

    def _start(self) -> bool:
        started = False
        while self._waiting and len(self._jobs) < self._arguments.jobs:
            entry = self._waiting.pop(0)
            choices = _choices(entry, self._out)
            words = command(self._arguments, entry, self._out / entry.name, choices)
            self._jobs.append(_launch(words, entry, self._out))
            self._rows[entry.name].state = RUNNING
            started = True
        return started

    def _end(self, job: Job) -> None:
        row = self._rows[job.entry.name]
        if job.process.returncode == 0:
            row.state = DONE
            batch_summary.take_report(row, self._out / row.name)
        else:
            row.state, row.message = FAILED, _last_words(job)
            self._display.note(f"{row.name}: {row.message}")

    def _show_progress(self) -> None:
        batch_summary.write(self._out, list(self._rows.values()))
        ended = sum(row.state in (DONE, FAILED) for row in self._rows.values())
        self._display.progress("recordings", ended, len(self._rows))


def _choices(entry: Entry, out: Path) -> Path | None:
    """The file with the options of an import; None: there are none."""
    if entry.imported is None:
        return None
    path = out / f"{entry.name}.import.yaml"
    files.write_text(path, json.dumps(config.to_dict(entry.imported)) + "\n")
    return path


def command(arguments: argparse.Namespace, entry: Entry, out: Path, choices: Path | None = None) -> list[str]:
    """The `lvba run` of one recording. choices: file with options of its import"""
    words = [sys.executable, "-m", "service.cli", "run", str(entry.dataset), "--out", str(out), "--quiet"]
    words += [word for setting in entry.settings for word in ("--set", setting)]
    options = {
        "config": entry.config,
        "import": choices,
        "reference": entry.reference,
        "store": f"{arguments.store.rstrip('/')}/{entry.name}" if arguments.store else None,
        "threads": arguments.threads,
        "workers": arguments.workers,
        "memory-limit": arguments.memory_limit,
        "scheduler": arguments.scheduler,
        "tls-ca": arguments.tls_ca,
        "tls-cert": arguments.tls_cert,
        "tls-key": arguments.tls_key,
    }
    return words + [f"--{name}={value}" for name, value in options.items() if value is not None]


def _launch(words: list[str], entry: Entry, out: Path) -> Job:
    log = out / f"{entry.name}.log"
    with log.open("wb") as stream:
        process = subprocess.Popen(
            words,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=stream,
            # Ctrl-C is for the batch, which passes it on
            start_new_session=True,
            preexec_fn=_die_with_parent if sys.platform == "linux" else None,
        )
    return Job(entry, process, log)


def _last_words(job: Job) -> str:
    lines = job.log.read_text("utf-8", "replace").splitlines()
    said = next((line for line in reversed(lines) if line.strip()), "")
    return said.removeprefix("lvba: ") or f"ended with code {job.process.returncode}"


def _die_with_parent() -> None:
    """A batch that is killed leaves nothing running that a new one would trip over."""
    ctypes.CDLL(None).prctl(_DIE_WITH_PARENT, signal.SIGTERM)
