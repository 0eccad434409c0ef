"""A job service under load: many jobs, clients, listeners and uploads at once, while workers compute.

`lvba serve --jobs 2` on SQLite; 20 clients queue 200 jobs, 1,000 listeners hear their events (half of them all, half one
job's), 50 files of 4 MB arrive at once, and all the while one client asks for the state of jobs. Every job must end done,
every listener hear every end that it listens for, every file arrive with its digest: `lost` counts what did not. All
of it runs on one machine, clients and listeners too: one that has nothing to spare. Where the system lets it, all of it
goes ahead of what strangers run there meanwhile (`ahead of others`); the load average says how much that was.

    python benchmarks/bench_load.py --jobs 20 --listeners 100 --uploads 10      a smaller load
"""

import argparse
import asyncio
import base64
import hashlib
import http.client
import itertools
import json
import os
import random
import re
import subprocess
import sys
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

ROOT = Path(__file__).resolve().parent.parent
SMALL = {
    "frames": 8,
    "scans": 8,
    "length": 6.0,
    "seed": 5,
    "width": 96,
    "height": 72,
    "points_per_scan": 1500,
}
LIMITS = {"LVBA_LIMITS_QUEUED_JOBS": "100000", "LVBA_LIMITS_DISK_RESERVE_BYTES": "0"}
_PATIENCE_S = 60.0
"""Seconds after the last event in which one that is missing may still come."""
BETWEEN_S = 0.02
"""Seconds between two status calls."""


@dataclass(frozen=True)
class Load:
    """How much of everything. refine: jobs solve for poses; False: they color the map, and are over sooner"""

    jobs: int = 200
    refine: bool = True
    clients: int = 20
    listeners: int = 1000
    uploads: int = 50
    upload_bytes: int = 4 << 20
    workers: int = 2


def run(load: Load = Load(), seconds: float = 30.0, *, first: bool = True) -> dict[str, Any]:
    """Figures of the whole, and a row for each kind of call in each phase, most of which last for so many seconds.

    first: go ahead of what others run on this machine, where that is possible
    """
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        recording = _recording(work / "recording")
        server = _Server(work / "data", load.workers)
        try:
            ahead = first and _prefer(server.process.pid)
            if ahead:
                threading.Thread(target=_prefer_jobs, args=(server.process,), daemon=True).start()
            return {
                "name": "load",
                **asdict(load),
                "ahead of others": ahead,
                **_measure(server, recording, load, seconds, ahead),
            }
        finally:
            server.stop()


def _prefer(pid: int) -> bool:
    """Have the system prefer a process, the first of its session, to others and to other sessions, if it lets us."""
    try:
        os.setpriority(os.PRIO_PROCESS, pid, -10)
        Path(f"/proc/{pid}/autogroup").write_text("-10\n")
    except OSError:
        return False
    return True


def _prefer_jobs(server: "subprocess.Popen[bytes]") -> None:
    """Have the system treat the jobs of the service as it treats the service itself."""
    while server.poll() is None:
        for entry in Path("/proc").glob("[0-9]*/stat"):
            with suppress(OSError):
                if int(entry.read_text().rsplit(")", 1)[1].split()[1]) == server.pid:
                    entry.with_name("autogroup").write_text("-10\n")
        time.sleep(0.3)


def _prefer_me() -> None:
    os.setsid()
    _prefer(os.getpid())


def _measure(server: "_Server", recording: Path, load: Load, seconds: float, ahead: bool) -> dict[str, Any]:
    dataset = _upload_recording(server.url, recording)
    calls, memory = _Calls(server.url, ahead), _Memory(server.process.pid)
    first = _submit(server.url, dataset, "first", load.refine)
    _until_ended(server.url, [first])
    calls.phase("nothing else", [first], seconds / 5)
    memory.mark("after the first job")
    began = time.perf_counter()
    with ThreadPoolExecutor(load.clients) as clients:
        names = [f"n{number}" for number in range(load.jobs)]
        jobs = list(clients.map(lambda name: _submit(server.url, dataset, name, load.refine), names))
    queued_s = time.perf_counter() - began
    calls.phase("two compute", jobs, seconds)
    listening = _Listening(server.url, jobs, load.listeners)
    calls.phase("and listeners", jobs, seconds)
    memory.mark("with listeners")
    with ThreadPoolExecutor(max(1, load.uploads)) as senders:
        sent = [
            senders.submit(_upload_one, server.url, number, load.upload_bytes)
            for number in range(load.uploads)
        ]
        while not all(one.done() for one in sent):
            calls.phase("and uploads", jobs, min(1.0, seconds))
    memory.mark("after uploads")
    calls.phase("and listeners, later", jobs, seconds)
    _until_ended(server.url, jobs[: len(jobs) // 2])
    memory.mark("after half of the jobs")
    states = _until_ended(server.url, jobs)
    all_s = time.perf_counter() - began
    memory.mark("after all jobs")
    return {
        "lost_jobs": sum(state != "done" for state in states),
        "lost_uploads": sum(not one.result() for one in sent),
        "lost_events": listening.lost(),
        "seconds_to_queue_all": queued_s,
        "seconds_to_the_end_of_all": all_s,
        **{f"memory in MB {when}": size for when, size in memory.marks.items()},
        "load_average": list(os.getloadavg()),
        "rows": calls.rows(),
    }


def _recording(folder: Path) -> Path:
    from lvba import simulate

    simulate.simulate("street", folder, **SMALL)
    return folder


class _Server:
    """`lvba serve` as a process of its own."""

    def __init__(self, data: Path, workers: int) -> None:
        words = [sys.executable, "-m", "service.cli", "serve", "--data", str(data), "--port", "0"]
        words += ["--jobs", str(workers), "--threads", "1"]
        log = data.with_name("serve.log")
        with log.open("wb") as stream:
            environment = {**os.environ, **LIMITS, "PYTHONPATH": str(ROOT)}
            self.process = subprocess.Popen(
                words, stdout=stream, stderr=stream, env=environment, start_new_session=True
            )
        while not (match := re.search(r"serving (http://\S+)", log.read_text())):
            if self.process.poll() is not None:
                raise RuntimeError(log.read_text())
            time.sleep(0.05)
        self.url = match[1]

    def stop(self) -> None:
        self.process.terminate()
        self.process.wait(60)


class _Memory:
    """Of the server's process, MB."""

    def __init__(self, pid: int) -> None:
        self._status = Path(f"/proc/{pid}/status")
        self.marks: dict[str, int] = {}

    def mark(self, when: str) -> None:
        """Write it down."""
        match = re.search(r"VmRSS:\s+(\d+)", self._status.read_text())
        self.marks[when] = int(match[1]) // 1024 if match else 0


class _Calls:
    """Status calls, one after the other, timed in a process that does nothing else."""

    def __init__(self, url: str, ahead: bool) -> None:
        self._url, self._pool = url, get_context("spawn").Pool(1, _prefer_me if ahead else None)
        self._seconds: dict[tuple[str, str], list[float]] = {}

    def phase(self, name: str, jobs: list[str], seconds: float) -> None:
        """Ask for so long."""
        for kind, times in self._pool.apply(timed_calls, (self._url, jobs, seconds)).items():
            self._seconds.setdefault((name, kind), []).extend(times)

    def rows(self) -> list[dict[str, Any]]:
        """Of each kind of call in each phase."""
        self._pool.terminate()
        return [
            {"while": name, "call": kind, "calls": len(times), **_percentiles(times)}
            for (name, kind), times in self._seconds.items()
            if times
        ]


def _percentiles(times: list[float]) -> dict[str, float]:
    ordered = [1e3 * seconds for seconds in sorted(times)]
    parts = {f"p{part} ms": ordered[len(ordered) * part // 100] for part in (50, 90, 99)}
    return {**parts, "longest ms": ordered[-1]}


def timed_calls(url: str, jobs: list[str], seconds: float) -> dict[str, list[float]]:
    """Seconds of each call for the state of a job, and of each for a page of jobs."""
    connection = _connection(url)
    times: dict[str, list[float]] = {"job": [], "list of 50": []}
    end = time.perf_counter() + seconds
    for number in itertools.count():
        kind = "list of 50" if number % 20 == 19 else "job"
        path = "/v1/jobs?limit=50" if kind != "job" else f"/v1/jobs/{random.choice(jobs)}"
        began = time.perf_counter()
        connection.request("GET", path)
        answer = connection.getresponse()
        answer.read()
        times[kind].append(time.perf_counter() - began)
        if answer.status != 200:
            raise RuntimeError(f"{path}: {answer.status}")
        if time.perf_counter() > end:
            connection.close()
            break
        time.sleep(BETWEEN_S)
    return times


class _Listening:
    """Listeners in a process of their own: the even ones hear all jobs, the odd ones one job each."""

    def __init__(self, url: str, jobs: list[str], count: int) -> None:
        self._over = Path(tempfile.mkstemp(prefix="listening-")[1])
        self._pool = get_context("spawn").Pool(1)
        self._missing = self._pool.apply_async(listen, (url, jobs, count, str(self._over)))
        time.sleep(0.005 * count)  # until all are there

    def lost(self) -> int:
        """Ends that were not heard, some time after the last of them."""
        self._over.unlink()
        with self._pool:
            return int(self._missing.get())


def listen(url: str, jobs: list[str], count: int, over: str) -> int:
    """How many ends of jobs were not heard by those who should have. over: this file is there as long as jobs run"""
    return asyncio.run(_listen(url, jobs, count, Path(over)))


async def _listen(url: str, jobs: list[str], count: int, over: Path) -> int:
    wanted = [jobs if number % 2 == 0 else [jobs[number // 2 % len(jobs)]] for number in range(count)]
    async with asyncio.TaskGroup() as group:
        tasks = []
        for jobs_of_one in wanted:
            tasks.append(group.create_task(_hear(url, jobs_of_one, over)))
            await asyncio.sleep(0.002)
    return sum(task.result() for task in tasks)


async def _hear(url: str, jobs: list[str], over: Path) -> int:
    """Ends that did not come, of those waited for."""
    place = urlsplit(url)
    path = "/v1/events?after=0" if len(jobs) > 1 else f"/v1/jobs/{jobs[0]}/events"
    reader, writer = await asyncio.open_connection(place.hostname, place.port, limit=1 << 20)
    writer.write(f"GET {path} HTTP/1.1\r\nHost: {place.netloc}\r\nAccept: text/event-stream\r\n\r\n".encode())
    missing, rest, heard = set(jobs), b"", time.monotonic()
    while missing and (over.exists() or time.monotonic() < heard + _PATIENCE_S):
        data = await reader.read(1 << 16)  # the server says something every 15 s
        if not data:
            break
        *events, rest = (rest + data).split(b"\n\n")
        heard = time.monotonic() if events and b"id: " in data else heard
        missing -= {_job_of(event) for event in events if b"event: end" in event}
    writer.close()
    return len(missing)


def _job_of(event: bytes) -> str:
    return str(json.loads(event.partition(b"data: ")[2])["job"])


def _connection(url: str) -> http.client.HTTPConnection:
    place = urlsplit(url)
    return http.client.HTTPConnection(place.hostname or "", place.port, timeout=120)


def _ask(url: str, method: str, path: str, body: Any = None, headers: dict[str, str] | None = None) -> Any:
    """The JSON of an answer that must be good."""
    connection = _connection(url)
    try:
        plain = body is None or isinstance(body, bytes)
        given = body if plain else json.dumps(body).encode()
        kind = {} if plain else {"Content-Type": "application/json"}
        connection.request(method, path, given, {**kind, **(headers or {})})
        answer = connection.getresponse()
        text = answer.read()
        if answer.status >= 300:
            raise RuntimeError(f"{method} {path}: {answer.status} {text!r}")
        return json.loads(text)
    finally:
        connection.close()


def _submit(url: str, dataset: str, name: str, refine: bool) -> str:
    config = {} if refine else {"refine_scans": False, "refine_cameras": False}
    body = {"dataset": dataset, "name": name, "config": config}
    return str(_ask(url, "POST", "/v1/jobs", body, {"Idempotency-Key": name})["id"])


def _upload_recording(url: str, recording: Path) -> str:
    dataset = _ask(url, "POST", "/v1/datasets", {"name": "small"})["id"]
    for file in sorted(path for path in recording.rglob("*") if path.is_file()):
        _ask(
            url,
            "PUT",
            f"/v1/datasets/{dataset}/files/{file.relative_to(recording).as_posix()}",
            file.read_bytes(),
        )
    _ask(url, "POST", f"/v1/datasets/{dataset}/finish")
    while (state := _ask(url, "GET", f"/v1/datasets/{dataset}"))["state"] != "ready":
        if state["state"] == "invalid":
            raise RuntimeError(state["error"])
        time.sleep(0.2)
    return str(dataset)


def _upload_one(url: str, number: int, size: int) -> bool:
    """Whether a file arrived with its digest."""
    content = random.Random(number).randbytes(size)
    digest = hashlib.sha256(content).digest()
    dataset = _ask(url, "POST", "/v1/datasets", {"name": f"u{number}"})["id"]
    headers = {"Repr-Digest": f"sha-256=:{base64.b64encode(digest).decode()}:"}
    answer = _ask(url, "PUT", f"/v1/datasets/{dataset}/files/a.bin", content, headers)
    return bool(answer["complete"] and answer["received"] == size)


def _until_ended(url: str, jobs: list[str]) -> list[str]:
    states = dict.fromkeys(jobs, "")
    while left := [job for job, state in states.items() if state not in ("done", "failed", "canceled")]:
        states[left[0]] = _ask(url, "GET", f"/v1/jobs/{left[0]}")["state"]
        time.sleep(0.05 if states[left[0]] == "done" else 0.5)
    return list(states.values())


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, value in asdict(Load()).items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=int, default=value)
    results = run(Load(**vars(parser.parse_args())))
    print(json.dumps(results, indent=1))
    return int(any(results[f"lost_{what}"] for what in ("jobs", "uploads", "events")))


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    sys.exit(main())
