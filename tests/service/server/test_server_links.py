"""Links that are put where files were, tickets that are forged, secrets that are none: nothing of others is read."""

import base64
import hashlib
import hmac
import io
import json
import os
import shutil
import time
import zipfile

import httpx
import pytest
from real_server import Service, ended, submit, until
from test_server_faults import runs

SECRET = "what only the server may read"


@pytest.fixture(scope="module")
def registered(tiny_recording, tmp_path_factory):
    """A service that asks for keys, a client, and the folder of a recording that it registered: its id is with it."""
    folder = tmp_path_factory.mktemp("registered")
    shutil.copytree(tiny_recording, folder / "root" / "yard")
    (folder / "elsewhere" / "inner").mkdir(parents=True)
    (folder / "elsewhere" / "inner" / "known.txt").write_text(SECRET)
    (folder / "elsewhere" / "known.txt").write_text(SECRET)
    service = Service(folder / "data", "--auth", "--root", folder / "root")
    client = service.as_key(service.key("ann"))
    yield service, client, folder / "root" / "yard", register(client, folder / "root" / "yard")["id"]
    service.stop()


def register(client, folder):
    made = client.post("/v1/datasets", json={"name": "yard", "folder": str(folder)}).raise_for_status()
    path = f"/v1/datasets/{made.json()['id']}"
    return until(client, path, lambda row: row["state"] != "validating")


@pytest.fixture
def swapped(registered):
    """Puts a link in the place of a file or folder of the recording, until the test ends."""
    undo = []

    def swap(path, target):
        away = path.with_name(f"{path.name}.away")
        path.rename(away)
        path.symlink_to(target)
        undo.append((path, away))

    yield swap
    for path, away in undo:
        path.unlink()
        away.rename(path)


def assert_nothing_is_told(client, dataset, path):
    answer = client.get(f"/v1/datasets/{dataset}/files/{path}")
    assert 400 <= answer.status_code < 500, (path, answer.status_code)
    assert SECRET not in answer.text
    assert answer.headers["content-type"] == "application/problem+json"


@pytest.mark.parametrize("target", ["/", "data", "elsewhere"])
def test_registered_folder_that_becomes_a_link_tells_nothing(registered, swapped, target):
    service, client, folder, dataset = registered
    assert client.get(f"/v1/datasets/{dataset}/files/config.yaml").status_code == 200
    swapped(folder, service.data.parent / target)
    for path in ("etc/hostname", "secret", "known.txt", "inner/known.txt", "config.yaml"):
        assert_nothing_is_told(client, dataset, path)


def test_links_in_a_registered_folder_are_not_followed_in_any_part(registered, swapped):
    service, client, folder, dataset = registered
    elsewhere = service.data.parent / "elsewhere"
    swapped(folder / "config.yaml", elsewhere / "known.txt")
    swapped(folder / "all_image", elsewhere)
    swapped(folder / "all_pcd_body", "..")
    for path in ("config.yaml", "all_image/known.txt", "all_image/inner/known.txt", "all_pcd_body/yard.away"):
        assert_nothing_is_told(client, dataset, path)
    assert "symbolic link" in client.get(f"/v1/datasets/{dataset}/files/config.yaml").json()["detail"]


def test_pipe_in_a_registered_folder_does_not_hang(registered):
    _, client, folder, dataset = registered
    os.mkfifo(folder / "pipe")
    assert_nothing_is_told(client, dataset, "pipe")


def test_recording_that_holds_links_is_refused_with_the_mend(registered):
    _, client, folder, _ = registered
    linked = folder.with_name("linked")
    shutil.copytree(folder, linked, ignore=shutil.ignore_patterns("all_image", "pipe"))
    (linked / "all_image").symlink_to(folder / "all_image")
    found = register(client, linked)
    assert found["state"] == "invalid"
    assert "DATASET/all_image: is a symbolic link" in found["error"]["cause"]
    assert found["error"]["hint"] == "put the file or folder itself in its place, or mount it there"


def test_run_reads_nothing_through_links_that_came_while_it_ran(registered, swapped):
    service, client, folder, dataset = registered
    foreign = service.data.parent / "foreign"
    shutil.copytree(folder / "all_image", foreign)
    with service.held("lidar"):
        job = submit(client, dataset)
        until(client, f"/v1/jobs/{job['id']}", runs("lidar"))
        swapped(folder / "all_image", foreign)
    job = ended(client, job["id"])
    assert job["state"] == "failed"
    assert "is a symbolic link" in job["error"]["cause"]
    assert job["error"]["cause"].startswith("DATASET/all_image")


def test_results_and_archives_follow_no_links(service, done_job):
    out = service.data / "jobs" / done_job["id"] / "out"
    (service.data.parent / "foreign.txt").write_text(SECRET)
    kept = (out / "exposures.csv").rename(out / ".kept")
    (out / "exposures.csv").symlink_to(service.data.parent / "foreign.txt")
    try:
        answer = service.http.get(f"/v1/jobs/{done_job['id']}/results/exposures.csv")
        assert answer.status_code != 200
        assert SECRET not in answer.text
        try:
            packed = service.http.get(done_job["links"]["archive"])
            assert SECRET.encode() not in packed.content
        except httpx.RemoteProtocolError:
            pass  # cut off, as what cannot be made whole must be
    finally:
        kept.rename(out / "exposures.csv")
    whole = zipfile.ZipFile(io.BytesIO(service.http.get(done_job["links"]["archive"]).content))
    assert whole.testzip() is None


def forged(key, path, mark_of, **more):
    said = {"key": key, "path": path, "until": time.time() + 600, **more}
    text = base64.urlsafe_b64encode(json.dumps(said).encode()).decode()
    return f"{text}.{mark_of(text)}"


def test_forged_tickets_are_worth_nothing_even_with_the_secret(registered):
    service, _, _, dataset = registered
    secret = (service.data / "secret").read_bytes()
    derived = hmac.new(secret, b"lvba tickets", hashlib.sha256).digest()
    bens = service.key("ben").split("_")[1]
    path = f"/v1/datasets/{dataset}/files/config.yaml"
    marks = [
        lambda text: hmac.new(secret, text.encode(), hashlib.sha256).hexdigest(),
        lambda text: hmac.new(derived, text.encode(), hashlib.sha256).hexdigest(),
        lambda text: hmac.new(derived, f" {text}".encode(), hashlib.sha256).hexdigest(),
        lambda text: hmac.new(b"", f" {text}".encode(), hashlib.sha256).hexdigest(),
    ]
    for key in ("local", "", bens):
        for mark in marks:
            ticket = forged(key, path, mark, owner="ann")
            answer = httpx.get(service.url + path, params={"ticket": ticket})
            assert answer.status_code == 401, (key, answer.text)


def test_ticket_of_another_owner_opens_nothing_and_one_for_everything_is_refused(registered):
    service, client, _, dataset = registered
    ben = service.as_key(service.key("ben"))
    path = f"/v1/datasets/{dataset}/files/config.yaml"
    for who, status in ((client, 200), (ben, 404)):
        ticket = who.post("/v1/tickets", json={"path": path}).json()["ticket"]
        assert httpx.get(service.url + path, params={"ticket": ticket}).status_code == status
    for wide in ("/v1/jobs/", "/v1/datasets/", "/v1/jobs/../"):
        assert client.post("/v1/tickets", json={"path": wide}).status_code == 422, wide


@pytest.mark.parametrize("secret", [b"", b"short", bytes(32)])
def test_secret_that_is_none_is_refused_at_start(lvba, tmp_path, secret):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "secret").write_bytes(secret)
    refused = lvba("serve", "--data", tmp_path / "data", "--port", "0", code=2)
    assert "is no secret" in refused.stderr
    assert len(refused.stderr.splitlines()) == 1


@pytest.mark.parametrize(("data", "root"), [("root/data", "root"), ("root", "root"), ("data", "data/jobs")])
def test_data_folder_that_could_be_registered_is_refused_at_start(lvba, tmp_path, data, root):
    (tmp_path / root).mkdir(parents=True)
    words = ("--data", tmp_path / data, "--root", tmp_path / root, "--port", "0")
    refused = lvba("serve", *words, code=2)
    assert "root" in refused.stderr
    assert len(refused.stderr.splitlines()) == 1
