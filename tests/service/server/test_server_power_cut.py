"""The power goes at once after an answer: what clients were told is on the disk."""

import hashlib
import io
import tarfile

import pytest
from power import Disk
from real_server import Service, ended, submit, until, upload
from sqlalchemy import text
from test_server_faults import assert_done_once_with_the_same_bytes
from test_server_uploads import put_and_cut

from service.db.database import Database

NO_RESERVE = {"LVBA_LIMITS_DISK_RESERVE_BYTES": "0"}


@pytest.fixture
def disk(tmp_path):
    disk = Disk(tmp_path)
    yield disk
    disk.remove()


@pytest.fixture
def serve(disk):
    """Starts a service on the disk; it ends before the disk is taken away."""
    services = []

    def start(*options):
        services.append(Service(disk.folder / "data", *options, environment=NO_RESERVE))
        return services[-1]

    yield start
    for service in services:
        if service.process.poll() is None:
            service.kill()


def lose_power(disk, service):
    """The machine is off at this moment, and on again."""
    disk.cut_power()
    service.kill()
    disk.restore_power()
    service.start()


def told(service, url):
    """What the service says of a file: how much is there, how much is to come."""
    head = service.http.head(url).raise_for_status().headers
    return head["Upload-Offset"], head["Upload-Length"]


def unpacked(http, recording):
    """Id of a dataset that came as an archive, as soon as it is ready."""
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w") as archive:
        archive.add(recording, arcname="tiny")
    dataset = http.post("/v1/datasets", json={"name": "packed"}).json()["id"]
    http.put(f"/v1/datasets/{dataset}/archive", content=packed.getvalue()).raise_for_status()
    http.post(f"/v1/datasets/{dataset}/finish").raise_for_status()
    until(http, f"/v1/datasets/{dataset}", lambda row: row["state"] == "ready")
    return dataset


def test_power_cut_takes_nothing_that_was_told(disk, serve, tiny_recording, tiny_result):
    """On SQLite, see below."""
    service = serve()

    dataset = service.http.post("/v1/datasets", json={"name": "half"}).json()["id"]
    url = f"/v1/datasets/{dataset}/files/all_image/1.5.png"
    assert service.http.put(url, content=b"x" * 5000, headers={"Upload-Length": "9000"}).status_code == 200
    lose_power(disk, service)
    assert told(service, url) == ("5000", "9000")
    put_and_cut(service, dataset, b"z" * 9000, 0, 3000, "cut")
    cut = f"/v1/datasets/{dataset}/files/cut"
    until(service.http, f"/v1/datasets/{dataset}/files", lambda files: len(files["items"]) == 2)
    before = told(service, cut)
    lose_power(disk, service)
    assert told(service, cut) == before
    service.http.delete(cut).raise_for_status()

    rest = {"Upload-Offset": "5000", "Upload-Length": "9000"}
    whole = service.http.put(url, content=b"y" * 4000, headers=rest)
    lose_power(disk, service)
    [file] = service.http.get(f"/v1/datasets/{dataset}/files").json()["items"]
    assert (whole.status_code, file) == (201, whole.json())
    [stored] = (service.data / "datasets" / dataset / "uploads").iterdir()
    assert hashlib.sha256(stored.read_bytes()).hexdigest() == file["sha256"]

    ready = unpacked(service.http, tiny_recording)
    lose_power(disk, service)
    assert service.http.get(f"/v1/datasets/{ready}").json()["state"] == "ready"
    files = service.data / "datasets" / ready / "files"
    for path in (path for path in tiny_recording.rglob("*") if path.is_file()):
        assert (files / path.relative_to(tiny_recording)).read_bytes() == path.read_bytes()

    done = ended(service.http, submit(service.http, ready)["id"])
    listed = service.http.get(f"/v1/jobs/{done['id']}/results").json()
    contents = {item["name"]: service.http.get(item["url"]).content for item in listed["items"]}
    lose_power(disk, service)
    job = service.http.get(f"/v1/jobs/{done['id']}").json()
    assert_done_once_with_the_same_bytes(service.http, job, tiny_result)
    assert service.http.get(f"/v1/jobs/{done['id']}/results").json() == listed
    for item in listed["items"]:
        assert service.http.get(item["url"]).content == contents[item["name"]], item["name"]
    assert service.stop() == 0


def test_power_cut_takes_no_job_cancellation_or_revoked_key(disk, serve, tiny_recording, lvba):
    """On SQLite; PostgreSQL keeps its promise by default, and is asked whether it does."""
    service = serve("--auth", "--jobs", "0")
    words = ("admin", "key", "create", "team", "--data", service.data)
    key, stolen = (lvba(*words).stdout.split()[-1] for _ in range(2))
    http = service.as_key(key)
    dataset = upload(http, tiny_recording)
    jobs = [submit(http, dataset, name=name)["id"] for name in ("canceled", "waits")]
    lose_power(disk, service)
    http = service.as_key(key)
    assert [job["id"] for job in http.get("/v1/jobs").json()["items"]] == jobs[::-1]
    assert http.post(f"/v1/jobs/{jobs[0]}/cancel").json()["state"] == "canceled"
    lose_power(disk, service)
    assert service.as_key(key).get(f"/v1/jobs/{jobs[0]}").json()["state"] == "canceled"
    assert service.as_key(stolen).get("/v1/me").status_code == 200
    lvba("admin", "key", "revoke", stolen.split("_")[1], "--data", service.data)
    lose_power(disk, service)
    assert service.as_key(stolen).get("/v1/me").status_code == 401
    assert service.stop() == 0


def test_postgres_answers_when_what_it_answers_is_on_the_disk(postgres):
    database = Database("postgresql+psycopg://" + postgres.new_database().partition("://")[2])
    with database.write() as session:
        assert session.scalar(text("SHOW synchronous_commit")) == "on"
    database.close()
