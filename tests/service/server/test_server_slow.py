"""Clients that are slow, vanish, or send too much: nobody else notices."""

import hashlib
import json
import socket
import time

import pytest
from real_server import Service


@pytest.fixture(scope="module")
def hasty(tmp_path_factory):
    """A service without patience, that runs nothing."""
    running = Service(
        tmp_path_factory.mktemp("hasty") / "data",
        "--jobs",
        "0",
        environment={"LVBA_LIMITS_STALL_S": "1", "LVBA_LIMITS_SLOWEST_BYTES_PER_S": "100"},
    )
    yield running
    running.stop()


def connect(service):
    host, port = service.url.removeprefix("http://").split(":")
    line = socket.create_connection((host, int(port)), timeout=20)
    return line, f"Host: {host}:{port}\r\n"


def answer_of(line):
    """Status and body of the one answer of a connection that the server closes."""
    data = b""
    while piece := line.recv(1 << 16):
        data += piece
    head, _, body = data.partition(b"\r\n\r\n")
    return int(head.split()[1]), json.loads(body)


def new_dataset(service):
    return service.http.post("/v1/datasets", json={"name": "slow"}).raise_for_status().json()["id"]


def begin_upload(service, dataset, sent, length):
    """A connection on which an upload has stopped after some bytes, as of a client that vanished."""
    line, host = connect(service)
    head = f"PUT /v1/datasets/{dataset}/files/a.bin HTTP/1.1\r\n{host}Content-Length: {length}\r\n\r\n"
    line.sendall(head.encode() + sent)
    place, end = f"/v1/datasets/{dataset}/files/a.bin", time.monotonic() + 20
    while service.http.head(place).status_code == 404:
        assert time.monotonic() < end
    return line


def test_upload_that_stops_is_ended_and_can_be_gone_on_with(hasty):
    dataset = new_dataset(hasty)
    with begin_upload(hasty, dataset, b"x" * 1000, 5000) as line:
        status, problem = answer_of(line)
    assert (status, problem["code"]) == (408, "too-slow")
    place = f"/v1/datasets/{dataset}/files/a.bin"
    assert hasty.http.head(place).headers["Upload-Offset"] == "1000"
    headers = {"Upload-Offset": "1000", "Upload-Length": "5000"}
    assert hasty.http.put(place, content=b"x" * 4000, headers=headers).status_code == 201


def test_upload_that_has_stopped_hears_of_the_end_of_its_service(tmp_path):
    """The service waits some seconds, then says that it is not the request's fault."""
    ending = Service(tmp_path / "data", "--jobs", "0")
    try:
        with begin_upload(ending, new_dataset(ending), b"x" * 1000, 5000) as line:
            ending.process.terminate()
            status, problem = answer_of(line)
    finally:
        ending.stop()
    assert (status, problem["code"], problem["detail"]) == (503, "unavailable", "the service is ending")


def test_upload_that_drips_is_ended(hasty):
    with begin_upload(hasty, new_dataset(hasty), b"", 5000) as line:
        line.settimeout(0.3)
        for _ in range(100):
            line.sendall(b"x")
            try:
                found = line.recv(1 << 16)
            except TimeoutError:
                continue
            assert b" 408 " in found
            return
    raise AssertionError("it would drip on for half an hour")


def test_new_request_of_the_same_key_takes_an_upload_over(service):
    dataset = new_dataset(service)
    place = f"/v1/datasets/{dataset}/files/a.bin"
    with begin_upload(service, dataset, b"x" * 1000, 5000) as line:
        taken = service.http.put(place, content=b"y" * 3000)
        status, problem = answer_of(line)
    assert (status, problem["code"]) == (423, "locked")
    assert taken.status_code == 201
    assert taken.json()["sha256"] == hashlib.sha256(b"y" * 3000).hexdigest()


def test_json_that_stops_is_answered(hasty):
    line, host = connect(hasty)
    with line:
        head = f"POST /v1/datasets HTTP/1.1\r\n{host}Content-Type: application/json\r\nContent-Length: 99\r\n\r\n"
        line.sendall(head.encode() + b'{"name"')
        status, problem = answer_of(line)
    assert (status, problem["code"]) == (408, "too-slow")


@pytest.mark.parametrize(
    ("path", "size"), [("/v1/datasets", 64 << 10), ("/v1/jobs", 64 << 10), ("/v1/batches", 4 << 20)]
)
def test_large_json_is_refused_before_it_is_read(service, path, size):
    line, host = connect(service)
    with line:
        line.sendall(f"POST {path} HTTP/1.1\r\n{host}Content-Length: {size + 1}\r\n\r\n".encode())
        assert b" 413 " in line.recv(1 << 16)
    assert service.http.post(path, content=b" " * size).status_code == 422


def test_many_errors_are_told_in_few_words(service):
    jobs = [{"dataset": 1} for _ in range(1000)]
    answer = service.http.post("/v1/batches", json={"name": "b", "jobs": jobs})
    assert (answer.status_code, len(answer.json()["errors"])) == (422, 20)
    unknown = {f"u{number}": 0 for number in range(250_000)}
    answer = service.http.post("/v1/batches", json=unknown)
    assert answer.status_code == 422
    [error] = answer.json()["errors"]
    assert error["message"].endswith("has 250000 fields; known are name, jobs")
