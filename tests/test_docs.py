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
