"""Compiled code is that of the sources as they are."""

import subprocess
import sys
from pathlib import Path

INNER = """from lvba.kernels.compiled import kernel

@kernel
def inner() -> float:
    return {}
"""
OUTER = """import inner
from lvba.kernels.compiled import kernel

called = inner.inner

@kernel
def outer() -> float:
    return called()
"""


def result_of(folder):
    """What the kernel gives, and how many were taken from the cache, in a process of its own."""
    show = "import outer; print(outer.outer(), sum(outer.outer.stats.cache_hits.values()))"
    paths = [str(folder), str(Path(__file__).resolve().parent.parent)]
    code = f"import sys; sys.path[:0] = {paths}; {show}"
    words = [sys.executable, "-c", code]
    return subprocess.run(words, check=True, capture_output=True, text=True, cwd=folder).stdout.split()


def test_a_kernel_is_compiled_anew_when_one_that_it_calls_has_changed(tmp_path):
    (tmp_path / "outer.py").write_text(OUTER)
    (tmp_path / "inner.py").write_text(INNER.format(1.5))
    assert result_of(tmp_path) == ["1.5", "0"]
    assert result_of(tmp_path) == ["1.5", "1"]
    (tmp_path / "inner.py").write_text(INNER.format(2.5))
    assert result_of(tmp_path) == ["2.5", "0"]
