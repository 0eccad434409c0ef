"""The systemd units: what systemd itself says of them, and their processes, started by their own commands."""

import os
import re
import shlex
import ssl
import subprocess
import sys
from pathlib import Path

import httpx
import pytest
from deployed import DEPLOY, Host, read_settings, wait_for
from programs import program_or_skip

UNITS = ["lvba-serve.service", "lvba-scheduler.service", "lvba-worker@.service"]


def assignments(unit, *drop_ins):
    """Every assignment of a unit and its drop-ins, in order: (name, value)."""
    found = []
    for file in (DEPLOY / "systemd" / unit, *(DEPLOY / "systemd" / f"{unit}.d" / name for name in drop_ins)):
        text = re.sub(r"\\\n\s*", " ", file.read_text())
        lines = [line for line in text.splitlines() if line and line[0] not in "#["]
        found += [tuple(line.split("=", 1)) for line in lines]
    return found


def environment(unit, *drop_ins):
    """What the processes of a unit get, with the settings of the example."""
    found = {}
    for name, value in assignments(unit, *drop_ins):
        if name == "Environment":
            found |= dict(word.split("=", 1) for word in shlex.split(value))
    return found | read_settings(DEPLOY / "lvba.env.example")


def command(unit, *drop_ins):
    """The words of ExecStart."""
    variables = environment(unit, *drop_ins)
    words = dict(assignments(unit))["ExecStart"].split()
    return [re.sub(r"\$\{(\w+)\}", lambda found: variables[found[1]], word) for word in words]


@pytest.fixture
def installed(tmp_path):
    """Folder of the units, with their drop-ins, whose programs are here."""
    for file in (DEPLOY / "systemd").rglob("*.*"):
        if file.is_file():
            copy = tmp_path / file.relative_to(DEPLOY / "systemd")
            copy.parent.mkdir(exist_ok=True)
            # one that is started several times has a number
            copy = copy.with_name(copy.name.replace("@.", "@1."))
            copy.write_text(file.read_text().replace("/opt/lvba/bin", str(Path(sys.executable).parent)))
    return tmp_path


@pytest.mark.parametrize("unit", UNITS)
def test_systemd_finds_nothing_wrong_and_little_that_is_open(installed, unit):
    analyze, file = (
        program_or_skip("systemd-analyze", package="systemd"),
        installed / unit.replace("@.", "@1."),
    )
    verified = subprocess.run([analyze, "verify", file], capture_output=True, text=True)
    assert (verified.returncode, verified.stderr) == (0, "")
    words = [analyze, "security", "--offline=true", "--threshold=15", "--no-pager", file]
    exposed = subprocess.run(words, capture_output=True, text=True)
    assert exposed.returncode == 0, exposed.stdout


def test_a_mistake_in_a_unit_is_found(installed):
    file = installed / UNITS[0]
    file.write_text(file.read_text().replace("ProtectSystem=strict", "ProtectSystem=very"))
    words = [program_or_skip("systemd-analyze", package="systemd"), "verify", file]
    assert "protect system value" in subprocess.run(words, capture_output=True, text=True).stderr


@pytest.mark.parametrize("unit", UNITS)
def test_units_start_again_whatever_happened_and_read_the_same_settings(unit):
    values = dict(assignments(unit))
    assert values["Restart"] == "always"
    assert values["EnvironmentFile"] == "-/etc/lvba/lvba.env"
    assert "StartLimitIntervalSec" in values, "no end of starting again"


@pytest.fixture(scope="module")
def host(tmp_path_factory):
    host = Host(tmp_path_factory.mktemp("units"))
    tls = host.folder / "tls"
    words = ["sh", DEPLOY / "tls.sh", tls, host.address("web")]
    subprocess.run(words, check=True, capture_output=True)
    host.replaced = {
        "/opt/lvba/bin": Path(sys.executable).parent,
        "/etc/lvba/tls": tls,
        "/var/log/nginx": host.folder,
        "lvba.example.org": host.address("web"),
        "/var/lib/lvba": host.folder / "data",
        "/var/cache/lvba": host.folder / "cache",
        "%d": tls / "cluster",
    }
    yield host
    host.end()


def test_units_make_a_service_on_a_cluster(host):
    started = {}
    for unit, *drop_ins in ((UNITS[0], "cluster.conf"), (UNITS[1],), (UNITS[2],)):
        given = environment(unit, *drop_ins) | {"NUMBA_CACHE_DIR": ""}
        started[unit] = host.start("machine", command(unit, *drop_ins), given)
    service, scheduler, worker = started.values()
    wait_for(lambda: "serving http" in service[1].read_text(), *service)
    wait_for(lambda: "working for" in worker[1].read_text(), *worker)
    base = f"http://{host.address('machine')}"
    assert httpx.get(f"{base}:8787/health").text == "ok"
    for path in ("/status", "/json/counts.json", "/info/main/workers.html", "/metrics"):
        assert httpx.get(f"{base}:8787{path}").status_code == 404, path
    assert httpx.get(f"{base}:8080/readyz").json() == {"status": "ready"}
    assert httpx.get(f"{base}:8080/v1/me").status_code == 401
    assert (host.folder / "data" / "lvba.sqlite").exists()
    for process, log in (service, worker):
        process.terminate()
        assert process.wait() == 0, log.read_text()
    assert scheduler[0].poll() is None


def test_drop_in_for_postgres_reads_the_url_from_a_credential():
    values = assignments(UNITS[0], "postgres.conf")
    assert ("LoadCredential", "database_url:/etc/lvba/database_url") in values
    assert environment(UNITS[0], "postgres.conf")["LVBA_DATABASE_FILE"] == "%d/database_url"


MAIN_CONFIGURATION = """\
daemon off;
pid {folder}/nginx.pid;
error_log stderr warn;
events {{}}
http {{
    client_body_temp_path {folder}/body;
    proxy_temp_path {folder}/proxy;
    fastcgi_temp_path {folder}/fastcgi;
    uwsgi_temp_path {folder}/uwsgi;
    scgi_temp_path {folder}/scgi;
    include {folder}/lvba.conf;
}}
"""


def start_nginx(host):
    """nginx as Debian starts it, with the site for the units in its conf.d."""
    program = program_or_skip("nginx", package="nginx-light")
    site = (DEPLOY / "systemd" / "nginx-lvba.conf").read_text()
    # the service is at the address of its machine, the proxy at one of its own
    site = site.replace("127.0.0.1:8080", f"{host.address('machine')}:8080")
    # ports that need no root
    for port, free in (("80", "8080"), ("443", "8443")):
        site = site.replace(f"listen {port}", f"listen {host.address('web')}:{free}")
    (host.folder / "lvba.conf").write_text(host.here(site, "web"))
    (host.folder / "nginx.conf").write_text(MAIN_CONFIGURATION.format(folder=host.folder))
    words = [program, "-e", "stderr", "-c", str(host.folder / "nginx.conf")]
    return host.start("web", [*words, "-g", "user root;"] if os.getuid() == 0 else words, {})


def test_site_of_nginx_puts_tls_before_the_service_of_the_unit(host):
    service = host.start("machine", command(UNITS[0]), environment(UNITS[0]) | {"NUMBA_CACHE_DIR": ""})
    wait_for(lambda: "serving http" in service[1].read_text(), *service)
    proxy = start_nginx(host)
    name, ca = host.address("web"), str(host.folder / "tls" / "web" / "ca.pem")

    def asked(path, **options):
        return httpx.get(
            f"https://{name}:8443{path}", verify=ssl.create_default_context(cafile=ca), **options
        )

    wait_for(lambda: (host.folder / "nginx.pid").exists(), *proxy)
    assert asked("/readyz").json() == {"status": "ready"}
    assert asked("/metrics").status_code == 404
    assert httpx.get(f"http://{name}:8080/v1/me").headers["location"] == f"https://{name}/v1/me"
    place = {"LVBA_DATA": environment(UNITS[0])["LVBA_DATA"]}
    key = host.run("machine", ["lvba", "admin", "key", "create", "survey"], place).stdout.strip()
    assert asked("/v1/me?x=1", headers={"Authorization": f"Bearer {key}"}).json()["owner"] == "survey"
    assert "x=1" not in (host.folder / "lvba.log").read_text(), "what stands after ? may be a ticket"
    jobs = ["lvba", "jobs", "--server", f"https://{name}:8443"]
    assert host.run("web", jobs, {"LVBA_KEY": key, "SSL_CERT_FILE": ca}).stderr == ""
    assert "CERTIFICATE_VERIFY_FAILED" in host.run("web", jobs, {"LVBA_KEY": key}, code=None).stderr.upper()
