"""Too many connections: others are still answered, jobs still run, and the log stays short."""

import asyncio
import json
import logging
import resource
import socket
import subprocess
import sys
import time
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import httpx
import pytest
import uvicorn
from real_server import Service, ended, submit, upload
from uvicorn.server import ServerState

from lvba.errors import InputError
from service.api.connection import Connection
from service.api.connection_slots import ConnectionSlots
from service.settings import Settings
from service.system import descriptors
from service.system.repeat_filter import RepeatFilter

PORTS = 200
"""Connections of the crowd."""


def address_of(service):
    host, port = service.url.removeprefix("http://").split(":")
    return host, int(port)


def half_requests(service, count, stack):
    """Connections that begin a request, and do not continue."""
    lines = []
    for _ in range(count):
        line = stack.enter_context(socket.create_connection(address_of(service), timeout=20))
        line.sendall(b"GET /v1/jobs HTTP/1.1\r\nHost: ")
        lines.append(line)
    return lines


@pytest.fixture(scope="module")
def narrow(tmp_path_factory):
    """A service that may open few files."""
    running = Service(
        tmp_path_factory.mktemp("narrow") / "data",
        below=("sh", "-c", f'ulimit -n {descriptors.LEAST}; exec "$@"', "sh"),
        environment={"LVBA_LIMITS_HEAD_S": "60"},
    )
    yield running
    running.stop()


def test_half_requests_stop_neither_answers_nor_jobs_and_the_log_stays_short(narrow, tiny_recording):
    dataset = upload(narrow.http, tiny_recording)
    with ExitStack() as stack:
        half_requests(narrow, PORTS, stack)
        # over a connection of its own: one that has been idle is closed for others that come
        client = stack.enter_context(
            httpx.Client(base_url=narrow.url, headers=narrow.http.headers, timeout=20)
        )
        job = submit(client, dataset)
        for _ in range(20):
            # each over a connection of its own, as others would come
            assert httpx.get(narrow.url + "/readyz", timeout=20).status_code == 200
        job = ended(narrow.http, job["id"])
    assert (job["state"], len(job["attempts"])) == ("done", 1), job
    assert narrow.log.stat().st_size < 20_000


def test_connections_of_busy_clients_are_kept_and_more_are_told_so(narrow):
    with ExitStack() as stack:
        listeners = []
        for _ in range(20):
            client = stack.enter_context(httpx.Client(base_url=narrow.url, timeout=20))
            answer = stack.enter_context(client.stream("GET", "/v1/events"))
            if answer.status_code != 200:
                break
            listeners.append(answer.iter_bytes())
            assert next(listeners[-1]) == b": lvba\n\n"
        assert (answer.status_code, answer.headers["Retry-After"]) == (503, "5")
        assert json.loads(answer.read())["code"] == "unavailable"
    assert narrow.http.get("/readyz").status_code == 200


def test_job_that_the_server_cannot_begin_waits_and_no_attempt_counts(tmp_path, tiny_recording):
    service = Service(tmp_path / "data")
    dataset = upload(service.http, tiny_recording)
    soft, hard = resource.prlimit(service.process.pid, resource.RLIMIT_NOFILE)
    few = len(list(Path(f"/proc/{service.process.pid}/fd").iterdir())) + 4
    resource.prlimit(service.process.pid, resource.RLIMIT_NOFILE, (few, hard))
    job = submit(service.http, dataset)
    end = time.monotonic() + 60
    while service.log.read_text().count("nothing can be begun") < 2:
        assert time.monotonic() < end
        time.sleep(0.1)
    resource.prlimit(service.process.pid, resource.RLIMIT_NOFILE, (soft, hard))
    job = ended(service.http, job["id"])
    assert (job["state"], len(job["attempts"])) == ("done", 1), job
    assert service.stop() == 0


@pytest.fixture(scope="module")
def hurried(tmp_path_factory):
    """A service that waits for nobody."""
    running = Service(
        tmp_path_factory.mktemp("hurried") / "data",
        "--jobs",
        "0",
        environment={"LVBA_LIMITS_HEAD_S": "1", "LVBA_LIMITS_STALL_S": "1"},
    )
    yield running
    running.stop()


@pytest.mark.parametrize(
    "sent", [b"", b"GET / HTTP/1.1\r\nHost", b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\nGET "]
)
def test_head_that_does_not_come_to_its_end_is_ended(hurried, sent):
    with socket.create_connection(address_of(hurried), timeout=20) as line:
        line.sendall(sent)
        if sent.endswith(b"GET "):
            assert b" 200 " in line.recv(1 << 16)
            line.sendall(b"/")
        found = b"".join(iter(lambda: line.recv(1 << 16), b""))
    assert b"HTTP/1.1 408 " in found
    assert found.endswith(b"}")


def test_head_that_drips_is_ended(hurried):
    with socket.create_connection(address_of(hurried), timeout=0.2) as line:
        line.sendall(b"GET / HTTP/1.1\r\nX: ")
        for _ in range(100):
            line.sendall(b"x")
            try:
                assert line.recv(1 << 16).startswith(b"HTTP/1.1 408 ")
            except TimeoutError:
                continue
            return
    raise AssertionError("it drips on")


def test_body_of_a_refused_request_is_not_waited_for_long(hurried):
    begin = time.monotonic()
    with socket.create_connection(address_of(hurried), timeout=0.2) as line:
        line.sendall(b"PUT /v1/none HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 999999\r\n\r\nx")
        answer = b""
        while time.monotonic() < begin + 20:
            try:
                piece = line.recv(1 << 16)
                answer += piece
                if not piece:
                    break
                line.sendall(b"x")
            except TimeoutError:
                line.sendall(b"x")
            except OSError:
                break
        else:
            raise AssertionError("it takes all of it")
    assert b" 405 " in answer or b" 404 " in answer


def test_client_that_does_not_read_is_sent_away(hurried):
    dataset = hurried.http.post("/v1/datasets", json={"name": "x"}).json()["id"]
    for number in range(40):
        name = f"{number:03}" + "x" * 190
        hurried.http.put(f"/v1/datasets/{dataset}/files/{name}", content=b"").raise_for_status()
    request = f"GET /v1/datasets/{dataset}/files?limit=500 HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode()
    with socket.socket() as line:
        line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        line.settimeout(20)
        line.connect(address_of(hurried))
        end = time.monotonic() + 30
        with pytest.raises(OSError):  # noqa: PT012  # the server breaks it off in the midst of any of these
            while time.monotonic() < end:
                line.sendall(request)
                time.sleep(0.01)
            raise AssertionError("it may continue for ever")


class Client:
    """A connection to a slots alone."""

    def __init__(self):
        self.gone = False

    def abort(self):
        self.gone = True


def test_longest_waiting_has_to_go_first_of_its_own_address_and_who_works_stays():
    slots = ConnectionSlots(8, 3, ("10.0.0.9",))
    mine = [Client() for _ in range(4)]
    assert all(slots.take(client, "10.0.0.1") for client in mine[:3])
    slots.mark_busy(mine[0])
    assert slots.take(mine[3], "::ffff:10.0.0.1")
    assert [client.gone for client in mine] == [False, True, False, False]
    proxied = [Client() for _ in range(6)]
    assert all(slots.take(client, "10.0.0.9") for client in proxied[:5])
    assert not any(client.gone for client in proxied)
    assert slots.take(proxied[5], "10.0.0.9")
    assert mine[2].gone
    for client in (mine[0], mine[3], *proxied):
        slots.mark_busy(client)
    assert not slots.take(Client(), "10.0.0.2")
    slots.release(proxied[0])
    assert slots.take(Client(), "2001:db8::1")


def test_customer_with_a_network_of_addresses_counts_as_one():
    slots = ConnectionSlots(100, 2)
    assert slots.take(first := Client(), "2001:db8::1")
    assert slots.take(Client(), "2001:db8::2")
    assert slots.take(Client(), "2001:db8::ffff:3")
    assert first.gone
    assert slots.take(Client(), "2001:db8:0:1::1")


def test_connection_that_is_taken_up_only_when_the_service_ends_hears_so():
    limits = Settings().limits
    slots = ConnectionSlots(8, 3)
    slots.close()
    config = uvicorn.Config(lambda: None, lifespan="off")
    config.load()

    async def ask():
        make = partial(
            Connection, config=config, server_state=ServerState(), app_state={}, slots=slots, limits=limits
        )
        listening = await asyncio.get_running_loop().create_server(make, "127.0.0.1", 0)
        async with listening:
            reader, writer = await asyncio.open_connection(*listening.sockets[0].getsockname())
            writer.write(b"GET /v1/jobs HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
            answer = await asyncio.wait_for(reader.read(), 20)
            writer.close()
        return answer

    head, _, body = asyncio.run(ask()).partition(b"\r\n\r\n")
    assert b" 503 " in head.splitlines()[0]
    assert b"Retry-After: 5" in head
    assert json.loads(body)["detail"] == "the service is ending"


def test_files_that_may_be_open_are_shared_out():
    for count in (64, 100, 256, 1024, 20_000, 65_536):
        found = descriptors._of(count, 4000)
        assert 2 * found.connections + 2 * found.threads + 20 <= count
        assert found.connections >= 10
        assert found.threads >= 5
        assert found.accepts >= 10
    with pytest.raises(InputError):
        descriptors._of(63, 4000)


def test_log_does_not_repeat_itself():
    repeats, told = RepeatFilter(), []
    for number in range(1000):
        record = logging.makeLogRecord({"levelno": 30, "msg": "%d is wrong", "args": (number,), "name": "x"})
        if repeats.filter(record):
            told.append(record.getMessage())
    assert (len(told), told[0]) == (10, "0 is wrong")
    assert "are only counted" in told[-1]
    assert repeats.filter(logging.makeLogRecord({"levelno": 30, "msg": "another", "name": "x"}))
    assert all(repeats.filter(logging.makeLogRecord({"levelno": 20, "msg": "x"})) for _ in range(100))
    repeats._kinds = {kind: (begin - 61, count) for kind, (begin, count) in repeats._kinds.items()}
    record = logging.makeLogRecord({"levelno": 30, "msg": "%d is wrong", "args": (7,), "name": "x"})
    assert repeats.filter(record)
    assert record.getMessage() == "7 is wrong (and 990 times more before)"


def test_check_without_enough_memory_blames_the_memory(tmp_path, tiny_recording):
    service = Service(
        tmp_path / "data",
        "--jobs",
        "0",
        below=("sh", "-c", 'ulimit -v 4000000; exec "$@"', "sh"),
        environment={"LVBA_LIMITS_VALIDATION_MEMORY_BYTES": "300000000"},
    )
    with pytest.raises(AssertionError, match=r"'too-much'.*out of memory: it may take 300 MB.*ulimit -v"):
        upload(service.http, tiny_recording)
    assert service.stop() == 0


def test_check_takes_no_more_memory_than_the_service_itself_may():
    code = (
        "from service.datasets import check_memory; from service.settings import Limits;"
        " from service.system import process_limits; process_limits.limit(check_memory.address_space(Limits()), 60)"
    )
    words = ["sh", "-c", 'ulimit -v 2000000; exec "$@"', "sh", sys.executable, "-c", code]
    assert subprocess.run(words, check=False).returncode == 0
