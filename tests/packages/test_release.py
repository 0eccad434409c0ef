"""One version, said once: pyproject.toml has it, and whatever repeats it says the same."""

import json
import re
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
RELEASE = re.compile(r"^## \[(\d+\.\d+\.\d+)\] - (\d{4}-\d{2}-\d{2})$", re.MULTILINE)


@pytest.fixture
def citation():
    return yaml.safe_load((ROOT / "CITATION.cff").read_text())


def test_newest_release_of_the_changelog_is_this_version():
    text = (ROOT / "CHANGELOG.md").read_text()
    assert text.index("## [Unreleased]") < RELEASE.search(text).start()
    releases = RELEASE.findall(text)
    assert releases[0][0] == VERSION
    assert [date for _, date in releases] == sorted((date for _, date in releases), reverse=True)
    assert set(re.findall(r"^### (.*)$", text, re.MULTILINE)) <= {
        "Added", "Changed", "Deprecated", "Removed", "Fixed", "Security",
    }  # fmt: skip


def test_citation_is_of_this_version(citation):
    released = dict(RELEASE.findall((ROOT / "CHANGELOG.md").read_text()))
    assert citation["version"] == VERSION
    assert str(citation["date-released"]) == released[VERSION]
    assert citation["license"] == "Apache-2.0"
    assert citation["cff-version"] == "1.2.0"
    assert all({"title", "authors", "type"} <= set(work) for work in [citation, *citation["references"]])


def test_citation_names_the_papers_of_the_readme(citation):
    license_section = " ".join((ROOT / "README.md").read_text().partition("## License")[2].split())
    for work in citation["references"]:
        assert f'"{work["title"]}"' in license_section
        assert ", ".join(author["family-names"] for author in work["authors"]) in license_section


def test_image_of_the_manifests_has_this_version():
    [image] = yaml.safe_load((ROOT / "deploy/kubernetes/kustomization.yaml").read_text())["images"]
    assert image["newTag"] == VERSION


def test_page_has_no_version_of_its_own():
    folder = ROOT / "service/page_src"
    lock = json.loads((folder / "package-lock.json").read_text())
    assert all("version" not in each for each in (json.loads((folder / "package.json").read_text()), lock))
    assert "version" not in lock["packages"][""]


def test_files_that_contributing_names_exist():
    text = (ROOT / "CONTRIBUTING.md").read_text()
    found = set(re.findall(r"`((?:lvba|workers|service|tests|benchmarks|docs|deploy)/[\w/.]+)`", text))
    assert len(found) > 20
    made_up = {"lvba/kernels/x.py", "service/cli/x_command.py", "lvba/kernels/__pycache__"}
    assert [name for name in sorted(found - made_up) if not (ROOT / name).exists()] == []
