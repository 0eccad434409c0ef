"""Kernels are compiled by several processes before a run calls them."""

import multiprocessing
import os
import sys

import pytest

from service.cli import compile_ahead, kernel_signatures, progress

AHEAD = """
import os, sys
from service.cli import compile_ahead, kernel_signatures, progress

class Lines(progress.Display):
    def progress(self, what, done, total):
        self.note(f"{what} {done} of {total}")

some = kernel_signatures.read()[-3:]
if sys.argv[1] == "wrong":
    some[1] = some[1]._replace(arguments=["int8"])
    some.append(kernel_signatures.Signature("voxel.nowhere", []))
kernel_signatures.read = lambda: some
compile_ahead._FEW = 1
os.cpu_count = lambda: 2
print(compile_ahead.run(Lines()), compile_ahead.run(Lines()), [each.name for each in compile_ahead.missing()])
"""


def compiled(lvba, folder, case):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder)}
    return lvba(case, program=("-c", AHEAD), env=environment)


def test_what_the_cache_lacks_is_compiled_once(lvba, tmp_path):
    done = compiled(lvba, tmp_path, "right")
    assert done.stdout.split() == ["3", "0", "[]"]
    assert "kernels compiled 3 of 3" in done.stderr


def test_a_kernel_that_has_changed_is_left_to_the_run(lvba, tmp_path):
    done = compiled(lvba, tmp_path, "wrong")
    changed = kernel_signatures.read()[-2].name
    assert done.stdout.split() == ["4", "2", f"['{changed}',", "'voxel.nowhere']"]


def test_code_of_another_python_is_none(tmp_path, monkeypatch):
    first, *others = kernel_signatures.read()
    version = f"py{sys.version_info.major}{sys.version_info.minor}"
    (tmp_path / f"{first.name}-12.{version}.nbi").touch()
    (tmp_path / f"{others[0].name}-12.py27.nbi").touch()
    monkeypatch.setattr(compile_ahead.kernel_cache, "place", lambda: tmp_path)
    assert compile_ahead.missing() == others


class StoppedError(Exception):
    pass


class Stopping(progress.Display):
    def progress(self, what, done, total):
        raise StoppedError


@pytest.fixture
def own_children():
    """The processes that have been started since the test began: other tests have theirs."""
    before = {process.pid for process in multiprocessing.active_children()}
    return lambda: [each for each in multiprocessing.active_children() if each.pid not in before]


def test_who_stops_the_run_stops_the_processes(monkeypatch, own_children):
    monkeypatch.setattr(compile_ahead, "missing", kernel_signatures.read)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    with pytest.raises(StoppedError):
        compile_ahead.run(Stopping(quiet=True))
    assert own_children() == []


def test_a_process_that_is_killed_is_not_waited_for(monkeypatch, own_children):
    monkeypatch.setattr(compile_ahead, "missing", lambda: kernel_signatures.read()[:20])
    monkeypatch.setattr(os, "cpu_count", lambda: 2)

    class Killing(progress.Display):
        def progress(self, what, done, total):
            for process in own_children():
                process.kill()

    assert compile_ahead.run(Killing(quiet=True)) < 20


def test_one_core_compiles_as_it_goes(monkeypatch, own_children):
    monkeypatch.setattr(compile_ahead, "missing", kernel_signatures.read)
    assert compile_ahead.run(progress.Display(quiet=True), threads=1) == 0
    assert own_children() == []
