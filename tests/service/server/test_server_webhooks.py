"""Webhooks: signed, tried again, and never to where they could do harm."""

import json
import socket
import threading
import time
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest
from stub_servers import serve

from lvba.errors import InputError
from service.db.database import Database
from service.db.tables import Dataset, Delivery, Job
from service.jobs import webhook_delivery, webhooks
from service.jobs.public_addresses import is_public
from service.settings import Settings
from service.system.paths import now

SECRET = "a secret of many letters"


class Stub(HTTPServer):
    """Takes what it is told; answers what it is to answer."""

    def __init__(self):
        super().__init__(("127.0.0.1", 0), _Handler)
        self.told, self.answers = [], [200]
        self.origin = f"http://127.0.0.1:{self.server_port}"
        serve(self)


class _Handler(BaseHTTPRequestHandler):
    def do_POST(self):
        body = self.rfile.read(int(self.headers["Content-Length"])).decode()
        self.server.told.append((self.path, dict(self.headers), body))
        answers = self.server.answers
        self.send_response(answers.pop(0) if len(answers) > 1 else answers[0])
        self.send_header("Location", "http://127.0.0.1:1/elsewhere")
        self.end_headers()

    def log_message(self, *words):
        pass


@pytest.fixture
def stub():
    server = Stub()
    yield server
    server.shutdown()
    server.server_close()


@pytest.fixture
def database(tmp_path):
    database = Database(f"sqlite:///{tmp_path / 'lvba.sqlite'}")
    database.migrate()
    yield database
    database.close()


def end_job(database, url):
    """A job that has ended and wants that told."""
    with database.write() as session:
        session.add(Dataset(id="ds_1", owner="x", name="x", state="ready", created=0, updated=0))
        session.flush()
        job = Job(
            id="job_1", owner="x", name="yard", dataset_id="ds_1", config={}, state="done", created=0, updated=0,
            webhook={"url": url, "secret": SECRET},
        )  # fmt: skip
        session.add(job)
        session.flush()
        webhooks.enqueue(session, job)


def delivery(database):
    with database.read() as session:
        return session.query(Delivery).one()


def make_due(database):
    with database.write() as session:
        session.query(Delivery).one().next_try = now()


def test_end_of_a_job_is_told_once_and_signed(database, stub):
    end_job(database, f"{stub.origin}/hook?a=1")
    settings = Settings(webhooks=True, webhook_allow=(stub.origin,))
    for _ in range(2):
        webhooks.deliver_due(database, settings)
    [(path, headers, body)] = stub.told
    assert path == "/hook?a=1"
    said = json.loads(body)
    assert (said["job"], said["state"], said["name"]) == ("job_1", "done", "yard")
    expected = webhooks.signature(SECRET, said["delivery"], headers["Webhook-Timestamp"], body)
    assert headers["Webhook-Signature"] == expected
    assert headers["Webhook-Id"] == said["delivery"]
    assert delivery(database).status == "delivered"


def test_failed_delivery_is_tried_again_and_given_up_at_last(database, stub):
    stub.answers = [500, 302, 404, 500, 500]
    end_job(database, f"{stub.origin}/hook")
    settings = Settings(webhooks=True, webhook_allow=(stub.origin,))
    for number in range(webhooks.TRIES):
        webhooks.deliver_due(database, settings)
        assert len(stub.told) == number + 1, "it waits for its time"
        assert delivery(database).status == ("retrying" if number < webhooks.TRIES - 1 else "given up")
        if number < webhooks.TRIES - 1:
            assert delivery(database).next_try > now()
            make_due(database)
    assert delivery(database).message == "answered 500"
    assert {path for path, _, _ in stub.told} == {"/hook"}, "redirects are not followed"


@pytest.mark.parametrize(
    "url",
    [
        "http://example.org/", "ftp://example.org/", "https://user:pass@example.org/", "https://", "example.org",
        "https://[::1", "https://example.org:0/", "https://example.org:99999/", "file:///etc/passwd",
    ],
)  # fmt: skip
def test_addresses_of_other_kinds_are_refused(url):
    with pytest.raises(InputError):
        webhooks.check_url(url, ())


@pytest.mark.parametrize(
    "address",
    [
        "127.0.0.1", "10.0.0.1", "172.16.3.4", "192.168.1.1", "169.254.169.254", "0.0.0.0", "100.64.0.1",
        "192.0.0.8", "192.0.2.1", "192.88.99.1", "198.19.0.1", "198.51.100.1", "203.0.113.1",
        "224.0.0.1", "240.0.0.1", "255.255.255.255", "::", "::1", "::10.0.0.1", "::8.8.8.8", "::ffff:127.0.0.1",
        "::ffff:10.1.2.3", "::ffff:8.8.8.8", "::ffff:0:10.0.0.1", "64:ff9b::7f00:1", "64:ff9b:1::a00:1", "100::1",
        "2001::1", "2001:0:4136:e378:8000:63bf:3fff:fdd2", "2001:20::1", "2001:db8::1", "2002:7f00:1::1", "3fff::1",
        "5f00::1", "fc00::1", "fd12:3456::1", "fe80::1", "fe80::1%lo", "fec0::1", "ff02::1", "ff0e::1",
        "2a00:1450::5efe:10.0.0.1", "2a00:1450::200:5efe:a00:1",
    ],
)  # fmt: skip
def test_address_that_is_not_public_is_never_connected_to(address, database, monkeypatch):
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    monkeypatch.setattr(
        socket, "getaddrinfo", lambda *_, **__: [(family, socket.SOCK_STREAM, 6, "", (address, 443))]
    )
    connected = []
    monkeypatch.setattr(socket, "create_connection", lambda *words, **_: connected.append(words))
    end_job(database, "https://innocent.example/hook")
    webhooks.deliver_due(database, Settings(webhooks=True))
    assert connected == []
    assert delivery(database).status == "retrying"
    assert delivery(database).message == "its host is not public"


def test_connection_goes_to_the_address_that_was_checked(database, monkeypatch):
    answers = iter(["93.184.216.34", "127.0.0.1"])
    monkeypatch.setattr(
        socket,
        "getaddrinfo",
        lambda *_, **__: [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (next(answers), 443))],
    )
    connected = []

    def connect(address, *_):
        connected.append(address)
        raise OSError

    monkeypatch.setattr(socket, "create_connection", connect)
    end_job(database, "https://turncoat.example/hook")
    webhooks.deliver_due(database, Settings(webhooks=True))
    assert connected == [("93.184.216.34", 443)]


@pytest.mark.parametrize("address", ["93.184.216.34", "8.8.8.8", "2606:4700::1111", "2a00:1450:4001::200e"])
def test_address_of_the_internet_is_public(address):
    assert is_public(address)


class Drip:
    """A receiver that answers a byte at a time, and never comes to an end."""

    def __init__(self):
        self.line = socket.create_server(("127.0.0.1", 0))
        self.origin = f"http://127.0.0.1:{self.line.getsockname()[1]}"
        self.came = 0
        threading.Thread(target=self.accept, daemon=True).start()

    def accept(self):
        with suppress(OSError):
            while True:
                line, _ = self.line.accept()
                self.came += 1
                threading.Thread(target=self.drip, args=(line,), daemon=True).start()

    def drip(self, line):
        with suppress(OSError), line:
            line.sendall(b"HTTP/1.1 200 OK\r\nX: ")
            while True:
                line.sendall(b"x")
                time.sleep(0.1)


def test_receivers_that_drip_stop_neither_others_nor_the_one_who_tells(database, stub):
    drip = Drip()
    urls = [f"{drip.origin}/{number}" for number in range(6)] + [f"{stub.origin}/hook"]
    with database.write() as session:
        session.add(Dataset(id="ds_1", owner="x", name="x", state="ready", created=0, updated=0))
        session.flush()
        for number, url in enumerate(urls):
            job = Job(
                id=f"job_{number}", owner="x", name="yard", dataset_id="ds_1", config={}, state="done",
                created=0, updated=0, webhook={"url": url, "secret": SECRET},
            )  # fmt: skip
            session.add(job)
            session.flush()
            webhooks.enqueue(session, job)
    allow = (drip.origin, stub.origin)
    messenger = webhooks.Messenger(
        database, Settings(webhooks=True, webhook_allow=allow, webhook_timeout_s=2.0)
    )
    messenger.start()
    end, first = time.monotonic() + 60, None
    while True:
        with database.read() as session:
            rows = {row.job_id: (row.status, row.message) for row in session.query(Delivery)}
        if stub.told and first is None:
            first = dict(rows)
        if all(message for _, message in list(rows.values())[:6]):
            break
        assert time.monotonic() < end, rows
        time.sleep(0.05)
    messenger.stop()
    drip.line.close()
    assert rows.pop("job_6") == ("delivered", "")
    assert set(rows.values()) == {("retrying", "took too long")}
    assert "" in {first[name][1] for name in rows}, "it was told while others dripped"


def test_one_address_among_several_that_is_not_public_is_enough(monkeypatch):
    found = [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (a, 443)) for a in ("93.184.216.34", "10.0.0.1")]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: found)
    with pytest.raises(InputError):
        webhook_delivery.public_address("two.example", 443)


def test_server_without_webhooks_refuses_them(service, ready_dataset):
    hook = {"url": "https://example.org/", "secret": SECRET}
    answer = service.http.post("/v1/jobs", json={"dataset": ready_dataset, "webhook": hook})
    assert answer.status_code == 422
    assert "webhooks are switched off" in answer.json()["detail"]
