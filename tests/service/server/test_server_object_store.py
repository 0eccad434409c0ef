"""Recordings in object stores: registered below a root only, copied once under limits, resumed when cut short."""

import dataclasses

import fsspec
import pytest
from real_server import Service, until

from lvba.errors import InputError
from service.datasets import object_store
from service.settings import Limits, load
from service.system import store_urls

ROOTS = ("s3://maps/recordings",)


def put(bucket, recording, prefix):
    """The files of a folder as objects below a prefix."""
    for file in sorted(p for p in recording.rglob("*") if p.is_file()):
        bucket.upload_file(str(file), "maps", f"{prefix}/{file.relative_to(recording).as_posix()}")


def register(service, place):
    """The answer to a registration."""
    return service.http.post("/v1/datasets", json={"name": "x", "folder": place})


def checked(service, answer):
    """The dataset, once it is checked."""
    assert answer.status_code == 201, answer.text
    return until(service.http, answer.headers["Location"], lambda row: row["state"] != "validating")


@pytest.fixture
def service(bucket, tmp_path, tiny_recording):
    served = Service(
        *(tmp_path / "data", "--jobs", "0", "--root", ROOTS[0] + "/", "--root", tiny_recording.parent),
        environment={"LVBA_LIMITS_ARCHIVE_ENTRIES": "60"},
    )
    yield served
    served.stop()


def test_recording_in_a_bucket_is_the_one_in_a_folder(service, bucket, tiny_recording, lvba):
    put(bucket, tiny_recording, "recordings/street")
    here = checked(service, register(service, str(tiny_recording)))
    there = checked(service, register(service, "s3://maps/recordings/street/"))
    assert (there["state"], there["source"]) == ("ready", "url")
    assert there["facts"] == here["facts"]
    files = [p for p in tiny_recording.rglob("*") if p.is_file()]
    assert (there["files"], there["bytes"]) == (len(files), sum(p.stat().st_size for p in files))
    path = f"/v1/datasets/{there['id']}"
    frame = service.http.get(f"{path}/frames").json()["items"][0]
    assert service.http.get(frame["url"]).content == (tiny_recording / frame["path"]).read_bytes()
    assert service.http.get("/v1/me").json()["quota"]["bytes_used"] == there["bytes"]
    job = lvba("submit", "s3://maps/recordings/street", "--server", service.url).stdout.strip()
    assert service.http.get(f"/v1/jobs/{job}").json()["name"] == "street"
    refused = lvba("submit", "s3://maps/private", "--server", service.url, code=2)
    assert "not below a root" in refused.stderr
    service.http.delete(path)
    assert bucket.list_objects_v2(Bucket="maps", Prefix="recordings/street/")["KeyCount"] == len(files)


def test_what_is_in_the_bucket_must_be_a_recording_of_allowed_size(service, bucket):
    nothing = checked(service, register(service, "s3://maps/recordings/nothing"))
    assert "holds no files" in nothing["error"]["cause"]
    bucket.put_object(Bucket="maps", Key="recordings/out/../../escaped", Body=b"x")
    assert (
        "plain relative path"
        in checked(service, register(service, "s3://maps/recordings/out"))["error"]["cause"]
    )
    for number in range(61):
        bucket.put_object(Bucket="maps", Key=f"recordings/many/{number}.txt", Body=b"x")
    many = checked(service, register(service, "s3://maps/recordings/many"))
    assert (many["state"], many["source"]) == ("invalid", "url")
    assert "more than 60 files" in many["error"]["cause"]
    assert not list(service.data.rglob("escaped"))


def test_other_urls_are_refused_before_anybody_is_asked(service, bucket):
    bucket.put_object(Bucket="maps", Key="private/config.yaml", Body=b"x")
    for place in (
        "s3://maps/private",
        "s3://maps/recordingsother",
        "s3://maps",
        "s3://maps/recordings/../private",
        "s3://maps/recordings/%2e%2e/private",
        "s3://maps/recordings/a//b",
        "s3://maps/recordings/a?versionId=1",
        "s3://key:secret@maps/recordings",
        "simplecache::s3://maps/recordings",
        "zip://a::s3://maps/recordings/b.zip",
        "http://169.254.169.254/maps/recordings",
        "file:///etc",
        "local:///etc",
    ):
        assert register(service, place).status_code == 403, place


def test_owner_may_not_have_more_than_the_quota(bucket, tmp_path, tiny_recording):
    put(bucket, tiny_recording, "recordings/street")
    service = Service(
        *(tmp_path / "data", "--jobs", "0", "--root", ROOTS[0]),
        environment={"LVBA_LIMITS_OWNER_BYTES": "1000"},
    )
    found = checked(service, register(service, "s3://maps/recordings/street"))
    assert (found["state"], found["error"]["code"]) == ("invalid", "quota")
    service.stop()


def test_roots_are_folders_or_object_stores():
    assert load({"roots": ["/a", "s3://maps/b/"]}, {}).roots == ("/a", "s3://maps/b")
    assert store_urls.below_roots("s3://maps/b/c/", ("s3://maps/b",)) == "s3://maps/b/c"
    for wrong in ("ftp://a/b", "https://a/b", "s3://", "s3://a/../b", "file:///a"):
        with pytest.raises(InputError, match="no bucket"):
            load({"roots": [wrong]}, {})


@pytest.fixture
def memory():
    files = fsspec.filesystem("memory")
    for name in ("a/1.txt", "a/2.txt", "b.txt"):
        files.pipe(f"/recording/{name}", name.encode())
    yield files
    files.rm("/recording", recursive=True)


def fetch(folder, **limits):
    object_store.fetch("memory://recording", folder, dataclasses.replace(Limits(), **limits), 10**9)
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.parametrize("replaced", [False, True])
def test_fetch_that_was_cut_short_goes_on_unless_the_object_is_another(
    memory, tmp_path, monkeypatch, replaced
):
    kind, got = type(memory), []

    def get(self, path, target, **options):
        got.append(path)
        if len(got) == 2:
            raise ConnectionError("cut")
        original(self, path, target, **options)

    original = kind.get_file
    monkeypatch.setattr(kind, "get_file", get)
    monkeypatch.setattr(object_store, "_AT_ONCE", 1)
    with pytest.raises(InputError, match="cannot be read"):
        fetch(tmp_path / "files")
    assert got == ["/recording/a/1.txt", "/recording/a/2.txt"]
    if replaced:
        memory.pipe("/recording/a/1.txt", b"later!!")
    memory.rm("/recording/b.txt")
    found = fetch(tmp_path / "files")
    assert found == {"a/1.txt": b"later!!" if replaced else b"a/1.txt", "a/2.txt": b"a/2.txt"}
    assert got.count("/recording/a/1.txt") == 1 + replaced


def test_only_so_many_bytes_are_fetched(memory, tmp_path):
    with pytest.raises(InputError, match="holds more than"):
        fetch(tmp_path / "files", archive_bytes=8)
