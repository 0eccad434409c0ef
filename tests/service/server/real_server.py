"""A real service: `lvba serve` as a process of its own, asked over HTTP; and a real PostgreSQL."""

import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import httpx
import pytest
from forked import ForkedProcess
from gates import Gates

from lvba import simulate
from service.db import keys
from service.db.database import Database

PATIENCE = 120.0


class Service:
    """One `lvba serve` over a data folder; it can be killed and started again.

    Forked from a process that has imported it, and so are its jobs, but for `below`. Services of other tests (of the
    page, of deployments, of the wheel) are started as users start them, with their jobs.
    """

    def __init__(self, data, *options, environment=None, below=(), forks_jobs=True):
        """below: a command line that goes before, such as one that sets limits; forks_jobs: False where it matters
        whose children they are"""
        self.data, self.options, self.below, self.forks_jobs = data, options, below, forks_jobs
        # services over the same folder share their gates
        self.gates = Gates(data.with_name(f"{data.name}-gates"))
        self.environment = {**os.environ, **self.gates.environment, **(environment or {})}
        self.log = data.with_name(f"{data.name}-{id(self):x}.log")
        self.process = None
        self.start()

    def start(self):
        words = ["serve", "--data", str(self.data), "--port", "0", "--threads", "2", *map(str, self.options)]
        with self.log.open("ab") as log:
            begins = log.tell()
            if self.below:
                command = [*self.below, sys.executable, "-m", "service.cli", *words]
                self.process = subprocess.Popen(
                    command, stdout=log, stderr=log, env=self.environment, start_new_session=True
                )
            else:
                self.process = ForkedProcess(words, self.log, self.environment, self.forks_jobs)
        until = time.monotonic() + PATIENCE
        while time.monotonic() < until:
            found = re.search(r"serving (http://\S+)", self.log.read_text()[begins:])
            if found:
                self.url = found[1]
                self.http = httpx.Client(base_url=self.url, timeout=60)
                return
            assert self.process.poll() is None, self.log.read_text()
            time.sleep(0.05)
        raise AssertionError(self.log.read_text())

    def held(self, stage):
        """Jobs that come to this stage stay in it until the block ends."""
        return self.gates.held(stage)

    def kill(self):
        """As if the power went."""
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()
        self.http.close()

    def stop(self):
        """As its administrator stops it."""
        if self.process.poll() is None:
            self.process.terminate()
            self.process.wait(30)
        self.http.close()
        return self.process.returncode

    def as_key(self, key):
        """A client that sends this key."""
        return httpx.Client(base_url=self.url, timeout=60, headers={"Authorization": f"Bearer {key}"})

    def key(self, owner, scopes=("read", "submit"), days=None):
        """A new key."""
        database = Database(f"sqlite:///{self.data / 'lvba.sqlite'}")
        try:
            return keys.create(database, owner, tuple(scopes), days=days)
        finally:
            database.close()


def upload(http, recording, name="tiny"):
    """Id of a ready dataset with the files of a folder."""
    dataset = http.post("/v1/datasets", json={"name": name}).raise_for_status().json()["id"]
    for file in sorted(p for p in recording.rglob("*") if p.is_file()):
        path = file.relative_to(recording).as_posix()
        http.put(f"/v1/datasets/{dataset}/files/{path}", content=file.read_bytes()).raise_for_status()
    http.post(f"/v1/datasets/{dataset}/finish").raise_for_status()
    found = until(
        http, f"/v1/datasets/{dataset}", lambda row: row["state"] not in ("uploading", "validating")
    )
    assert found["state"] == "ready", found
    return dataset


def submit(http, dataset, key=None, **more):
    """The job."""
    headers = {"Idempotency-Key": key} if key else {}
    answer = http.post("/v1/jobs", json={"dataset": dataset, **more}, headers=headers)
    assert answer.status_code in (200, 201), answer.text
    return answer.json()


def until(http, path, condition, patience=PATIENCE):
    """What a path answers as soon as the condition holds."""
    end, pause = time.monotonic() + patience, 0.02
    while time.monotonic() < end:
        try:
            found = http.get(path).raise_for_status().json()
        except httpx.TransportError:
            time.sleep(0.1)
            continue
        if condition(found):
            return found
        time.sleep(pause)
        pause = min(1.5 * pause, 0.3)  # asking takes the processor from what is waited for
    raise AssertionError(found)


def ended(http, job_id):
    """The job, once it has ended."""
    return until(http, f"/v1/jobs/{job_id}", lambda job: job["state"] in ("done", "failed", "canceled"))


def make_recording(folder):
    """A recording so small that a run takes seconds."""
    simulate.simulate(
        "street", folder, frames=8, scans=8, length=6.0, seed=6, width=96, height=72, points_per_scan=2500
    )
    return folder


class Postgres:
    """A PostgreSQL cluster of its own, on a socket in a folder of its own."""

    def __init__(self):
        self.folder = Path(tempfile.mkdtemp(prefix="lvba-pg-", dir="/tmp"))
        # it refuses to run as root
        self.user = "nobody" if os.getuid() == 0 else None
        if self.user:
            shutil.chown(self.folder, self.user)
        self.programs = _programs()
        self._run("initdb", "-D", self.folder / "data", "-U", "lvba", "--auth=trust", "--no-sync")
        self.count = 0
        self.start()

    def _run(self, name, *words):
        subprocess.run(
            [str(self.programs / name), *map(str, words)],
            check=True, user=self.user, cwd=self.folder, stdout=subprocess.DEVNULL,
        )  # fmt: skip

    def start(self):
        options = f"-c listen_addresses='' -k {self.folder} -c fsync=off"
        self._run(
            "pg_ctl", "-D", self.folder / "data", "-w", "-l", self.folder / "log", "-o", options, "start"
        )

    def kill(self):
        """SIGKILL to the server; what it has promised must be there after the next start."""
        pid = int((self.folder / "data" / "postmaster.pid").read_text().split()[0])
        os.kill(pid, signal.SIGKILL)
        end = time.monotonic() + 10
        while time.monotonic() < end and _alive(pid):
            time.sleep(0.05)

    def stop(self):
        self._run("pg_ctl", "-D", self.folder / "data", "-m", "immediate", "stop")
        shutil.rmtree(self.folder, ignore_errors=True)

    def new_database(self):
        """URL of an empty one."""
        self.count += 1
        name = f"lvba{self.count}"
        self._run("createdb", "-h", self.folder, "-U", "lvba", name)
        return f"postgresql://lvba@/{name}?host={self.folder}"


def _programs():
    """Folder of PostgreSQL's programs; Debian does not have it on the path."""
    on_path = [Path(found)] if (found := shutil.which("initdb")) else []
    candidates = [*on_path, *sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"), reverse=True)]
    return next((found.resolve().parent for found in candidates), None)


def _alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def postgres_or_skip():
    """A running cluster; skips where PostgreSQL is not installed."""
    if _programs() is None:
        pytest.skip(
            "PostgreSQL is not installed: there is no initdb on the path or below /usr/lib/postgresql"
        )
    return Postgres()
