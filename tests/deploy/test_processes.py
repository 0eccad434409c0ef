"""The processes of compose.yaml, by its commands and its environment, without containers: they work together."""

import hashlib
import json
import os
import re
import socket
import ssl
import subprocess

import httpx
import pytest
from deployed import DEPLOY, Host, compose, read_settings, wait_for
from programs import program_or_skip
from real_server import ended, postgres_or_skip, submit, upload


class Deployment:
    """Everything that compose.yaml starts; the database is a PostgreSQL of the tests."""

    def __init__(self, folder):
        self.host = Host(folder)
        self.services = compose()["services"]
        (folder / "recordings").mkdir()
        self.host.replaced = {
            "/opt/lvba/deploy": DEPLOY,
            "/etc/nginx/nginx.conf": folder / "nginx.conf",
            "tls://scheduler": f"tls://{self.host.address('scheduler')}",
            "http://service": f"http://{self.host.address('service')}",
            **{path: f"{folder}{path}" for path in ("/data", "/secrets", "/tls", "/recordings")},
        }

    def start(self, database):
        """All of them; each waits for the others by itself."""
        folder = self.host.folder
        self._prepare(folder, database)
        workers = int(self.services["worker"]["deploy"]["replicas"])
        started = [self._start(name) for name in ["scheduler", "service", *["worker"] * workers]]
        self._start_proxy(folder)
        for one in started:
            self._wait_for_health(*one)
        self.scheduler, self.workers = started[0][1], [log for name, _, log in started if name == "worker"]
        self.web = f"https://{self.host.address('proxy')}:8443"
        self.ca = ssl.create_default_context(cafile=folder / "tls" / "web" / "ca.pem")
        self.http = self.client(self.key("survey", "read,submit"))

    def environment(self, name):
        """What a container of this name gets."""
        service = self.services[name]
        shared = read_settings(DEPLOY / "lvba.env.example") if "env_file" in service else {}
        return shared | service.get("environment", {})

    def _prepare(self, folder, database):
        for name in ("data", "secrets"):
            (folder / name).mkdir()
        names = {"LVBA_NAMES": f"{self.host.address('proxy')} lvba.example.org"}
        environment = self.environment("prepare") | names
        self.host.run("prepare", self.services["prepare"]["command"], environment)
        url = folder / "secrets" / "database_url"
        password = (folder / "secrets" / "postgres_password").read_text().strip()
        assert url.read_text() == f"postgresql://lvba:{password}@database/lvba\n"
        assert re.fullmatch("[0-9a-f]{64}", password)
        url.write_text(database + "\n")

    def _start(self, name):
        return name, *self.host.start(name, self.services[name]["command"], self.environment(name))

    def _wait_for_health(self, name, process, log):
        wait_for(lambda: self._healthy(name, log), process, log)

    def start_scheduler_again(self):
        """As after a power failure, by whatever supervises it."""
        self.scheduler.kill()
        self.scheduler.wait()
        name, self.scheduler, log = self._start("scheduler")
        self._wait_for_health(name, self.scheduler, log)

    def _healthy(self, name, log):
        check = self.services[name]["healthcheck"]
        if "test" in check:
            return self.host.run(name, check["test"][1:], {}, code=None).returncode == 0
        return "working for" in log.read_text()

    def _start_proxy(self, folder):
        text = (DEPLOY / "proxy" / "nginx.conf").read_text()
        text = re.sub(r"listen (\d+)", rf"listen {self.host.address('proxy')}:\1", text)
        text = self.host.here(text.replace("/tmp/", f"{folder}/"))
        (folder / "nginx.conf").write_text(text)
        service = self.services["proxy"]
        words = [program_or_skip("nginx", package="nginx-light"), *service["command"]]
        # as root its workers would become another user, who cannot look into the folders of the tests
        words += ["-g", "user root;"] if os.getuid() == 0 else []
        process, log = self.host.start("proxy", words, {})
        url = self.host.here(service["healthcheck"]["test"][-1], "proxy")
        wait_for(lambda: answers(url), process, log)

    def key(self, owner, scopes):
        """A new key, made as an administrator does it."""
        words = ["lvba", "admin", "key", "create", owner, "--scopes", scopes]
        return self.host.run("admin", words, self.environment("service")).stdout.strip()

    def client(self, key, base=None):
        """Somebody with a key, who comes through the proxy."""
        headers = {"Authorization": f"Bearer {key}"}
        return httpx.Client(base_url=base or self.web, verify=self.ca, headers=headers, timeout=60)


def answers(url):
    try:
        return httpx.get(url).is_success
    except httpx.TransportError:
        return False


@pytest.fixture(scope="module")
def deployment(tmp_path_factory):
    postgres = postgres_or_skip()
    folder = tmp_path_factory.mktemp("deployment")
    made = Deployment(folder)
    try:
        made.start(postgres.new_database())
        yield made
    finally:
        made.host.end()
        postgres.stop()


def test_recording_is_solved_by_the_workers_with_the_bytes_of_one_process(
    deployment, tiny_recording, tiny_result
):
    dataset = upload(deployment.http, tiny_recording)
    with deployment.http.stream("GET", "/v1/events?after=0") as stream:
        job = submit(deployment.http, dataset)
        # a proxy that gathers answers before it passes them on would keep the first ones back
        states = (line for line in stream.iter_lines() if line.startswith('data: {"id"'))
        first = json.loads(next(states).removeprefix("data: "))
        assert first["job"] == job["id"]
    job = ended(deployment.http, job["id"])
    assert job["state"] == "done", job["error"]
    assert len(job["attempts"]) == 1
    assert "on workers" in deployment.http.get(f"/v1/jobs/{job['id']}/logs").json()["text"]
    for name in ("map.ply", "lidar_poses.txt", "image_poses.txt", "exposures.csv"):
        found = deployment.http.get(f"/v1/jobs/{job['id']}/results/{name}").content
        assert found == (tiny_result / name).read_bytes(), name


def test_uploads_are_as_large_as_the_service_takes_them(deployment):
    dataset = deployment.http.post("/v1/datasets", json={"name": "large"}).json()["id"]
    content = os.urandom(5_000_000)
    path = f"/v1/datasets/{dataset}/files/all_image/1.png"
    assert deployment.http.put(path, content=content).status_code == 201
    assert deployment.http.head(path).headers["upload-digest"] == hashlib.sha256(content).hexdigest()


def test_proxy_speaks_tls_only_and_keeps_figures_to_the_inside(deployment):
    plain = httpx.get(f"http://{deployment.host.address('proxy')}:8080/v1/me?x=1")
    assert plain.status_code == 308
    assert plain.headers["location"] == f"https://{deployment.host.address('proxy')}/v1/me?x=1"
    page = deployment.http.get("/", headers={"Accept": "text/html"})
    assert page.headers["strict-transport-security"] == "max-age=31536000"
    assert "default-src 'self'" in page.headers["content-security-policy"]
    assert httpx.get(f"{deployment.web}/v1/me", verify=deployment.ca).status_code == 401
    figures = deployment.key("prometheus", "metrics")
    assert deployment.client(figures).get("/metrics").status_code == 404
    inside = deployment.client(figures, f"http://{deployment.host.address('service')}:8080")
    assert "lvba_supervisor_up 1.0" in inside.get("/metrics").text
    with pytest.raises(httpx.ConnectError, match="certificate verify failed"):
        httpx.get(f"{deployment.web}/healthz")


def test_nobody_joins_the_cluster_without_its_certificate(deployment, tmp_path):
    subprocess.run(["sh", DEPLOY / "tls.sh", tmp_path / "tls", "localhost"], check=True, capture_output=True)
    ours, other = deployment.host.folder / "tls" / "cluster", tmp_path / "tls" / "cluster"
    assert greets(deployment, ours)
    assert not greets(deployment, other)
    assert not greets(deployment, None)


def greets(deployment, folder):
    """Whether the scheduler says something to who has the certificate in a folder."""
    context = ssl.create_default_context(cafile=deployment.host.folder / "tls" / "cluster" / "ca.pem")
    context.check_hostname = False
    if folder is not None:
        context.load_cert_chain(folder / "node.pem", folder / "node.key")
    address = (deployment.host.address("scheduler"), 8786)
    try:
        with socket.create_connection(address, 30) as plain, context.wrap_socket(plain) as secure:
            return len(secure.recv(8)) == 8
    except (ssl.SSLError, ConnectionError):
        return False


def test_workers_join_the_next_scheduler(deployment):
    deployment.start_scheduler_again()
    for log in deployment.workers:
        wait_for(lambda log=log: log.read_text().count("working for") == 2)


def test_what_workers_are_shown_is_enough_and_holds_no_keys(deployment):
    """Folders of /data other than those that compose.yaml gives to workers are the service's alone."""
    shown = {
        volume["target"] for volume in deployment.services["worker"]["volumes"] if isinstance(volume, dict)
    }
    assert shown == {"/data/datasets", "/data/jobs"}
    there = {path.name for path in (deployment.host.folder / "data").iterdir()}
    assert there == {"datasets", "jobs", "secret", "instances", "trash"}
    secrets = [v for v in deployment.services["worker"]["volumes"] if "secrets" in str(v)]
    assert not secrets
    assert not set(deployment.environment("worker"))


def test_prepared_things_stay_when_it_is_started_again(deployment):
    folder = deployment.host.folder
    before = {path: path.read_bytes() for top in ("tls", "secrets") for path in (folder / top).rglob("*.*")}
    environment = deployment.environment("prepare") | {"LVBA_NAMES": "lvba.example.org"}
    deployment.host.run("prepare", deployment.services["prepare"]["command"], environment)
    assert {path: path.read_bytes() for path in before} == before
