"""Settings as a deployment gives them: from files, behind a proxy, with limits for workers."""

import httpx
import pytest
from real_server import Service, ended, submit, upload

from lvba.errors import InputError
from service.settings import load

PATIENCE = 2000
"""Requests after which one must have been refused: thirty are allowed at once, and one a second."""


def test_value_comes_from_a_file_where_the_environment_names_one(tmp_path):
    file = tmp_path / "url"
    file.write_text("postgresql://lvba:secret@db/lvba\n")
    environment = {"LVBA_DATABASE_FILE": str(file), "LVBA_LIMITS_ATTEMPTS_FILE": str(file)}
    with pytest.raises(InputError):
        load({}, environment)
    del environment["LVBA_LIMITS_ATTEMPTS_FILE"]
    assert load({}, environment).database == "postgresql://lvba:secret@db/lvba"
    assert load({}, environment | {"LVBA_DATABASE": "sqlite://"}).database == "sqlite://"
    with pytest.raises(InputError, match=r"LVBA_DATABASE_FILE: .* cannot be read"):
        load({}, {"LVBA_DATABASE_FILE": str(tmp_path / "missing")})


def test_proxies_are_addresses_or_networks():
    assert load({}, {"LVBA_PROXIES": "10.1.0.0/16,::2"}).proxies == ("10.1.0.0/16", "::2")
    for wrong in ("proxy", "10.1.0.1/16", "10.1.0.0/40"):
        with pytest.raises(InputError, match="LVBA_PROXIES"):
            load({"proxies": [wrong]}, {})


def guess(http, who):
    """Status of a request with a wrong key, passed on in somebody's name."""
    return http.get("/v1/me", headers={"Authorization": "Bearer x", "X-Forwarded-For": who}).status_code


def test_proxy_is_believed_who_asks_and_nobody_else_is(tmp_path):
    service = Service(tmp_path / "data", "--host", "0.0.0.0", "--proxy", "127.0.0.2/31", "--jobs", "0")
    assert "without TLS" not in service.log.read_text(), "TLS is the proxy's business"
    port = httpx.URL(service.url).port

    def coming_from(address):
        transport = httpx.HTTPTransport(local_address=address)
        return httpx.Client(base_url=f"http://127.0.0.1:{port}", transport=transport)

    with coming_from("127.0.0.2") as proxy, coming_from("127.0.0.9") as stranger:
        assert 429 in (guess(proxy, "10.0.0.1") for _ in range(PATIENCE))
        assert guess(proxy, "10.0.0.2") == 401, "one who guesses keys does not lock out others"
        assert 429 in (guess(stranger, f"10.1.{i // 256}.{i % 256}") for i in range(PATIENCE))
    service.stop()


def test_workers_of_jobs_have_the_memory_that_the_service_gives_them(tiny_recording, tmp_path):
    with pytest.raises(AssertionError, match=r"--memory-limit.* means nothing without --workers"):
        Service(tmp_path / "wrong", "--memory-limit", "8GB")
    service = Service(tmp_path / "data", "--workers", "1", "--memory-limit", "0.1GB")
    job = ended(service.http, submit(service.http, upload(service.http, tiny_recording))["id"])
    assert job["state"] == "failed"
    assert job["error"]["cause"].startswith("--memory-limit 0.1GB: the recording takes about")
    service.stop()


def test_server_that_others_reach_says_that_keys_and_tls_are_missing(tmp_path):
    service = Service(tmp_path / "data", "--host", "0.0.0.0", "--jobs", "0")
    said = service.log.read_text()
    assert (
        "warning: 0.0.0.0 is served without TLS: keys and recordings cross the network as plain text" in said
    )
    assert f"Make one: lvba admin key create NAME --data {tmp_path / 'data'}" in said
    service.key("survey")
    service.stop()
    service.start()
    assert "without TLS" in service.log.read_text()[len(said) :]
    assert "Make one" not in service.log.read_text()[len(said) :]
    service.stop()
