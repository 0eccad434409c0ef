"""A service that is killed while a recording arrives, while its parts are merged, and while the result leaves."""

import hashlib
import io
import socket
import tarfile
import time

import httpx
from real_server import PATIENCE, Service, ended, submit, until
from test_server_faults import assert_done_once_with_the_same_bytes, runs
from two_parts import SPLIT


def packed(folder):
    """With something beside the recording: a service writes when a megabyte has come, or the client is given up."""
    stream, more = io.BytesIO(), tarfile.TarInfo("notes.bin")
    more.size = 6 << 20
    with tarfile.open(fileobj=stream, mode="w") as archive:
        archive.add(folder, arcname=".")
        archive.addfile(more, io.BytesIO(bytes(more.size)))
    return stream.getvalue()


def put(http, dataset, data, offset, length):
    headers = {"Upload-Offset": str(offset), "Upload-Length": str(length)}
    return http.put(f"/v1/datasets/{dataset}/archive", content=data, headers=headers)


def unfinished_put(service, dataset, data, offset, length):
    """A connection on which half of the rest of an archive is on its way."""
    url = httpx.URL(service.url)
    connection = socket.create_connection((url.host, url.port))
    head = f"PUT /v1/datasets/{dataset}/archive HTTP/1.1\r\nHost: {url.host}:{url.port}\r\nContent-Length: "
    head += f"{length - offset}\r\nUpload-Offset: {offset}\r\nUpload-Length: {length}\r\n\r\n"
    connection.sendall(head.encode() + data[offset : (offset + length) // 2])
    return connection


def test_killed_throughout_a_job_nothing_is_lost(street_in_two, result_in_two, tmp_path):
    result, _ = result_in_two
    service = Service(tmp_path / "data")
    dataset = _arrives(service, packed(street_in_two))
    job_id = submit(service.http, dataset, config={"split": SPLIT})["id"]
    with service.held("lidar-merge"):
        until(service.http, f"/v1/jobs/{job_id}", runs("lidar-merge"))
        service.kill()
        service.start()
    job = ended(service.http, job_id)
    assert [attempt["outcome"] for attempt in job["attempts"]] == ["lost", "done"]
    assert {s["reused"] for s in job["stages"] if s["name"].startswith("lidar-part-")} == {True}
    assert_done_once_with_the_same_bytes(service.http, job, result)
    assert _leaves(service, f"/v1/jobs/{job_id}/results/map.ply") == (result / "map.ply").read_bytes()
    assert service.stop() == 0


def _arrives(service, data):
    """Id of a ready dataset, whose upload a kill has cut."""
    dataset = service.http.post("/v1/datasets", json={"name": "street"}).raise_for_status().json()["id"]
    third = len(data) // 3
    assert put(service.http, dataset, data[:third], 0, len(data)).status_code == 200
    with _taken_in(service, dataset, data, third):
        service.kill()
    service.start()
    offset = int(service.http.head(f"/v1/datasets/{dataset}/archive").headers["Upload-Offset"])
    assert third <= offset < len(data)
    answer = put(service.http, dataset, data[offset:], offset, len(data))
    assert (answer.status_code, answer.json()["sha256"]) == (201, hashlib.sha256(data).hexdigest())
    service.http.post(f"/v1/datasets/{dataset}/finish").raise_for_status()
    path = f"/v1/datasets/{dataset}"
    assert until(service.http, path, lambda row: row["state"] not in ("uploading", "validating"))["facts"]
    return dataset


def _taken_in(service, dataset, data, offset):
    """A connection of which the service takes in an unfinished upload right now: what has come of it is there."""
    connection = unfinished_put(service, dataset, data, offset, len(data))
    end = time.monotonic() + PATIENCE
    path = f"/v1/datasets/{dataset}/archive"
    while int(service.http.head(path).headers["Upload-Offset"]) <= offset:
        assert time.monotonic() < end, "nothing of the upload has arrived"
        time.sleep(0.02)
    return connection


def _leaves(service, path):
    """A result whose download a kill has cut, and that was gone on with."""
    with service.http.stream("GET", path) as answer:
        etag, pieces = answer.headers["etag"], answer.iter_raw(1000)
        begun = next(pieces)
        service.kill()
    service.start()
    headers = {"Range": f"bytes={len(begun)}-", "If-Range": etag}
    rest = service.http.get(path, headers=headers)
    assert rest.status_code == 206
    return begun + rest.content
