"""What compose file, units and manifests have in common: the same commands, settings that exist, one list of them."""

import dataclasses
import re

import pytest
from deployed import DEPLOY, compose, read_settings
from distributed.cli.dask_scheduler import main as dask_scheduler
from manifests import containers, generated, pods
from test_units import UNITS, command, environment

from service.cli import main
from service.settings import Limits, Settings, load

EXAMPLE = DEPLOY / "lvba.env.example"
NOT_OF_THE_SERVICE = {
    "LVBA_NAMES", "LVBA_TLS", "LVBA_SECRETS", "LVBA_CLUSTER_WORKERS", "LVBA_WORKER_THREADS", "LVBA_WORKER_MEMORY",
    "LVBA_SCHEDULER_HOST", "LVBA_IMAGE", "LVBA_HTTP_PORT", "LVBA_HTTPS_PORT", "LVBA_SERVICE_MEMORY",
    "LVBA_DATABASE_MEMORY", "LVBA_RECORDINGS", "LVBA_BACKUP", "LVBA_WEB_SUBNET",
}  # fmt: skip
"""Read by scripts, compose.yaml and units alone."""


def commands():
    """Where -> the words of every command of ours."""
    found = {f"compose {name}": service.get("command") for name, service in compose()["services"].items()}
    found |= {f"systemd {unit}": command(unit) for unit in UNITS}
    found |= {f"kubernetes {name}": containers(pod)[-1].get("args") for name, pod in pods().items()}
    return {where: words for where, words in found.items() if words and words[0] != "-c"}


def part(words):
    """Which part of the program a command is, and its options without their values."""
    options = {word.partition("=")[0] for word in words if word.startswith("--")}
    return " ".join([words[0].rpartition("/")[2], words[1]]), options


@pytest.mark.parametrize("where", commands())
def test_command_is_understood(where):
    words = commands()[where]
    program, _ = part(words)
    if program.startswith("lvba "):
        main.parser().parse_args(words[1:])
    elif program == "dask scheduler":
        known = [each.opts + each.secondary_opts for each in dask_scheduler.params]
        assert part(words)[1] <= {option for options in known for option in options}
    else:
        script = words[1].removeprefix("/opt/lvba/deploy/")
        assert words[0] == "sh"
        assert (DEPLOY / script).is_file()
        assert f"deploy/{script} " in (DEPLOY / "Containerfile").read_text()


def test_same_parts_have_the_same_options_everywhere():
    found = {}
    for where, words in commands().items():
        if words[0] != "sh":
            program, options = part(words)
            found.setdefault(program, {})[where] = options
    assert set(found) == {"lvba serve", "lvba worker", "dask scheduler"}
    for program, options in found.items():
        assert len(options) == 3, program
        assert len({frozenset(one) for one in options.values()}) == 1, options


def settings_of_the_service():
    """Where -> environment of `lvba serve`."""
    service = containers(pods()["service"])[0]
    yield "compose", compose()["services"]["service"]["environment"] | read_settings(EXAMPLE)
    yield "systemd", environment(UNITS[0], "cluster.conf", "postgres.conf")
    given = dict(item.partition("=")[::2] for item in generated_lines())
    yield "kubernetes", given | {item["name"]: item["value"] for item in service["env"]}


def generated_lines():
    from manifests import kustomization

    assert "settings" in generated()
    return kustomization()["configMapGenerator"][0]["literals"]


def known():
    fields = {f"LVBA_{field.name.upper()}" for field in dataclasses.fields(Settings)}
    limits = {f"LVBA_LIMITS_{field.name.upper()}" for field in dataclasses.fields(Limits)}
    return fields | limits | {f"{name}_FILE" for name in fields}


@pytest.mark.parametrize(
    ("where", "given"), list(settings_of_the_service()), ids=lambda value: value if value else ""
)
def test_settings_exist_and_can_be_meant(where, given, tmp_path):
    ours = {name for name in given if name.startswith("LVBA_")}
    assert ours - known() <= NOT_OF_THE_SERVICE, ours - known() - NOT_OF_THE_SERVICE
    url = tmp_path / "url"
    url.write_text("postgresql://lvba:x@database/lvba")
    settings = load({}, given | {"LVBA_DATABASE_FILE": str(url)})
    assert settings.asks_for_keys
    assert settings.scheduler.startswith("tls://")
    assert None not in (settings.tls_ca, settings.tls_cert, settings.tls_key)
    assert settings.database.startswith("postgresql://")


def test_example_has_every_setting_of_the_compose_file_with_its_default():
    wanted = dict(re.findall(r"\$\{(\w+):-([^}]*)\}", (DEPLOY / "compose.yaml").read_text()))
    assert "${" not in re.sub(r"\$\{\w+:-[^}]*\}", "", (DEPLOY / "compose.yaml").read_text())
    shown = dict(re.findall(r"^(?:# )?(LVBA_\w+)=\"?([^\"\n]*)", EXAMPLE.read_text(), re.M))
    assert set(wanted) <= set(shown)
    assert set(shown) <= set(wanted) | known() | NOT_OF_THE_SERVICE
    for name in set(wanted) - {"LVBA_NAMES"}:
        assert shown[name] == wanted[name], name


def test_outside_reaches_the_proxy_alone_and_the_inside_has_no_way_out():
    deployment = compose()
    services, networks = deployment["services"], deployment["networks"]
    assert [name for name, service in services.items() if "ports" in service] == ["proxy"]
    assert {name for name, network in networks.items() if not network.get("internal")} == {"outside"}
    assert {name: set(service.get("networks", [])) for name, service in services.items()} == {
        "prepare": set(), "database": {"database"}, "scheduler": {"cluster"}, "worker": {"cluster"},
        "service": {"web", "cluster", "database"}, "proxy": {"outside", "web"}, "backup": {"database"},
        "restore": {"database"},
    }  # fmt: skip
    assert services["prepare"]["network_mode"] == "none"


def test_containers_are_closed_limited_and_start_again():
    for name, service in compose()["services"].items():
        once = name in ("prepare", "backup", "restore")
        assert service["restart"] == ("no" if once else "always"), name
        assert service["read_only"] is True
        assert service["cap_drop"] == ["ALL"]
        assert service["security_opt"] == ["no-new-privileges:true"]
        assert service["init"] is True
        assert "healthcheck" in service
        assert once or "memory" in service["deploy"]["resources"]["limits"], name
        if name != "database":
            assert service["user"] == "10001:10001"
            assert "cap_add" not in service


def test_secrets_are_in_files_and_each_is_shown_to_who_needs_it():
    services = compose()["services"]
    for service in services.values():
        for name, value in service.get("environment", {}).items():
            assert not re.search("PASSWORD|SECRET|KEY|DATABASE", name) or value.startswith("/"), name
            assert "@" not in value
    shown = {}
    for name, service in services.items():
        for volume in service["volumes"]:
            if isinstance(volume, str) and volume[0] not in "./$":
                shown.setdefault(volume.partition(":")[0], set()).add(name)
    assert shown == {
        "data": {"prepare", "service", "backup", "restore"}, "database": {"database"},
        "secrets": {"prepare", "database", "service", "backup", "restore"}, "tls-authority": {"prepare"},
        "tls-cluster": {"prepare", "scheduler", "worker", "service"}, "tls-web": {"prepare", "proxy"},
    }  # fmt: skip
    assert set(shown) == set(compose()["volumes"])
