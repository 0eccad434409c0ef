"""What dies while a job runs: the service, one of two, the database. Each job ends done, once, with the same bytes."""

import json
import os
import signal
import sqlite3
import time
from contextlib import closing
from pathlib import Path

import httpx
from real_server import PATIENCE, Service, ended, submit, until, upload

PRODUCTS = ["lidar_poses.txt", "image_poses.txt", "exposures.csv", "map.ply", "config.yaml"]


def job_processes(data):
    """Processes of jobs in this data folder: what they say goes into a file there."""
    found = []
    for stdout in Path("/proc").glob("[0-9]*/fd/1"):
        try:
            said = stdout.readlink()
        except OSError:
            continue
        if said.is_relative_to(data / "jobs"):
            found.append(int(stdout.parts[2]))
    return found


def runs(name):
    """Whether the stage of this name runs."""
    return lambda job: any(stage["name"] == name and stage["state"] == "running" for stage in job["stages"])


def assert_done_once_with_the_same_bytes(http, job, result):
    assert job["state"] == "done", json.dumps(job["error"])
    outcomes = [attempt["outcome"] for attempt in job["attempts"]]
    assert outcomes[-1] == "done"
    assert outcomes.count("done") == 1
    ends = [attempt["finished"] for attempt in job["attempts"]]
    begins = [attempt["started"] for attempt in job["attempts"]]
    assert all(end <= begin for end, begin in zip(ends, begins[1:]))
    for name in PRODUCTS:
        assert http.get(f"/v1/jobs/{job['id']}/results/{name}").content == (result / name).read_bytes(), name


def test_killed_service_goes_on_from_the_finished_stages(tiny_recording, tiny_result, tmp_path, on_database):
    service = Service(tmp_path / "data", *on_database, forks_jobs=False)
    job_id = submit(service.http, upload(service.http, tiny_recording))["id"]
    with service.held("visual"):
        until(service.http, f"/v1/jobs/{job_id}", runs("visual"))
        [child] = job_processes(service.data)
        service.kill()
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end and job_processes(service.data):
            time.sleep(0.05)
    assert job_processes(service.data) == [], f"{child} lives on without a service"
    service.start()
    job = ended(service.http, job_id)
    assert [attempt["outcome"] for attempt in job["attempts"]] == ["lost", "done"]
    assert next(stage for stage in job["stages"] if stage["name"] == "lidar")["reused"]
    assert_done_once_with_the_same_bytes(service.http, job, tiny_result)
    assert service.stop() == 0


def test_stopped_service_gives_its_job_back_and_a_killed_process_is_tried_again(
    tiny_recording, tiny_result, tmp_path
):
    service = Service(tmp_path / "data")
    job_id = submit(service.http, upload(service.http, tiny_recording))["id"]
    with service.held("lidar"):
        until(service.http, f"/v1/jobs/{job_id}", runs("lidar"))
        assert service.stop() == 0
        service.start()
        until(service.http, f"/v1/jobs/{job_id}", runs("lidar"))
        [child] = job_processes(service.data)
        os.kill(child, signal.SIGKILL)
    job = ended(service.http, job_id)
    assert [attempt["outcome"] for attempt in job["attempts"]] == ["lost", "crashed", "done"]
    assert job["attempts"][1]["message"] == "the process was killed (SIGKILL)"
    assert_done_once_with_the_same_bytes(service.http, job, tiny_result)
    service.stop()


def test_two_services_on_one_postgres_of_which_one_is_killed_and_then_the_database(
    postgres, tiny_recording, tiny_result, tmp_path
):
    options = ["--database", postgres.new_database()]
    environment = {"LVBA_LEASE_S": "30"}
    one, two = (Service(tmp_path / "data", *options, environment=environment) for _ in range(2))
    dataset = upload(one.http, tiny_recording)
    with one.held("lidar"):
        jobs = [submit(one.http, dataset, name=f"n{i}")["id"] for i in range(2)]
        for job_id in jobs:
            until(two.http, f"/v1/jobs/{job_id}", runs("lidar"))
        assert len(job_processes(one.data)) == 2
        one.kill()
    postgres.kill()
    with httpx.Client(base_url=two.url) as http:
        answer = http.get("/v1/jobs")
        assert answer.status_code == 503
        assert answer.json()["code"] == "unavailable"
    postgres.start()
    for job_id in jobs:
        assert_done_once_with_the_same_bytes(two.http, ended(two.http, job_id), tiny_result)
    attempts = [len(two.http.get(f"/v1/jobs/{job_id}").json()["attempts"]) for job_id in jobs]
    assert sorted(attempts) == [1, 2]
    assert two.stop() == 0


def freeze_between_writes(service):
    """Stops a service where it holds no lock: SQLite lets nobody write while one is stopped within a write."""
    for _ in range(100):
        service.process.send_signal(signal.SIGSTOP)
        with closing(sqlite3.connect(service.data / "lvba.sqlite", timeout=2.0)) as database:
            try:
                database.execute("BEGIN IMMEDIATE")
                database.rollback()
                return
            except sqlite3.OperationalError:
                service.process.send_signal(signal.SIGCONT)
        time.sleep(0.05)
    raise AssertionError("the service never stops writing")


def test_frozen_service_is_taken_over_and_its_process_stops_by_itself(tiny_recording, tiny_result, tmp_path):
    one, two = (
        Service(tmp_path / "data", environment={"LVBA_LEASE_S": "4"}, forks_jobs=False) for _ in range(2)
    )
    dataset = upload(one.http, tiny_recording)
    with one.held("lidar"):
        job_id = submit(one.http, dataset)["id"]
        until(one.http, f"/v1/jobs/{job_id}", runs("lidar"))
        [child] = job_processes(one.data)
        parent = int(Path(f"/proc/{child}/stat").read_text().rsplit(")", 1)[1].split()[1])
        holder, other = (one, two) if parent == one.process.pid else (two, one)
        freeze_between_writes(holder)
        until(other.http, f"/v1/jobs/{job_id}", lambda job: len(job["attempts"]) > 1)
        holder.process.send_signal(signal.SIGCONT)
    job = ended(other.http, job_id)
    assert job["attempts"][0]["outcome"] == "lost"
    assert_done_once_with_the_same_bytes(other.http, job, tiny_result)
    for service in (one, two):
        assert service.stop() == 0
