"""A disk that fills up and a clock that jumps under a running job: it ends done, once, with the same bytes."""

import json
import time

import pytest
from real_server import PATIENCE, Service, ended, submit, until, upload
from small_disk import small_disk
from sqlalchemy import select
from test_server_faults import assert_done_once_with_the_same_bytes, job_processes, runs

from service.datasets.intake_budget import IntakeBudget
from service.db.database import Database
from service.db.tables import Job
from service.settings import Limits, Settings
from service.system.child_process import Child
from service.system.disk_space import EXIT_DISK_FULL


@pytest.fixture
def disk_of_300_mb(tmp_path):
    with small_disk(tmp_path / "disk", "300m"):
        yield tmp_path / "disk"


def fill(folder):
    """A file that takes all that is left; it."""
    filler = folder / "filler"
    with filler.open("wb", buffering=0) as file:
        for size in (1 << 20, 1 << 12, 1):
            try:
                while True:
                    file.write(bytes(size))
            except OSError:
                continue
    return filler


def until_no_job_runs(data):
    end = time.monotonic() + PATIENCE
    while job_processes(data):
        assert time.monotonic() < end
        time.sleep(0.05)


def test_process_of_a_job_tells_of_a_full_disk_by_its_exit_code(tmp_path, tiny_recording):
    """Neither events nor log take a word there, and when the service looks there may be room again."""
    with small_disk(tmp_path / "disk", "1m"):
        folder = tmp_path / "disk"
        fill(folder)
        task = {
            "lock": folder / ".lock",
            "without_links": [],
            "out": folder / "out",
            "notes": folder / "notes",
        }
        words = ["run", str(tiny_recording), f"--out={folder / 'out'}", f"--events={folder / 'events'}"]
        child = Child(
            "service.cli.job_process", [json.dumps(task, default=str), *words], folder / "log", PATIENCE
        )
        end = time.monotonic() + PATIENCE
        while (code := child.ended()) is None and time.monotonic() < end:
            time.sleep(0.05)
    assert code == EXIT_DISK_FULL


def test_full_disk_holds_up_a_job_until_there_is_room(
    disk_of_300_mb, tiny_recording, tiny_result, on_database
):
    environment = {"LVBA_LIMITS_DISK_RESERVE_BYTES": "0"}
    service = Service(
        disk_of_300_mb / "data", *on_database, environment=environment
    )  # SQLite is on the disk too
    dataset = upload(service.http, tiny_recording)
    with service.held("visual"):
        job_id = submit(service.http, dataset)["id"]
        until(service.http, f"/v1/jobs/{job_id}", runs("visual"))
        behind = submit(service.http, dataset)["id"]
        assert service.http.get(f"/v1/jobs/{behind}").json()["error"] is None
        filler = fill(disk_of_300_mb)
    until_no_job_runs(service.data)
    error = service.http.get(f"/v1/jobs/{behind}").json()["error"]
    assert (error["code"], error["cause"]) == (
        "disk-full",
        "waits for disk space: 0 bytes are free, 67.1 MB are needed",
    )
    unready = service.http.get("/readyz")
    assert (unready.status_code, unready.json()["code"]) == (503, "unavailable")
    assert "67.1 MB are needed" in unready.json()["detail"]
    assert service.http.get("/readyz?exclude=disk").json() == {"status": "ready"}
    with pytest.raises(OSError, match="No space left"):  # nor is anything unpacked there
        IntakeBudget(disk_of_300_mb, Limits(disk_reserve_bytes=0)).add_file("scan")
    if on_database:  # SQLite could not note it on a full disk
        waiting = until(service.http, f"/v1/jobs/{job_id}", lambda job: job["state"] == "queued")
        assert waiting["error"]["code"] == "disk-full"
        assert waiting["attempts"][0]["outcome"] == "crashed"
        assert waiting["attempts"][0]["message"] == "the disk was full"
    assert service.http.post("/v1/jobs", json={"dataset": dataset}).status_code in (503, 507)
    filler.unlink()
    assert service.http.get("/readyz").json() == {"status": "ready"}
    job = ended(service.http, job_id)
    service.http.post(f"/v1/jobs/{behind}/cancel")
    assert job["error"] is None
    assert len(job["attempts"]) == 2
    assert_done_once_with_the_same_bytes(service.http, job, tiny_result)
    assert service.stop() == 0


def beats(url, job_id):
    """How often the lease of a job was renewed."""
    database = Database(url)
    try:
        with database.read() as session:
            return session.scalars(select(Job.heartbeat).where(Job.id == job_id)).one()
    finally:
        database.close()


def until_renewed(url, job_ids, times):
    """Until the lease of each job was renewed so often."""
    first, end = {job_id: beats(url, job_id) for job_id in job_ids}, time.monotonic() + PATIENCE
    while any(beats(url, job_id) < first[job_id] + times for job_id in job_ids):
        assert time.monotonic() < end
        time.sleep(0.1)


def test_clock_that_jumps_by_an_hour_moves_no_job(tiny_recording, tiny_result, tmp_path, on_database):
    clocks = [tmp_path / "clock-0", tmp_path / "clock-1"]
    environments = [{"LVBA_TEST_CLOCK": str(clock), "LVBA_LEASE_S": "8"} for clock in clocks]
    services = [
        Service(tmp_path / "data", *on_database, environment=environment) for environment in environments
    ]
    one, two = services
    url = Settings(data=one.data, database="".join(on_database[1:])).database_url
    dataset = upload(one.http, tiny_recording)
    with one.held("lidar"):
        jobs = [submit(one.http, dataset, name=f"n{number}")["id"] for number in range(2)]
        for job_id in jobs:
            until(one.http, f"/v1/jobs/{job_id}", runs("lidar"))
        for offsets in (("3600", "-3600"), ("-7200", "0")):
            for clock, offset in zip(clocks, offsets):
                clock.write_text(offset)
            until_renewed(url, jobs, 2)
        assert len(job_processes(one.data)) == 2
        quick = {"refine_scans": False, "refine_cameras": False}
        jobs.append(submit(two.http, dataset, name="between", config=quick)["id"])
    found = [ended(two.http, job_id) for job_id in jobs]
    for job in found:
        assert len(job["attempts"]) == 1
        assert job["state"] == "done"
    assert_done_once_with_the_same_bytes(one.http, found[0], tiny_result)
    for service in services:
        assert service.stop() == 0
