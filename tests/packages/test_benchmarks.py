"""Benchmarks find what they measure: each can be loaded by the present code, and what is timed most can be run."""

import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
LOAD = "import importlib, sys; [importlib.import_module(name) for name in sys.argv[1:]]"


def beside_benchmarks(code, *arguments):
    """The finished process that ran some code where the benchmarks are."""
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.run(command, cwd=BENCHMARKS, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("group", ["bench_*.py", "[!b]*.py"])
def test_benchmarks_load(group):
    names = sorted(path.stem for path in BENCHMARKS.glob(group))
    assert names
    loaded = beside_benchmarks(LOAD, *names)
    assert loaded.returncode == 0, loaded.stderr


def test_photometric_sums_can_be_timed():
    call = "import bench_photometric as b; print(len(b.run(patches=(7,), channels=(1,))['rows']))"
    done = beside_benchmarks(call)
    assert done.stdout.strip() == "1", done.stderr
