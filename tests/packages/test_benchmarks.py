"""Benchmarks find what they measure: each can be loaded by the present code."""

import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
LOAD = "import importlib, sys; [importlib.import_module(name) for name in sys.argv[1:]]"


@pytest.mark.parametrize("group", ["bench_*.py", "[!b]*.py"])
def test_benchmarks_load(group):
    names = sorted(path.stem for path in BENCHMARKS.glob(group))
    assert names
    command = [sys.executable, "-c", LOAD, *names]
    loaded = subprocess.run(command, cwd=BENCHMARKS, capture_output=True, text=True, check=False)
    assert loaded.returncode == 0, loaded.stderr
