"""A service whose runs a cluster computes, and all that can die of it: each job ends done, once, with the same bytes."""

import signal
import sys
from pathlib import Path

import pytest
from real_server import Service, ended, postgres_or_skip, submit, until, upload
from test_server_faults import assert_done_once_with_the_same_bytes, job_processes, runs

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "workers"))

from real_cluster import Cluster, tls_files


@pytest.fixture
def tls_cluster(tmp_path):
    folder = tmp_path / "cluster"
    folder.mkdir()
    running = Cluster(folder, tls_files(folder))
    running.start_worker()
    yield running
    running.end()


def start_again(running):
    running.processes.clear()
    running.start_scheduler()
    running.start_worker()


def test_service_scheduler_and_worker_killed_at_once(tls_cluster, tiny_recording, tiny_result, tmp_path):
    service = Service(tmp_path / "data", *tls_cluster.on())
    dataset = upload(service.http, tiny_recording)
    with tls_cluster.gates.held("visual"):
        job_id = submit(service.http, dataset)["id"]
        until(service.http, f"/v1/jobs/{job_id}", runs("visual"))
        for process in (*tls_cluster.processes, service.process):
            process.send_signal(signal.SIGKILL)
        tls_cluster.kill_all()
        service.kill()
    start_again(tls_cluster)
    service.start()
    job = ended(service.http, job_id)
    assert [attempt["outcome"] for attempt in job["attempts"]] == ["lost", "done"]
    assert_done_once_with_the_same_bytes(service.http, job, tiny_result)
    assert service.stop() == 0


def test_scheduler_and_worker_killed_beneath_a_service_and_then_its_database(
    tls_cluster, tiny_recording, tiny_result, tmp_path
):
    postgres = postgres_or_skip()
    try:
        options = ["--database", postgres.new_database(), *tls_cluster.on()]
        service = Service(tmp_path / "data", *options, environment={"LVBA_LEASE_S": "120"})
        dataset = upload(service.http, tiny_recording)
        with tls_cluster.gates.held("visual"):
            job_id = submit(service.http, dataset)["id"]
            until(service.http, f"/v1/jobs/{job_id}", runs("visual"))
            tls_cluster.kill_all()
            postgres.kill()
        assert len(job_processes(service.data)) == 1
        start_again(tls_cluster)
        postgres.start()
        job = ended(service.http, job_id)
        assert len(job["attempts"]) == 1
        assert_done_once_with_the_same_bytes(service.http, job, tiny_result)
        assert service.stop() == 0
    finally:
        postgres.stop()
