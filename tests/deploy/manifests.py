"""The Kubernetes manifests, read as kustomize reads them, and the pods in them."""

import yaml
from deployed import DEPLOY

FOLDER = DEPLOY / "kubernetes"


def kustomization():
    return yaml.safe_load((FOLDER / "kustomization.yaml").read_text())


def resources():
    """All objects of the files that kustomization.yaml names."""
    return [
        item
        for name in kustomization()["resources"]
        for item in yaml.safe_load_all((FOLDER / name).read_text())
    ]


def pods():
    """Name of each workload -> its pod template."""
    found = {}
    for item in resources():
        spec = item.get("spec", {})
        spec = spec.get("jobTemplate", {}).get("spec", spec)
        if "template" in spec:
            found[item["metadata"]["name"]] = spec["template"]
    return found


def containers(pod):
    return pod["spec"].get("initContainers", []) + pod["spec"]["containers"]


def generated():
    """Names of the settings and secrets that kustomize makes -> their keys."""
    found = {
        "settings": [item.partition("=")[0] for item in kustomization()["configMapGenerator"][0]["literals"]]
    }
    for item in kustomization()["secretGenerator"]:
        found[item["name"]] = [file.partition("=")[0].rpartition("/")[2] for file in item["files"]]
    return found
