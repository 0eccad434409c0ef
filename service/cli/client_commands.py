"""`lvba submit | jobs | status | logs | cancel | fetch`: a server, asked from elsewhere."""

import argparse
import json
import sys
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from lvba.errors import InputError, LvbaError
from service.cli import server_responses, stopping
from service.cli.client import Client, connected
from service.cli.download_folder import OutFolder
from service.cli.progress import Display, clock_text
from service.cli.server_responses import Dataset, Failure, Job, Result
from service.datasets import file_names, recording_names
from service.system.printable import printable

if TYPE_CHECKING:
    from lvba.sources.importing.options import ImportOptions
    from service.cli.bag_submission import BagSubmission

_DISTRUST = "the server names a result {}, which {}: nothing was fetched; do not trust this server"
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
    from service.cli import client_settings

    wanted = client_settings.of(arguments)
    dataset = arguments.recording
    choices: dict[str, Any] | None = None
    name = arguments.name or file_names.plain(Path(dataset.rstrip("/")).resolve().name, "recording")
    if "://" in dataset:
        choices = _choices_by_name(arguments)
        dataset = register(client, dataset, name, display)
    elif not dataset.startswith("ds_") or Path(dataset).exists():
        bag = _bag(arguments, Path(dataset), display)
        if bag is not None:
            choices = bag.choices
        dataset = send(client, Path(dataset), name, display, bag)
    else:
        choices = _choices_by_name(arguments)
    body = {
        "dataset": dataset,
        **({"name": name} if arguments.name or dataset != arguments.recording else {}),
        **({"import": choices} if choices else {}),
        **{"config": wanted, "priority": arguments.priority, "reference": arguments.reference},
    }
    job = client.post("/v1/jobs", body, server_responses.job, key=uuid.uuid4().hex)
    display.clear()
    sys.stdout.write(job.id + "\n")
    sys.stdout.flush()
    if arguments.wait:
        _raise_unless_done(watch(client, job.id, display))


def _bag(arguments: argparse.Namespace, recording: Path, display: Display) -> "BagSubmission | None":
    from service.cli import import_command

    return looked_at(import_command.options_of(arguments), recording, display)


def looked_at(options: "ImportOptions", recording: Path, display: Display) -> "BagSubmission | None":
    """What is sent of a bag, as of `bag_submission.prepare`; None also for an archive, which the server looks into.

    Raises InputError: as `bag_submission.prepare`
    """
    if recording.is_file() and recording.name.lower().endswith(_ARCHIVES):
        return None
    from service.cli import bag_submission

    return bag_submission.prepare(options, recording, display)


def _choices_by_name(arguments: argparse.Namespace) -> dict[str, Any] | None:
    """Choices for a dataset that is on the server: files have their names in it."""
    from service.cli import bag_submission, import_command

    return bag_submission.changed(import_command.options_of(arguments)) or None


def send(
    client: Client, recording: Path, name: str, display: Display, bag: "BagSubmission | None" = None
) -> str:
    """The id of a dataset with this recording, once the server has found it good. An upload that was cut continues.

    Raises InputError: it is no recording, or the server finds it bad.
    """
    display.stage("upload", 0, 2)
    if not recording.exists():
        raise InputError(
            recording, "there is no such file or folder", "give a recording, or the id of a dataset"
        )
    if recording.is_dir() and bag is None:
        recording_names.check(recording)
    every = client.every("/v1/datasets", server_responses.dataset)
    begun = (row for row in every if (row.name, row.state) == (name, "uploading"))
    dataset = next(begun, None) or client.post("/v1/datasets", {"name": name}, server_responses.dataset)
    for file, path in bag.files if bag else _files(recording):
        client.upload(dataset.id, file, path, display.progress)
    display.stage("check", 1, 2)
    client.post(f"/v1/datasets/{dataset.id}/finish")
    return _checked(client, dataset, recording)


def register(client: Client, url: str, name: str, display: Display) -> str:
    """The id of a dataset of what lies under a URL, once the server has fetched it and found it good.

    Raises InputError: it may not be registered there, or the server finds it bad.
    """
    display.stage("fetch and check", 0, 1)
    return _checked(
        client, client.post("/v1/datasets", {"name": name, "folder": url}, server_responses.dataset), url
    )


def _checked(client: Client, dataset: Dataset, recording: object) -> str:
    checked = client.wait_while(f"/v1/datasets/{dataset.id}", server_responses.dataset, ("validating",))
    if checked.state != "ready":
        error = checked.error or Failure(f"the dataset is {checked.state}", "submit it again")
        raise InputError(recording, error.cause, error.hint)
    return checked.id


def _files(recording: Path) -> list[tuple[Path, str | None]]:
    """Files to send with their names there; None: an archive."""
    if recording.is_file():
        if not recording.name.lower().endswith(_ARCHIVES):
            mend = f"give a folder, a bag, or one of {', '.join(_ARCHIVES)}"
            raise InputError(recording, "is no archive", mend)
        return [(recording, None)]
    paths = sorted(path for path in recording.rglob("*") if path.is_file())
    inside = [(path, path.relative_to(recording).as_posix()) for path in paths]
    plain = [
        (path, name) for path, name in inside if not any(part.startswith(".") for part in name.split("/"))
    ]
    if not plain:
        raise InputError(recording, "holds no files", "give the folder of a recording")
    return [(path, name) for path, name in plain]


def watch(client: Client, job_id: str, display: Display) -> Job:
    """The job, once it has ended; how far it is, is shown meanwhile."""
    shown = ""
    while True:
        job = client.get(_path(job_id), server_responses.job)
        if job.state not in BUSY:
            display.clear()
            return job
        for index, stage in enumerate(job.stages):
            if stage.state == "running":
                if stage.name != shown:
                    display.stage(stage.name, index, len(job.stages))
                    shown = stage.name
                if stage.total:
                    display.progress(stage.what, stage.done, stage.total)
        client.pause()


def _path(job_id: str) -> str:
    return f"/v1/jobs/{quote(job_id, safe='')}"


def _raise_unless_done(job: Job) -> None:
    if job.state != "done":
        error = job.error or Failure(job.state, "restart it to continue")
        raise LvbaError(f"{job.id} {job.state}: {error.cause}; {error.hint}")


def jobs(arguments: argparse.Namespace, client: Client, display: Display) -> None:
    """One line a job."""
    query = {"state": arguments.state} if arguments.state else {}
    for job in client.every("/v1/jobs", server_responses.job, query):
        sys.stdout.write(
            f"{job.id}  {job.state:<9} {_percent(job):>4}  {job.created[:19]}  {printable(job.name)}\n"
        )


def status(arguments: argparse.Namespace, client: Client, display: Display) -> None:
    """State, stages and error of a job."""
    if arguments.json:
        # as JSON it holds no letter that a terminal would obey
        sys.stdout.write(json.dumps(client.get(_path(arguments.job)), indent=1) + "\n")
        return
    job = client.get(_path(arguments.job), server_responses.job)
    left = f", {clock_text(job.eta_s)} left" if job.eta_s is not None else ""
    place = f", {job.position} before it" if job.state == "queued" else ""
    sys.stdout.write(f"{printable(job.name)}: {job.state} {_percent(job)}{left}{place}\n")
    for stage in job.stages:
        seconds = "" if stage.seconds is None else f"{stage.seconds:.1f} s"
        reused = "reused" if stage.reused else ""
        sys.stdout.write(f"  {stage.name:<24} {stage.state:<8} {seconds:>10} {reused}".rstrip() + "\n")
    if job.error:
        sys.stdout.write(f"  {job.error.cause}\n  {job.error.hint}\n")


def _percent(job: Job) -> str:
    return f"{int(job.progress * 100)}%"


def logs(arguments: argparse.Namespace, client: Client, display: Display) -> None:
    """What a job has said; with --follow also what it will say."""
    start = 0
    while True:
        piece = client.get(f"{_path(arguments.job)}/logs", server_responses.log_piece, {"from": start})
        sys.stdout.write(piece.text)
        sys.stdout.flush()
        more = start < piece.next < piece.size
        start = piece.next
        if not more and (piece.ended or not arguments.follow):
            return
        if not more:
            client.pause()


def cancel(arguments: argparse.Namespace, client: Client, display: Display) -> None:
    """Stop a job."""
    job = client.post(f"{_path(arguments.job)}/cancel", None, server_responses.job)
    sys.stdout.write(f"{job.state}\n")


def fetch(arguments: argparse.Namespace, client: Client, display: Display) -> None:
    """Get the results of a job into a folder."""
    if arguments.out is None:
        job = client.get(_path(arguments.job), server_responses.job)
        out = Path(_folder_of(job))
    else:
        out = arguments.out
    get_results(
        client, arguments.job, out, display, set(arguments.names), named_by_server=arguments.out is None
    )
    display.clear()
    sys.stdout.write(f"{out}\n")


def _folder_of(job: Job) -> str:
    """The folder that a job's results go to where none is given: its name, where that is one for a folder."""
    fits = (
        file_names.is_plain(job.name)
        and file_names.plain(job.name, "") == job.name
        and not job.name.startswith("-")
    )
    return job.name if fits and len(job.name.encode()) <= 200 else job.id


def get_results(
    client: Client,
    job_id: str,
    out: Path,
    display: Display,
    wanted_names: set[str] | None = None,
    *,
    named_by_server: bool = False,
) -> None:
    """Get results into a folder, and never anywhere else.

    wanted_names: only these; named_by_server: the folder, which then must be new or hold nothing but results
    Raises InputError: a name that is not among them, a folder that cannot be used; LvbaError: the server names places
    outside of it.
    """
    results = _results(client, job_id)
    there = {result.name for result in results}
    missing = (wanted_names or set()) - there
    if missing:
        raise InputError(min(missing), "is not among the results", "see what there is: fetch without names")
    folder = OutFolder(out, named_by_server=named_by_server)
    try:
        if named_by_server and folder.holds_more_than(there):
            raise InputError(out, "is there, and holds other things", "give --out a folder")
        wanted = [result for result in results if not wanted_names or result.name in wanted_names]
        for number, result in enumerate(wanted):
            client.download(f"{_path(job_id)}/results/{quote(result.name)}", folder, result)
            display.progress("results", number + 1, len(wanted))
    finally:
        folder.close()


def _results(client: Client, job_id: str) -> list[Result]:
    """What a job made; no name of it leads elsewhere, or is there twice."""
    results, taken = [], set[str]()
    for result in client.every(f"{_path(job_id)}/results", server_responses.result):
        try:
            file_names.take(result.name, taken)
        except InputError as error:
            raise LvbaError(_DISTRUST.format(error.where, error.problem)) from None
        if any(part.startswith(".") for part in result.name.split("/")):
            raise LvbaError(_DISTRUST.format(repr(result.name), "is hidden"))
        results.append(result)
    return results
