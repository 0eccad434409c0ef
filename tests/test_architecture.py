"""The rules of ARCHITECTURE.md that a program can check; layers between packages are import-linter's."""

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from parsed import parsed

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("lvba", "workers", "service")
FILES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
MAX_FILE, MAX_FUNCTION, MEDIAN_FUNCTION = 450, 60, 10


def name(path):
    return path.relative_to(ROOT).as_posix()


def tree(path):
    return parsed(path.read_text())


def functions(path):
    """(name, lines without docstring) of each function."""
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.FunctionDef):
            body = node.body[1:] if ast.get_docstring(node) and len(node.body) > 1 else node.body
            yield node.name, body[-1].end_lineno - body[0].lineno + 1


def imports(path):
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module


def test_files_have_one_subject():
    assert {name(p): n for p in FILES if (n := len(p.read_text().splitlines())) > MAX_FILE} == {}


def test_functions_are_short():
    long = {
        f"{name(path)}:{function}": lines
        for path in FILES
        if "kernels" not in path.parts
        for function, lines in functions(path)
        if lines > MAX_FUNCTION
    }
    assert long == {}
    every = sorted(lines for path in FILES for _, lines in functions(path))
    assert every[len(every) // 2] <= MEDIAN_FUNCTION


@pytest.mark.parametrize("word", ["numba"])
def test_numba_is_in_the_kernels_only(word):
    outside = [p for p in FILES if p.parts[-2] != "kernels" and p.is_relative_to(ROOT / "lvba")]
    allowed = {"lvba/parallel.py"}  # asks how many threads there are
    assert [name(p) for p in outside if word in set(imports(p)) and name(p) not in allowed] == []


def test_no_process_pays_for_the_import_of_distributions():
    """scipy.stats takes a quarter of a start; scipy.special has the functions."""
    pattern = re.compile(r"\bscipy\.stats\b|from scipy import .*\bstats\b")
    assert [name(path) for path in FILES if pattern.search(path.read_text())] == []


def test_a_recording_is_opened_without_the_compiler():
    """Numba would be half of what the check of an upload takes."""
    asked = "import sys, lvba.io.dataset; print(sorted({'numba', 'scipy.interpolate'} & set(sys.modules)))"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True, env=environment)
    assert done.stdout == "[]\n", done.stderr


@pytest.mark.parametrize(
    "pattern", [r"\bos\.environ\b", r"\bgetenv\b", r"^\s*print\(", r"^import time\b|\btime\.time\("]
)
def test_method_reads_no_environment_or_clock_and_prints_nothing(pattern):
    files = [p for p in FILES if p.is_relative_to(ROOT / "lvba")]
    assert [name(p) for p in files if re.search(pattern, p.read_text(), re.MULTILINE)] == []


def test_files_are_opened_in_io_only():
    pattern = re.compile(r"(?<![.\w])open\(|\.(read|write)_(text|bytes)\(|np\.(save|load)\(")
    files = [p for p in FILES if p.is_relative_to(ROOT / "lvba") and p.parent.name != "io"]
    found = [
        name(p)
        for p in files
        for line in p.read_text().splitlines()
        if pattern.search(line) and not re.search(r"\bfiles\.(read|write)_(text|bytes)\(", line)
    ]
    assert found == []


def test_kernels_hold_no_fastmath_without_a_reason():
    """A comment near it, or a constant of its own (`_NAME`) that explains it."""
    bare = []
    for path in [p for p in FILES if p.parent.name == "kernels"]:
        lines = path.read_text().splitlines()
        for number, line in enumerate(lines):
            if re.search(r"fastmath=[^_]", line) and "#" not in "".join(
                lines[max(0, number - 3) : number + 1]
            ):
                bare.append(f"{name(path)}:{number + 1}")
    assert bare == []


def test_makefile_has_the_targets_that_the_readme_names():
    makefile = (ROOT / "Makefile").read_text()
    for target in ("demo", "test", "check", "bench", "install"):
        assert re.search(rf"^{target}:", makefile, re.MULTILINE)


def test_test_files_have_names_of_their_own():
    # without packages, two helpers of one name would be one module; pytest itself keeps its conftest.py apart
    names = [p.name for p in (ROOT / "tests").rglob("*.py") if p.name != "conftest.py"]
    assert sorted(n for n in set(names) if names.count(n) > 1) == []
