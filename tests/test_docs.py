"""The pages of docs/: each has one kind and is in the index, links lead somewhere, and the README is short."""

import re
import shlex
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
INDEX = DOCS / "README.md"
PAGES = sorted(page for page in DOCS.glob("*.md") if page != INDEX)
KINDS = {
    "Tutorial": "Tutorial: learn by doing",
    "How-to": "How-to: solve one task",
    "Reference": "Reference: look up facts",
    "Explanation": "Explanation: understand why",
}
TEXTS = [
    *PAGES,
    INDEX,
    *(ROOT / f"{name}.md" for name in ("README", "ARCHITECTURE", "CONTRIBUTING", "CHANGELOG")),
]
LINK = re.compile(r"\]\(([^)\s]+)\)")
MAX_WORDS = 1200


def sections(text: str) -> dict[str, str]:
    """The text below each heading of the second level."""
    parts = re.split(r"(?m)^## ", text)[1:]
    return {part.partition("\n")[0]: part for part in parts}


def anchors(page: Path) -> set[str]:
    headings = re.findall(r"(?m)^#+ (.+)$", page.read_text())
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_page_names_its_one_kind_and_is_in_the_index_below_it(page):
    title, empty, first = page.read_text().split("\n")[:3]
    assert title.startswith("# ")
    assert empty == ""
    named = re.match(r"\*(.+?)\.\* \S", first)
    assert named, f"{page.name}: the third line begins with its kind, as in *Reference.*"
    listed = [kind for kind, text in sections(INDEX.read_text()).items() if f"]({page.name})" in text]
    assert listed == [KINDS[named[1]]]


@pytest.mark.parametrize("page", TEXTS, ids=lambda page: page.name)
def test_links_lead_to_files_and_headings_that_exist(page):
    text = re.sub(r"(?s)```.*?```", "", page.read_text())
    broken = []
    for link in LINK.findall(text):
        if "://" in link:
            continue
        name, _, heading = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        if not target.exists() or (heading and heading not in anchors(target)):
            broken.append(link)
    assert broken == []


CODE = {
    path: path.read_text()
    for package in ("lvba", "workers", "service")
    for path in sorted((ROOT / package).rglob("*.py"))
    if "node_modules" not in path.parts
}
CLASSES: dict[str, list[str]] = {}
for source in CODE.values():
    for each in re.findall(r"(?m)^class (\w+)", source):
        CLASSES.setdefault(each, []).append(source)
NOT_CODE = (".md", ".txt", ".json", ".yaml", ".ply", ".csv", ".html", ".toml")


def missing(text: str) -> list[str]:
    """Of the dotted names and files of code that a text quotes, those that are not there; x stands for any name."""
    gone = []
    for quoted in sorted(set(re.findall(r"`([A-Za-z_][\w./]*[./]\w+)(?:\(.*?\))?`", text))):
        if quoted.endswith(".py") and "/" in quoted and not re.search(r"/(test_)?x(_\w+)?\.py$", quoted):
            there = any((ROOT / base / quoted).exists() for base in ("", "lvba", "service", "tests"))
        elif "/" in quoted or quoted.endswith((".py", *NOT_CODE)):
            continue
        else:
            there = _is_named(quoted.removeprefix("lvba.").split("."))
        gone += [] if there else [quoted]
    return gone


def _is_named(parts: list[str]) -> bool:
    """Whether a module, package or class has all that follows; names of other packages are not looked at."""
    first, *rest = parts
    modules = {
        path: source for path, source in CODE.items() if first in (path.stem, *path.relative_to(ROOT).parts)
    }
    sources = list(modules.values()) or CLASSES.get(first, [])
    return not sources or all(
        any(path.stem == part for path in modules)
        or any(re.search(rf"\b{part}\b", source) for source in sources)
        for part in rest
    )


@pytest.mark.parametrize("name", ["ARCHITECTURE.md", "CONTRIBUTING.md", "docs/method.md", "docs/evidence.md"])
def test_names_of_code_in_a_text_are_in_the_code(name):
    assert missing((ROOT / name).read_text()) == []


def test_a_name_that_is_gone_is_noticed():
    assert missing("`plan.Late`, `visual/weak.py`, `lidar.covariance.on_map`") != []
    assert missing("`plan.LazyRef`, `visual/degeneracy.py`, `Border.hessian`, `optim.NormalEquations`") == []


def test_the_readme_is_read_in_one_go():
    assert len((ROOT / "README.md").read_text().split()) <= MAX_WORDS


def test_the_reference_of_commands_is_what_the_parser_knows():
    from service.cli import reference

    mend = "python -m service.cli.reference > docs/cli.md"
    assert (DOCS / "cli.md").read_text() == reference.text(), mend


@pytest.mark.parametrize("page", TEXTS, ids=lambda page: page.name)
def test_commands_in_examples_are_understood(page, capsys):
    """Each `lvba ...` line of an indented example without placeholders in brackets is one that the parser takes."""
    from service.cli.main import parser

    for line in re.findall(r"(?m)^ {4,}lvba (.+)$", page.read_text()):
        words = shlex.split(re.split(r"\s{2,}|\s&$|\.\.\.| #", line)[0])
        if set(line) & set("[|") or "..." in line:
            continue
        try:
            parser().parse_args([_number(words, at) for at in range(len(words))])
        except SystemExit:
            pytest.fail(f"{page.name}: lvba {line}: {capsys.readouterr().err}")


def _number(words: list[str], at: int) -> str:
    """A number in the place of a letter that stands for one, as in `--workers N`."""
    numbers = {"--workers", "--jobs", "--port", "--days", "--keep-days", "--frames"}
    return "2" if at and words[at - 1] in numbers and words[at].isupper() else words[at]
