"""The last stage of a job makes what its page shows: it is seen, tried again, and never takes the result with it."""

import os
import signal

from real_server import Service, ended, submit, until, upload
from test_server_faults import assert_done_once_with_the_same_bytes, job_processes, runs


def test_killed_there_only_that_is_done_again(tiny_recording, tiny_result, tmp_path):
    service = Service(tmp_path / "data")
    job_id = submit(service.http, upload(service.http, tiny_recording))["id"]
    with service.held("viewer"):
        shown = until(service.http, f"/v1/jobs/{job_id}", runs("viewer"))
        assert shown["state"] == "running"
        assert shown["progress"] < 1.0
        assert [stage["name"] for stage in shown["stages"] if stage["state"] != "done"] == ["viewer"]
        [child] = job_processes(service.data)
        os.kill(child, signal.SIGKILL)
    job = ended(service.http, job_id)
    assert [attempt["outcome"] for attempt in job["attempts"]] == ["crashed", "done"]
    assert {stage["reused"] for stage in job["stages"][1:-2]} == {True}
    assert_done_once_with_the_same_bytes(service.http, job, tiny_result)
    results = {row["name"] for row in service.http.get(f"/v1/jobs/{job_id}/results").json()["items"]}
    assert "cloud/metadata.json" in results
    assert service.stop() == 0


def test_killed_there_every_time_the_result_stands_without_it(tiny_recording, tiny_result, tmp_path):
    service = Service(tmp_path / "data", environment={"LVBA_LIMITS_ATTEMPTS": "2"})
    job_id = submit(service.http, upload(service.http, tiny_recording))["id"]
    with service.held("viewer"):
        for attempt in (1, 2):
            until(
                service.http,
                f"/v1/jobs/{job_id}",
                lambda job, number=attempt: len(job["attempts"]) == number and runs("viewer")(job),
            )
            [child] = job_processes(service.data)
            os.kill(child, signal.SIGKILL)
        job = ended(service.http, job_id)
    assert [attempt["outcome"] for attempt in job["attempts"]] == ["crashed", "done"]
    assert job["attempts"][1]["message"] == "nothing for the page: the process was killed (SIGKILL)"
    assert job["stages"][-1]["state"] == "failed"
    assert job["summary"]["psnr_after"]
    assert_done_once_with_the_same_bytes(service.http, job, tiny_result)
    assert service.stop() == 0


def test_what_fails_there_is_a_line_in_the_log(tiny_recording, tiny_result, tmp_path):
    service = Service(tmp_path / "data")
    job_id = submit(service.http, upload(service.http, tiny_recording))["id"]
    with service.held("viewer"):
        until(service.http, f"/v1/jobs/{job_id}", runs("viewer"))
        in_the_way = service.data / "jobs" / job_id / "out" / "cloud"
        in_the_way.write_text("a file where a folder is to be")
    job = ended(service.http, job_id)
    assert_done_once_with_the_same_bytes(service.http, job, tiny_result)
    log = service.http.get(f"/v1/jobs/{job_id}/logs").json()["text"]
    assert "warning: there is nothing for a viewer: " in log
    assert service.stop() == 0
