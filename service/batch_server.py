"""`lvba batch --server`: the recordings of a manifest, run by a server."""

import argparse
import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lvba import config
from lvba.errors import InputError
from lvba.io import files
from lvba.pipeline import Config
from service import batch_summary, stopping
from service.batch_manifest import Entry
from service.batch_summary import DONE, FAILED, RUNNING, WAITING, Row
from service.client import Client, connected
from service.client_commands import BUSY, get_results, send
from service.client_settings import changed
from service.progress import Display

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
            job["dataset"] = send(client, entry.dataset, entry.name, display)
        batch = client.post("/v1/batches", {"name": out.name, "jobs": jobs}, key=uuid.uuid4().hex)
        display.stage("run", 0, 1)
        _follow(client, batch["id"], rows, out, display)


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
        batch = client.get(f"/v1/batches/{batch_id}")
        for job in batch["jobs"]:
            if job["state"] not in BUSY and job["name"] not in fetched:
                _end(client, job, rows[job["name"]], out, display)
                fetched.add(job["name"])
            elif job["name"] not in fetched:
                rows[job["name"]].state = _STATES[job["state"]]
        batch_summary.write(out, list(rows.values()))
        display.progress("recordings", len(fetched), len(rows))
        if len(fetched) < len(rows):
            client.pause()


def _end(client: Client, job: dict[str, Any], row: Row, out: Path, display: Display) -> None:
    if job["state"] == "done":
        get_results(client, job["id"], out / row.name, display)
        row.state = DONE
        batch_summary.take_report(row, out / row.name)
        return
    error = job["error"] or {"cause": job["state"], "hint": "restart it on the server"}
    row.state, row.message = FAILED, f"{error['cause']}; {error['hint']}"
    display.note(f"{row.name}: {row.message}")
