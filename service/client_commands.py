"""`lvba submit | jobs | status | logs | cancel | fetch`: a server, asked from elsewhere."""

import argparse
import json
import sys
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lvba.errors import InputError, LvbaError
from service import stopping
from service.client import Client, connected
from service.progress import Display, clock_text

_ARCHIVES = (".zip", ".tar", ".tgz", ".tar.gz", ".tar.bz2", ".tar.xz")
BUSY = ("queued", "running", "canceling")
"""States of a job that has not ended."""


def ask(arguments: argparse.Namespace, display: Display) -> None:
    """Do what the command line says."""
    commands: dict[str, Callable[[argparse.Namespace, Client, Display], None]] = {
        "submit": submit,
        "jobs": jobs,
        "status": status,
        "logs": logs,
        "cancel": cancel,
        "fetch": fetch,
    }
    with connected(arguments.server, arguments.key_file, stopping.check) as client:
        commands[arguments.command](arguments, client, display)
    display.clear()


def submit(arguments: argparse.Namespace, client: Client, display: Display) -> None:
    """Upload a recording, unless it is there, and queue a job."""
    # knows all settings, and with them the whole method: what the other commands need not wait for
    from service import client_settings

    wanted = client_settings.of(arguments)
    dataset = arguments.recording
    name = arguments.name or Path(dataset.rstrip("/")).resolve().name
    if "://" in dataset:
        dataset = register(client, dataset, name, display)
    elif not dataset.startswith("ds_") or Path(dataset).exists():
        dataset = send(client, Path(dataset), name, display)
    body = {
        "dataset": dataset,
        **({"name": name} if arguments.name or dataset != arguments.recording else {}),
        **{"config": wanted, "priority": arguments.priority, "reference": arguments.reference},
    }
    job = client.post("/v1/jobs", body, key=uuid.uuid4().hex)
    display.clear()
    sys.stdout.write(job["id"] + "\n")
    sys.stdout.flush()
    if arguments.wait:
        _raise_unless_done(watch(client, job["id"], display))


def send(client: Client, recording: Path, name: str, display: Display) -> str:
    """The id of a dataset with this recording, once the server has found it good. An upload that was cut goes on.

    Raises InputError: it is no recording, or the server finds it bad.
    """
    display.stage("upload", 0, 2)
    if not recording.exists():
        raise InputError(
            recording, "there is no such file or folder", "give a recording, or the id of a dataset"
        )
    begun = (
        row for row in client.every("/v1/datasets") if (row["name"], row["state"]) == (name, "uploading")
    )
    dataset = next(begun, None) or client.post("/v1/datasets", {"name": name})
    for file, path in _files(recording):
        client.upload(dataset["id"], file, path, display.progress)
    display.stage("check", 1, 2)
    client.post(f"/v1/datasets/{dataset['id']}/finish")
    return _checked(client, dataset, recording)


def register(client: Client, url: str, name: str, display: Display) -> str:
    """The id of a dataset of what lies under a URL, once the server has fetched it and found it good.

    Raises InputError: it may not be registered there, or the server finds it bad.
    """
    display.stage("fetch and check", 0, 1)
    return _checked(client, client.post("/v1/datasets", {"name": name, "folder": url}), url)


def _checked(client: Client, dataset: dict[str, Any], recording: object) -> str:
    found = client.wait_while(f"/v1/datasets/{dataset['id']}", ("validating",))
    if found["state"] != "ready":
        raise InputError(recording, found["error"]["cause"], found["error"]["hint"])
    return str(found["id"])


def _files(recording: Path) -> list[tuple[Path, str | None]]:
    """Files to send with their names there; None: an archive."""
    if recording.is_file():
        if not recording.name.lower().endswith(_ARCHIVES):
            raise InputError(recording, "is no archive", f"give a folder, or one of {', '.join(_ARCHIVES)}")
        return [(recording, None)]
    found = sorted(path for path in recording.rglob("*") if path.is_file())
    inside = [(path, path.relative_to(recording).as_posix()) for path in found]
    plain = [
        (path, name) for path, name in inside if not any(part.startswith(".") for part in name.split("/"))
    ]
    if not plain:
        raise InputError(recording, "holds no files", "give the folder of a recording")
    return [(path, name) for path, name in plain]


def watch(client: Client, job_id: str, display: Display) -> dict[str, Any]:
    """The job, once it has ended; how far it is, is shown meanwhile."""
    shown = ""
    while True:
        job: dict[str, Any] = client.get(f"/v1/jobs/{job_id}")
        if job["state"] not in BUSY:
            display.clear()
            return job
        for index, stage in enumerate(job["stages"]):
            if stage["state"] == "running":
                if stage["name"] != shown:
                    display.stage(stage["name"], index, len(job["stages"]))
                    shown = stage["name"]
                if stage["total"]:
                    display.progress(stage["what"], stage["done"], stage["total"])
        client.pause()


def _raise_unless_done(job: dict[str, Any]) -> None:
    if job["state"] != "done":
        error = job["error"] or {"cause": job["state"], "hint": "restart it to go on"}
        raise LvbaError(f"{job['id']} {job['state']}: {error['cause']}; {error['hint']}")


def jobs(arguments: argparse.Namespace, client: Client, display: Display) -> None:
    """One line a job."""
    query = {"state": arguments.state} if arguments.state else {}
    for job in client.every("/v1/jobs", **query):
        sys.stdout.write(
            f"{job['id']}  {job['state']:<9} {_percent(job):>4}  {job['created'][:19]}  {job['name']}\n"
        )


def status(arguments: argparse.Namespace, client: Client, display: Display) -> None:
    """State, stages and error of a job."""
    job = client.get(f"/v1/jobs/{arguments.job}")
    if arguments.json:
        sys.stdout.write(json.dumps(job, indent=1) + "\n")
        return
    left = f", {clock_text(job['eta_s'])} left" if job["eta_s"] is not None else ""
    place = f", {job['position']} before it" if job["state"] == "queued" else ""
    sys.stdout.write(f"{job['name']}: {job['state']} {_percent(job)}{left}{place}\n")
    for stage in job["stages"]:
        seconds = "" if stage["seconds"] is None else f"{stage['seconds']:.1f} s"
        reused = "reused" if stage["reused"] else ""
        sys.stdout.write(f"  {stage['name']:<24} {stage['state']:<8} {seconds:>10} {reused}".rstrip() + "\n")
    if job["error"]:
        sys.stdout.write(f"  {job['error']['cause']}\n  {job['error']['hint']}\n")


def _percent(job: dict[str, Any]) -> str:
    return f"{int(job['progress'] * 100)}%"


def logs(arguments: argparse.Namespace, client: Client, display: Display) -> None:
    """What a job has said; with --follow also what it will say."""
    start = 0
    while True:
        found = client.get(f"/v1/jobs/{arguments.job}/logs", **{"from": start})
        sys.stdout.write(found["text"])
        sys.stdout.flush()
        more = found["next"] < found["size"] and found["next"] > start
        start = found["next"]
        if not more and (found["ended"] or not arguments.follow):
            return
        if not more:
            client.pause()


def cancel(arguments: argparse.Namespace, client: Client, display: Display) -> None:
    """Stop a job."""
    job = client.post(f"/v1/jobs/{arguments.job}/cancel")
    sys.stdout.write(f"{job['state']}\n")


def fetch(arguments: argparse.Namespace, client: Client, display: Display) -> None:
    """Get the results of a job into a folder."""
    job = client.get(f"/v1/jobs/{arguments.job}")
    out = arguments.out or Path(Path(job["name"]).name)
    get_results(client, arguments.job, out, display, set(arguments.names))
    display.clear()
    sys.stdout.write(f"{out}\n")


def get_results(
    client: Client, job_id: str, out: Path, display: Display, names: set[str] | None = None
) -> None:
    """Get results into a folder; names: only these.

    Raises InputError: a name that is not among them, or would lie elsewhere.
    """
    items = list(client.every(f"/v1/jobs/{job_id}/results"))
    missing = (names or set()) - {item["name"] for item in items}
    if missing:
        raise InputError(min(missing), "is not among the results", "see what there is: fetch without names")
    wanted = [item for item in items if not names or item["name"] in names]
    for number, item in enumerate(wanted):
        target = (out / item["name"]).resolve()
        if not target.is_relative_to(out.resolve()):
            raise InputError(item["name"], "would lie outside of --out", "do not trust this server")
        client.download(item["url"], target, item["bytes"], item["etag"])
        display.progress("results", number + 1, len(wanted))
