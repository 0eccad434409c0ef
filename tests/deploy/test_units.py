"""The systemd units: what systemd itself says of them, and their processes, started by their own commands."""

import re
import shlex
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
    words = ["sh", DEPLOY / "tls.sh", tls, "localhost"]
    subprocess.run(words, check=True, capture_output=True)
    host.replaced = {
        "/opt/lvba/bin": Path(sys.executable).parent,
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
