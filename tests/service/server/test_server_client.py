"""The command line against a server: submit, jobs, status, logs, cancel, fetch, batch."""

import json

import httpx
import pytest

from lvba.errors import InputError, LvbaError
from service.cli import client as clients
from service.cli.client import Client

PRODUCTS = ["lidar_poses.txt", "image_poses.txt", "exposures.csv", "map.ply", "config.yaml"]


def test_submitted_recording_comes_home_with_the_same_bytes(
    service, lvba, tiny_recording, tiny_result, tmp_path
):
    at = ["--server", service.url]
    done = lvba("submit", tiny_recording, "--wait", "--name", "home", *at)
    job = done.stdout.strip()
    assert job.startswith("job_")
    assert f"{job}  done" in lvba("jobs", "--state", "done", *at).stdout
    status = lvba("status", job, *at).stdout
    assert status.startswith("home: done 100%")
    assert json.loads(lvba("status", job, "--json", *at).stdout)["id"] == job
    assert "--- attempt 1" in lvba("logs", job, "--follow", *at).stdout
    lvba("fetch", job, "--out", tmp_path / "out", *at)
    for name in PRODUCTS:
        assert (tmp_path / "out" / name).read_bytes() == (tiny_result / name).read_bytes(), name
    refused = lvba("cancel", job, *at, code=1)
    assert refused.stderr.endswith("the job is done; there is nothing to cancel\n")


def test_batch_on_a_server_ends_like_one_at_home(service, lvba, tiny_recording, tmp_path):
    manifest = tmp_path / "batch.yaml"
    settings = "[refine_scans=false, refine_cameras=false]"
    manifest.write_text(f"- {{dataset: {tiny_recording}, name: plain, set: {settings}}}\n")
    lvba("batch", manifest, "--out", tmp_path / "out", "--server", service.url)
    [row] = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (row["name"], row["state"]) == ("plain", "done")
    assert (tmp_path / "out" / "plain" / "map.ply").exists()


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["submit", "nowhere"], 2, "there is no such file or folder"),
        (["status", "job_0"], 2, "there is no job 'job_0'"),
        (["fetch", "job_0", "--out", "x"], 2, "there is no job 'job_0'"),
        (["jobs", "--state", "odd"], 2, "state"),
        (["jobs", "--key-file", "/nowhere"], 2, "give --key-file a file"),
    ],
)
def test_mistakes_are_one_line(service, lvba, words, code, said):
    done = lvba(*words, "--server", service.url, code=code)
    assert said in done.stderr
    assert len(done.stderr.strip().splitlines()[-1:]) == 1
    assert "Traceback" not in done.stderr


class Flaky(httpx.BaseTransport):
    """Passes requests on, but breaks the connection or answers 503 as often as it was told to."""

    def __init__(self, *failures):
        self.inner, self.failures = httpx.HTTPTransport(), list(failures)

    def handle_request(self, request):
        failure = self.failures.pop(0) if self.failures else None
        if failure == "before":
            raise httpx.ConnectError("no line")
        answer = self.inner.handle_request(request)
        answer.read()
        if failure == "after":
            raise httpx.ReadError("the line broke")
        return httpx.Response(503) if failure == "busy" else answer


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(clients, "_WAIT_S", 0.01)
    monkeypatch.setattr(clients, "PIECE", 1000)


def test_upload_goes_on_after_every_kind_of_failure(service, tmp_path, quick):
    file = tmp_path / "data.bin"
    file.write_bytes(bytes(range(256)) * 16)
    failures = [None, "before", "busy", "after", None, "busy", "before"]
    client = Client(service.url, transport=Flaky(*failures))
    dataset = client.post("/v1/datasets", {"name": "flaky"})["id"]
    client.upload(dataset, file, "data.bin")
    [row] = client.every(f"/v1/datasets/{dataset}/files")
    assert (row["complete"], row["length"]) == (True, 4096)
    sent = len(client._http._transport.failures)
    client.upload(dataset, file, "data.bin")  # is there: only asked for
    assert sent == 0


def test_answer_that_was_lost_does_not_make_two_jobs(service, ready_dataset, quick):
    client = Client(service.url, transport=Flaky("after", "busy"))
    job = client.post(
        "/v1/jobs", {"dataset": ready_dataset, "name": "lost answer", "priority": -10}, key="lost"
    )
    named = [
        found for found in client.every("/v1/jobs", query={"limit": 3}) if found["name"] == "lost answer"
    ]
    assert [found["id"] for found in named] == [job["id"]]
    client.post(f"/v1/jobs/{job['id']}/cancel")


def test_server_that_is_not_there_is_said(quick):
    with pytest.raises(LvbaError, match="cannot be reached"):
        Client("http://127.0.0.1:9").get("/v1/jobs")
    with pytest.raises(InputError):
        Client("http://[")
