"""Who may do what: keys, owners, scopes, tickets, limits; and what every answer carries."""

from contextlib import ExitStack

import httpx
import pytest
from real_server import Service, upload
from told_events import add_job, tell

from service.db.database import Database
from service.db.tables import Key
from service.system.paths import now


@pytest.fixture(scope="module")
def guarded(tmp_path_factory):
    """A service that asks for keys, and runs nothing."""
    running = Service(
        tmp_path_factory.mktemp("guarded") / "data",
        "--auth",
        "--jobs",
        "0",
        environment={"LVBA_LIMITS_QUEUED_JOBS": "2", "LVBA_LIMITS_OWNER_BYTES": str(100_000_000)},
    )
    yield running
    running.stop()


@pytest.fixture(scope="module")
def ann(guarded):
    return guarded.as_key(guarded.key("ann"))


@pytest.fixture(scope="module")
def ben(guarded):
    return guarded.as_key(guarded.key("ben"))


@pytest.fixture(scope="module")
def anns_dataset(ann, tiny_recording):
    return upload(ann, tiny_recording)


@pytest.mark.parametrize(
    "header",
    [None, "Bearer", "Bearer x", "Bearer lvba_", "Bearer lvba_0123_x", "Basic YTpi", "Bearer lvba_a_b\xff"],
)
def test_without_a_good_key_nothing_is_told(guarded, header):
    headers = {} if header is None else {"Authorization": header.encode("latin-1")}
    answer = httpx.get(guarded.url + "/v1/jobs", headers=headers)
    assert answer.status_code == 401
    assert answer.headers["www-authenticate"] == "Bearer"
    assert answer.json()["code"] == "unauthorized"


def test_what_is_open_to_all_is_little(guarded):
    for path in (
        "/v1/me",
        "/v1/options",
        "/v1/info",
        "/jobs",
        "/metrics",
        "/v1/events",
        "/v1/datasets/ds_0/files/x",
    ):
        assert httpx.get(guarded.url + path).status_code == 401, path
    for path in ("/healthz", "/readyz", "/conformance", "/processes", "/docs", "/openapi.json"):
        assert httpx.get(guarded.url + path).status_code == 200, path


def test_owner_sees_only_what_is_its_own(guarded, ann, ben, anns_dataset):
    job = ann.post("/v1/jobs", json={"dataset": anns_dataset}).json()["id"]
    batch = ann.post("/v1/batches", json={"name": "b", "jobs": [{"dataset": anns_dataset}]}).json()["id"]
    assert ben.get("/v1/jobs").json()["items"] == []
    assert ben.get("/v1/datasets").json()["items"] == []
    assert ben.get("/jobs").json()["jobs"] == []
    reads = [f"/v1/jobs/{job}{rest}" for rest in ("", "/events", "/logs", "/results", "/archive", "/frames")]
    reads += [f"/v1/jobs/{job}/results/map.ply", f"/v1/jobs/{job}/deliveries", f"/v1/batches/{batch}"]
    reads += [
        f"/v1/datasets/{anns_dataset}{rest}" for rest in ("", "/files", "/frames", "/files/config.yaml")
    ]
    reads += [f"/jobs/{job}", f"/jobs/{job}/results"]
    for path in reads:
        assert ben.get(path).status_code == 404, path
        assert ben.get(path).json()["code"] == "not-found"
    for method, path in (
        ("POST", f"/v1/jobs/{job}/cancel"),
        ("POST", f"/v1/jobs/{job}/restart"),
        ("DELETE", f"/v1/jobs/{job}"),
        ("DELETE", f"/jobs/{job}"),
        ("POST", f"/v1/batches/{batch}/cancel"),
        ("DELETE", f"/v1/datasets/{anns_dataset}"),
        ("POST", f"/v1/datasets/{anns_dataset}/finish"),
        ("PUT", f"/v1/datasets/{anns_dataset}/files/x"),
        ("HEAD", f"/v1/datasets/{anns_dataset}/files/config.yaml"),
    ):
        assert ben.request(method, path).status_code == 404, path
    assert ben.patch(f"/v1/jobs/{job}", json={"priority": 1}).status_code == 404
    assert ben.post("/v1/jobs", json={"dataset": anns_dataset}).status_code == 404
    assert (
        ben.post("/processes/lvba/execution", json={"inputs": {"dataset": anns_dataset}}).status_code == 404
    )
    quota = ann.post("/v1/jobs", json={"dataset": anns_dataset})
    assert (quota.status_code, quota.json()["code"]) == (429, "quota")
    assert ann.get(f"/v1/jobs/{job}").json()["state"] == "queued"
    ann.post(f"/v1/jobs/{job}/cancel")
    ann.post(f"/v1/batches/{batch}/cancel")


def test_key_with_fewer_scopes_may_do_less(guarded, anns_dataset):
    reader = guarded.as_key(guarded.key("ann", ["read"]))
    assert reader.get(f"/v1/datasets/{anns_dataset}").status_code == 200
    refused = reader.post("/v1/jobs", json={"dataset": anns_dataset})
    assert (refused.status_code, refused.json()["code"]) == (403, "forbidden")
    assert reader.get("/metrics").status_code == 403
    assert guarded.as_key(guarded.key("prometheus", ["metrics"])).get("/metrics").status_code == 200


def test_revoked_and_expired_keys_are_worth_nothing(guarded, lvba):
    key = lvba("admin", "key", "create", "cleo", "--data", guarded.data).stdout.strip()
    assert guarded.as_key(key).get("/v1/me").json()["owner"] == "cleo"
    ticket = guarded.as_key(key).post("/v1/tickets", json={"path": "/v1/jobs/job_0"}).json()["ticket"]
    lvba("admin", "key", "revoke", key.split("_")[1], "--data", guarded.data)
    assert guarded.as_key(key).get("/v1/me").status_code == 401
    assert httpx.get(f"{guarded.url}/v1/jobs/job_0", params={"ticket": ticket}).status_code == 401
    assert guarded.as_key(guarded.key("cleo", days=0)).get("/v1/me").status_code == 401
    listed = lvba("admin", "key", "list", "--data", guarded.data).stdout
    assert "revoked" in next(line for line in listed.splitlines() if line.startswith(key.split("_")[1]))
    assert key.split("_", 2)[2] not in listed
    assert key.split("_", 2)[2] not in (guarded.data / "lvba.sqlite").read_bytes().decode("latin-1")


def test_ticket_is_good_for_its_path_and_for_reading_only(guarded, ann, anns_dataset):
    path = f"/v1/datasets/{anns_dataset}/files/"
    ticket = ann.post("/v1/tickets", json={"path": path}).json()["ticket"]
    with httpx.Client(base_url=guarded.url, params={"ticket": ticket}) as plain:
        assert plain.get(path + "config.yaml").status_code == 200
        assert plain.get(f"/v1/datasets/{anns_dataset}").status_code == 401
        assert plain.delete(path + "config.yaml").status_code == 401
        assert plain.get("/v1/me").status_code == 401
    for forged in (
        ticket[:-1] + ("0" if ticket[-1] != "0" else "1"),
        ticket.split(".")[0] + ".",
        "x.y",
        "é.é",
    ):
        assert httpx.get(guarded.url + path + "config.yaml", params={"ticket": forged}).status_code == 401
    assert ann.post("/v1/tickets", json={"path": "/v1/me"}).status_code == 422


def test_quota_of_bytes_is_checked_before_the_body(guarded):
    dora = guarded.as_key(guarded.key("dora"))
    dataset = dora.post("/v1/datasets", json={"name": "big"}).json()["id"]
    answer = dora.put(
        f"/v1/datasets/{dataset}/archive", content=b"x", headers={"Upload-Length": str(101_000_000)}
    )
    assert (answer.status_code, answer.json()["code"]) == (429, "quota")


def revoked(session, key):
    key.revoked = now()


def expired(session, key):
    key.expires = now()


def not_for_reading(session, key):
    key.scopes = ["metrics"]


def of_another(session, key):
    key.owner = "somebody"


def test_open_streams_end_with_the_right_to_hear_them(guarded):
    """However it ends; all at once, for the service looks once a second."""
    changes = [revoked, expired, not_for_reading, of_another]
    keys = [guarded.key("eve") for _ in changes]
    database = Database(f"sqlite:///{guarded.data / 'lvba.sqlite'}")
    with ExitStack() as open_streams:
        heard = [
            open_streams.enter_context(guarded.as_key(key).stream("GET", "/v1/events")).iter_bytes()
            for key in [*keys, guarded.key("eve")]
        ]
        assert [next(stream) for stream in heard] == [b": lvba\n\n"] * len(heard)
        with database.write() as session:
            for change, key in zip(changes, keys, strict=True):
                change(session, session.get_one(Key, key.split("_")[1]))
        *ended, kept = heard
        # they end, instead of waiting for events
        assert {change.__name__: list(stream) for change, stream in zip(changes, ended, strict=True)} == {
            change.__name__: [] for change in changes
        }
        tell(database, add_job(database, "eve", state="done"), "log")
        assert next(kept).startswith(b"id: "), "the other key still hears"
    database.close()


def test_restarted_jobs_count_among_those_that_wait(guarded, ann, anns_dataset):
    first = ann.post("/v1/jobs", json={"dataset": anns_dataset}).json()["id"]
    ann.post(f"/v1/jobs/{first}/cancel").raise_for_status()
    waiting = [ann.post("/v1/jobs", json={"dataset": anns_dataset}).json()["id"] for _ in range(2)]
    refused = ann.post(f"/v1/jobs/{first}/restart")
    assert (refused.status_code, refused.json()["code"]) == (429, "quota")
    assert ann.get(f"/v1/jobs/{first}").json()["state"] == "canceled"
    for job in waiting:
        ann.post(f"/v1/jobs/{job}/cancel").raise_for_status()
    assert ann.post(f"/v1/jobs/{first}/restart").status_code == 202
    ann.post(f"/v1/jobs/{first}/cancel").raise_for_status()


@pytest.mark.parametrize("path", ["x" * 300, "x" * 300 + ".js", "assets/" + "x" * 300, "x/" * 3000])
def test_file_of_the_page_with_a_name_too_long_is_none(guarded, path):
    answer = httpx.get(f"{guarded.url}/app/{path}")
    assert (answer.status_code, answer.json()["code"]) == (404, "not-found")


def test_guessing_keys_is_slowed_down(tmp_path):
    # of its own: it takes away for a while what others may guess
    guessed = Service(tmp_path / "data", "--auth", "--jobs", "0")
    client = guessed.as_key("lvba_x_y")
    # nobody on this machine is a proxy, unless the service is told so
    names = [{"X-Forwarded-For": f"10.0.0.{number}"} for number in range(60)]
    assert {client.get("/v1/me", headers=name).status_code for name in names} == {401, 429}
    assert guessed.stop() == 0


def test_every_answer_forbids_other_origins(service):
    for path in ("/", "/v1/jobs", "/none", "/docs", "/app/none"):
        headers = service.http.get(path, headers={"Accept": "text/html"}).headers
        policy = headers["content-security-policy"]
        assert "default-src 'self'" in policy
        assert "unsafe" not in policy
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["referrer-policy"] == "no-referrer"
        assert "access-control-allow-origin" not in headers


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example"},
        {"Host": "evil.example:8080"},
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Sec-Fetch-Site": "cross-site"},
    ],
)
def test_without_keys_pages_of_others_are_refused(service, headers):
    answer = service.http.post("/v1/datasets", json={"name": "x"}, headers=headers)
    assert (answer.status_code, answer.json()["code"]) == (403, "forbidden")


@pytest.mark.parametrize("kind", ["multipart/form-data; boundary=x", "application/x-www-form-urlencoded"])
def test_forms_are_not_taken(service, kind):
    answer = service.http.post("/v1/datasets", content=b"--x\r\n", headers={"Content-Type": kind})
    assert answer.status_code == 415


def test_long_bodies_are_refused_unread(service):
    assert service.http.post("/v1/datasets", content=b" " * 5_000_000).status_code == 413


def test_no_keys_are_needed_on_loopback_only(lvba, tmp_path, guarded):
    assert httpx.get(f"{guarded.url}/v1/me").status_code == 401
    from service.settings import Settings

    assert not Settings().asks_for_keys
    assert Settings(host="0.0.0.0").asks_for_keys
    assert Settings(host="192.168.1.2").asks_for_keys
    assert Settings(auth=True).asks_for_keys


def test_folders_are_registered_below_a_root_only(tmp_path, tiny_recording):
    (tmp_path / "root").mkdir()
    (tmp_path / "root" / "link").symlink_to("/etc")
    service = Service(
        tmp_path / "data", "--jobs", "0", "--root", tmp_path / "root", "--root", tiny_recording.parent
    )
    for folder in (
        "/etc",
        str(tmp_path),
        str(tmp_path / "root" / ".."),
        str(tmp_path / "root" / "link"),
        "root",
    ):
        answer = service.http.post("/v1/datasets", json={"name": "x", "folder": folder})
        assert answer.status_code == 403, folder
    made = service.http.post("/v1/datasets", json={"name": "x", "folder": str(tiny_recording)})
    assert (made.status_code, made.json()["source"]) == (201, "folder")
    from real_server import until

    dataset = until(
        service.http, f"/v1/datasets/{made.json()['id']}", lambda row: row["state"] != "validating"
    )
    assert dataset["state"] == "ready"
    service.http.delete(f"/v1/datasets/{dataset['id']}")
    assert (tiny_recording / "config.yaml").exists()
    service.stop()
