"""`lvba batch --server`: the recordings of a manifest, run by a server."""

import argparse
import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lvba import config
from lvba.errors import InputError, LvbaError
from lvba.io import files
from lvba.pipeline import Config
from lvba.sources.importing.options import ImportOptions
from service.cli import batch_summary, server_responses, stopping
from service.cli.batch_manifest import Entry
from service.cli.batch_summary import DONE, FAILED, RUNNING, WAITING, Row
from service.cli.client import Client, connected
from service.cli.client_commands import BUSY, get_results, looked_at, send
from service.cli.client_settings import changed
from service.cli.progress import Display
from service.cli.server_responses import Failure, Job
from service.datasets import file_names
from service.system.printable import printable

_STATES = {"queued": WAITING, "running": RUNNING, "canceling": RUNNING}


def run(
    arguments: argparse.Namespace,
    entries: Sequence[Entry],
    rows: dict[str, Row],
    out: Path,
    display: Display,
) -> None:
    """Upload every recording, have all of them run, and get the results of those that are done."""
    jobs = [_job(entry) for entry in entries]
    with connected(arguments.server, arguments.key_file, stopping.check) as client:
        for entry, job in zip(entries, jobs, strict=True):
            bag = looked_at(entry.imported or ImportOptions(), entry.dataset, display)
            if bag is not None:
                job["import"] = bag.choices
            job["dataset"] = send(client, entry.dataset, entry.name, display, bag)
        wanted = {"name": file_names.plain(out.resolve().name, "batch"), "jobs": jobs}
        batch, _ = client.post("/v1/batches", wanted, server_responses.batch, key=uuid.uuid4().hex)
        display.stage("run", 0, 1)
        _follow(client, batch, rows, out, display)


def _job(entry: Entry) -> dict[str, Any]:
    """The request of an entry, but for its dataset."""
    inside = entry.dataset / "reference"
    if entry.reference is not None and entry.reference.resolve() != inside.resolve():
        raise InputError(entry.reference, "is not `reference` in the recording", "put it there for a server")
    text = files.read_text(entry.config) if entry.config else ""
    wanted = config.load(Config, text, entry.settings, where=str(entry.config or "config"))
    return {"name": entry.name, "config": changed(wanted), "reference": entry.reference is not None}


def _follow(client: Client, batch_id: str, rows: dict[str, Row], out: Path, display: Display) -> None:
    fetched: set[str] = set()
    while len(fetched) < len(rows):
        _, jobs = client.get(f"/v1/batches/{batch_id}", server_responses.batch)
        for job in jobs:
            if job.name not in rows:
                raise LvbaError(f"the server knows a recording that was not sent: {printable(job.name)!r}")
            if job.state not in BUSY and job.name not in fetched:
                _end(client, job, rows[job.name], out, display)
                fetched.add(job.name)
            elif job.name not in fetched:
                rows[job.name].state = _STATES[job.state]
        batch_summary.write(out, list(rows.values()))
        display.progress("recordings", len(fetched), len(rows))
        if len(fetched) < len(rows):
            client.pause()


def _end(client: Client, job: Job, row: Row, out: Path, display: Display) -> None:
    if job.state == "done":
        get_results(client, job.id, out / row.name, display)
        row.state = DONE
        try:
            batch_summary.take_report(row, out / row.name)
            return
        except (ValueError, LookupError, TypeError, AttributeError):
            error = Failure("report.json is not a report of lvba", "do not trust this server")
    else:
        error = job.error or Failure(job.state, "restart it on the server")
    row.state, row.message = FAILED, f"{error.cause}; {error.hint}"
    display.note(f"{row.name}: {row.message}")
