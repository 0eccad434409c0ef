"""The Kubernetes manifests: valid, closed, and everything that they name is there."""

from datetime import UTC, datetime

import kubernetes_validate
import pytest
import yaml
from deployed import compose
from manifests import FOLDER, containers, generated, kustomization, pods, resources


@pytest.mark.parametrize("version", ["1.30", kubernetes_validate.latest_version()])
def test_every_object_is_valid(version):
    for item in resources():
        kubernetes_validate.validate(item, version, strict=True)


def test_a_mistake_is_found():
    [item] = [item for item in resources() if item["kind"] == "PodDisruptionBudget"]
    item["spec"]["maxUnavailible"] = 1
    with pytest.raises(kubernetes_validate.ValidationError):
        kubernetes_validate.validate(item, "1.30", strict=True)


def test_every_file_is_applied_but_what_needs_an_operator():
    files = {path.name for path in FOLDER.glob("*.yaml")} - {"kustomization.yaml"}
    assert files - set(kustomization()["resources"]) == {"service-monitor.yaml"}


def test_pods_are_as_closed_as_the_restricted_profile_asks():
    for name, pod in pods().items():
        spec = pod["spec"]
        assert spec["automountServiceAccountToken"] is False, name
        # else the names of Services would become settings, such as LVBA_PORT
        assert spec["enableServiceLinks"] is False, name
        assert spec["securityContext"]["runAsNonRoot"] is True
        assert spec["securityContext"]["runAsUser"] >= 999
        assert spec["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
        for container in containers(pod):
            context = container["securityContext"]
            assert context["allowPrivilegeEscalation"] is False
            assert context["readOnlyRootFilesystem"] is True
            assert context["capabilities"] == {"drop": ["ALL"]}
            assert "memory" in container["resources"]["limits"], name
            assert "memory" in container["resources"]["requests"], name


def test_volumes_secrets_and_settings_are_there():
    claims = {item["metadata"]["name"] for item in resources() if item["kind"] == "PersistentVolumeClaim"}
    templates = {"database"}
    made = generated()
    for name, pod in pods().items():
        volumes = {volume["name"]: volume for volume in pod["spec"]["volumes"]}
        for volume in volumes.values():
            if "persistentVolumeClaim" in volume:
                assert volume["persistentVolumeClaim"]["claimName"] in claims
            if "secret" in volume:
                keys = [item["key"] for item in volume["secret"].get("items", [])]
                assert set(keys) <= set(made[volume["secret"]["secretName"]]), name
        for container in containers(pod):
            mounted = {mount["name"] for mount in container["volumeMounts"]}
            assert mounted <= set(volumes) | templates, name
            for source in container.get("envFrom", []):
                assert source["configMapRef"]["name"] in made


def test_workers_see_recordings_and_results_and_no_secrets():
    pod = pods()["worker"]
    mounts = {mount["mountPath"]: mount for mount in pod["spec"]["containers"][0]["volumeMounts"]}
    assert set(mounts) == {"/data/lvba/datasets", "/data/lvba/jobs", "/tls/cluster", "/tmp"}
    assert mounts["/data/lvba/datasets"]["readOnly"] is True
    assert all(
        path.removeprefix("/data/") == mount["subPath"]
        for path, mount in mounts.items()
        if "subPath" in mount
    )
    assert "env" not in pod["spec"]["containers"][0]


def matching(selector):
    labels = selector.get("matchLabels", {})
    return {name for name, pod in pods().items() if labels.items() <= pod["metadata"]["labels"].items()}


def test_services_and_budgets_find_their_pods():
    for item in resources():
        if item["kind"] == "Service":
            [name] = matching({"matchLabels": item["spec"]["selector"]})
            ports = {
                port["name"]: port["containerPort"]
                for c in containers(pods()[name])
                for port in c.get("ports", [])
            }
            assert {port["targetPort"] for port in item["spec"]["ports"]} <= set(ports)
        if item["kind"] in ("Deployment", "StatefulSet", "PodDisruptionBudget"):
            assert matching(item["spec"]["selector"]), item["metadata"]


def ways():
    """(from, to, port) of all that the policies let through; names of pods, or of what a namespace is labeled."""
    sides = {"ingress": set(), "egress": set()}
    for item in resources():
        if item["kind"] != "NetworkPolicy":
            continue
        own = matching(item["spec"]["podSelector"])
        for side, peers in (("ingress", "from"), ("egress", "to")):
            for rule in item["spec"].get(side, []):
                ports = [port["port"] for port in rule.get("ports", [])] or ["any"]
                others = set().union(*(names(peer) for peer in rule[peers]))
                pairs = [(o, m) if side == "ingress" else (m, o) for m in own for o in others]
                sides[side] |= {(*pair, port) for pair in pairs for port in ports}
    return sides


def names(peer):
    if "namespaceSelector" in peer:
        return set(peer["namespaceSelector"]["matchLabels"])
    return matching(peer["podSelector"])


def test_only_what_is_needed_can_talk_and_both_ends_agree():
    wanted = {
        ("lvba-access", "service", 8080),
        ("service", "database", 5432), ("backup", "database", 5432),
        ("service", "scheduler", 8786), ("worker", "scheduler", 8786),
        ("scheduler", "worker", "any"), ("worker", "worker", "any"),
    }  # fmt: skip
    found = ways()
    assert found["ingress"] == wanted
    out = {way for way in found["egress"] if way[1] != "kubernetes.io/metadata.name"}
    assert out == wanted - {("lvba-access", "service", 8080)}
    [nothing] = [item for item in resources() if item["metadata"]["name"] == "nothing"]
    assert nothing["spec"] == {"podSelector": {}, "policyTypes": ["Ingress", "Egress"]}


def test_image_and_hosts_are_those_of_compose():
    services = compose()["services"]
    for name, pod in pods().items():
        other = services["database" if name == "database" else name]["image"]
        assert {container["image"] for container in containers(pod)} == {other}
    assert {item["name"] for item in kustomization()["images"]} == {"lvba"}
    [backup] = [item for item in resources() if item["kind"] == "CronJob"]
    minute, hour, *_ = backup["spec"]["schedule"].split()
    assert datetime(2026, 1, 1, int(hour), int(minute), tzinfo=UTC)


def test_monitor_asks_the_service_with_a_key():
    monitor = yaml.safe_load((FOLDER / "service-monitor.yaml").read_text())
    [service] = [i for i in resources() if i["kind"] == "Service" and i["metadata"]["name"] == "service"]
    labels = monitor["spec"]["selector"]["matchLabels"]
    assert labels.items() <= service["metadata"]["labels"].items()
    assert monitor["spec"]["endpoints"][0]["port"] == service["spec"]["ports"][0]["name"]
    assert monitor["spec"]["endpoints"][0]["authorization"]["credentials"] == {
        "name": "metrics-key",
        "key": "key",
    }
