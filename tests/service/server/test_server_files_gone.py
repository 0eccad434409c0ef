"""Files of a job that disappear while it runs, or change after it: the job says so, and the queue continues."""

import errno
import io
import os
import shutil
import zipfile

import pytest
from real_server import Service, ended, submit, until, upload
from test_server_faults import job_processes, runs

# what is gone, and what a job may be then: it continues where nothing is lost by it
VICTIMS = {
    ("log.txt", "config.yaml", "out/stages/.lock"): ("done",),
    ("events-1.jsonl", ".lock", "results.json"): ("done",),
    ("out/stages/lidar-*",): ("done", "failed"),
    ("out/stages",): ("done", "failed"),
    ("out",): ("done", "failed"),
    (".",): ("done", "failed"),
}
QUICK = {"refine_scans": False, "refine_cameras": False}


@pytest.fixture(scope="module")
def wounded(tiny_recording, tmp_path_factory):
    """A service of its own, whose files are taken away, and a dataset."""
    running = Service(tmp_path_factory.mktemp("wounded") / "data")
    yield running, upload(running.http, tiny_recording)
    running.stop()


def remove_folder(folder):
    """Remove a folder into which a job is still writing: what it adds in the meantime goes with it."""
    while folder.exists():
        try:
            shutil.rmtree(folder)
        except OSError as error:
            if error.errno not in (errno.ENOENT, errno.ENOTEMPTY):
                raise


def remove(folder, pattern):
    for path in [folder] if pattern == "." else list(folder.glob(pattern)):
        if path.is_dir():
            remove_folder(path)
        else:
            path.unlink()


def test_every_file_of_a_running_job_may_disappear(wounded):
    service, dataset = wounded
    for victims, states in VICTIMS.items():
        with service.held("map"):
            job = submit(service.http, dataset, config=QUICK)
            until(service.http, f"/v1/jobs/{job['id']}", runs("map"))
            for victim in victims:
                remove(service.data / "jobs" / job["id"], victim)
        job = ended(service.http, job["id"])
        assert job["state"] in states, (victims, job)
        assert len(job["attempts"]) == 1, (victims, job["attempts"])
        if job["state"] == "failed":
            assert job["error"]["cause"] not in ("", "it said nothing"), victims
            assert job["error"]["hint"]
        else:
            assert service.http.get(f"/v1/jobs/{job['id']}/results/map.ply").status_code == 200

        assert service.http.get(f"/v1/jobs/{job['id']}/logs").status_code == 200
    assert "Traceback" not in service.log.read_text()


def test_what_the_last_stage_loses_fails_the_job_with_its_name_and_a_restart_mends_it(wounded):
    service, dataset = wounded
    with service.held("viewer"):
        job = submit(service.http, dataset, config=QUICK)["id"]
        until(service.http, f"/v1/jobs/{job}", runs("viewer"))
        (service.data / "jobs" / job / "out" / "exposures.csv").unlink()
    found = ended(service.http, job)
    assert (found["state"], found["error"]["code"]) == ("failed", "files")
    assert found["error"]["cause"] == "OUT/exposures.csv: has disappeared while the job ran"
    service.http.post(f"/v1/jobs/{job}/restart").raise_for_status()
    assert ended(service.http, job)["state"] == "done"


def test_job_whose_folder_has_gone_is_canceled(wounded):
    service, dataset = wounded
    with service.held("lidar"):
        job = submit(service.http, dataset)["id"]
        until(service.http, f"/v1/jobs/{job}", runs("lidar"))
        remove_folder(service.data / "jobs" / job)
        service.http.post(f"/v1/jobs/{job}/cancel").raise_for_status()
        assert ended(service.http, job)["state"] == "canceled"
    assert job_processes(service.data) == []


def test_answer_of_a_check_that_disappears_makes_the_dataset_invalid(wounded, tiny_recording):
    service, _ = wounded
    made = service.http.post("/v1/datasets", json={"name": "gone"}).json()["id"]
    service.http.put(f"/v1/datasets/{made}/files/config.yaml", content=b"x: 1")
    for file in (service.data / "datasets" / made / "uploads").iterdir():
        file.unlink()
    service.http.post(f"/v1/datasets/{made}/finish").raise_for_status()
    found = until(service.http, f"/v1/datasets/{made}", lambda row: row["state"] != "validating")
    assert (found["state"], found["error"]["code"]) == ("invalid", "files")


def test_job_and_dataset_that_cannot_be_begun_fail_and_hold_up_nobody(wounded):
    service, dataset = wounded
    with service.held("lidar"):
        first = submit(service.http, dataset)["id"]
        until(service.http, f"/v1/jobs/{first}", runs("lidar"))
        job = submit(service.http, dataset, config=QUICK)["id"]
        (service.data / "jobs" / job).write_text("a file in the place of the folder")
        made = service.http.post("/v1/datasets", json={"name": "blocked"}).json()["id"]
        service.http.put(f"/v1/datasets/{made}/files/config.yaml", content=b"x: 1")
        shutil.rmtree(service.data / "datasets" / made)
        (service.data / "datasets" / made).write_text("a file in the place of the folder")
        service.http.post(f"/v1/datasets/{made}/finish").raise_for_status()
        found = until(service.http, f"/v1/datasets/{made}", lambda row: row["state"] != "validating")
        assert (found["state"], found["error"]["code"]) == ("invalid", "files")
        service.http.post(f"/v1/jobs/{first}/cancel").raise_for_status()
    found = ended(service.http, job)
    assert (found["state"], found["error"]["code"]) == ("failed", "files")
    assert found["error"]["cause"].startswith("the job could not be started: DATA/jobs/")


@pytest.fixture
def altered(service, done_job):
    """Alters files of a result in place, until the test ends."""
    out, kept = service.data / "jobs" / done_job["id"] / "out", {}

    def alter(name, change):
        kept[name] = (out / name).read_bytes()
        change(out / name)

    yield alter
    for name, content in kept.items():
        (out / name).write_bytes(content)


def truncate(path):
    os.truncate(path, 1000)


def flip(path):
    content = bytearray(path.read_bytes())
    content[500] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize("change", [truncate, flip, os.unlink])
def test_result_that_is_not_what_the_job_made_is_an_error(service, done_job, altered, change):
    url = f"/v1/jobs/{done_job['id']}/results/map.ply"
    [item] = [
        item
        for item in service.http.get(done_job["links"]["results"]).json()["items"]
        if item["name"] == "map.ply"
    ]
    whole = service.http.get(url)
    assert (whole.status_code, len(whole.content)) == (200, item["bytes"])
    altered("map.ply", change)
    for path in (url, done_job["links"]["archive"]):
        answer = service.http.get(path, headers={"Range": "bytes=0-99"})
        assert (answer.status_code, answer.json()["code"]) == (500, "damaged"), path
        assert "map.ply" in answer.json()["detail"]
        assert answer.json()["hint"].startswith("restart the job")
    assert service.http.get(f"/v1/jobs/{done_job['id']}/results/report.json").status_code == 200


def test_file_that_was_only_copied_back_is_served_and_has_its_digest(service, done_job, altered):
    import base64
    import hashlib

    altered("map.ply", lambda path: path.write_bytes(path.read_bytes()))
    answer = service.http.get(f"/v1/jobs/{done_job['id']}/results/map.ply", headers={"Range": "bytes=0-9"})
    assert answer.status_code == 206
    content = (service.data / "jobs" / done_job["id"] / "out" / "map.ply").read_bytes()
    digest = base64.b64encode(hashlib.sha256(content).digest()).decode()
    assert answer.headers["repr-digest"] == f"sha-256=:{digest}:"
    packed = zipfile.ZipFile(io.BytesIO(service.http.get(done_job["links"]["archive"]).content))
    assert packed.read(f"{done_job['name']}/map.ply") == content
