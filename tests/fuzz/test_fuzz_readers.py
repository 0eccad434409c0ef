"""A short pass of the fuzzer over every reader, and proof that it sees what it is there to see."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import fuzz_readers
import numpy as np
import pytest
from fuzz_readers import CASE_S, Fuzzer, summary
from fuzz_targets import TARGETS, Target

from lvba.errors import InputError

HERE = Path(__file__).parent


def test_readers_refuse_or_give_something_sound(tmp_path):
    words = [sys.executable, str(HERE / "fuzz_readers.py"), "--cases", "60", "--found", str(tmp_path)]
    environment = {**os.environ, "PYTHONPATH": str(HERE.parents[1])}
    done = subprocess.run(words, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, (
        done.stdout + done.stderr + str([p.read_text() for p in tmp_path.rglob("WHAT.txt")])
    )
    rows = dict(line.split(maxsplit=1) for line in done.stdout.splitlines()[2:])
    assert list(rows) == [*TARGETS, "all"]
    for name in TARGETS:
        cases, accepted, refused, _, found = map(int, rows[name].split())
        assert cases == 60
        assert accepted > 0, name
        assert refused > 0, name
        assert found == 0


def _refuse(folder: Path) -> None:
    raise InputError(folder, "is refused", "so it is")


def _mistake(folder: Path) -> None:
    if (folder / "a").read_bytes() != b"good":
        raise KeyError("nobody expected this")


def _greed(folder: Path) -> None:
    if (folder / "a").read_bytes() != b"good":
        np.ones(400 << 20, np.uint8)


def _lie(folder: Path) -> None:
    if (folder / "a").read_bytes() != b"good":
        np.empty(1 << 40, np.uint8)


def _death(folder: Path) -> None:
    if (folder / "a").read_bytes() != b"good":
        signal.raise_signal(signal.SIGSEGV)


def _hang(folder: Path) -> None:
    began = time.process_time()
    while (folder / "a").read_bytes() != b"good" and time.process_time() < began + 10 * CASE_S:
        pass


@pytest.mark.parametrize(
    ("read", "cases", "seconds", "what"),
    [
        (_mistake, 3, CASE_S, "KeyError at"),
        (_greed, 1, CASE_S, "memory"),
        (_lie, 3, CASE_S, "MemoryError at"),
        (_death, 1, CASE_S, "SIGSEGV"),
        (_hang, 1, CASE_S / 10, "SIGPROF"),
    ],
)
def test_what_a_reader_must_not_do_is_found_once_and_its_input_kept(
    read, cases, seconds, what, tmp_path, monkeypatch
):
    """seconds: that it may take"""
    monkeypatch.setattr(fuzz_readers, "CASE_S", seconds)
    fuzzer = Fuzzer({"x": Target(lambda _: [{"a": b"good"}], read)}, tmp_path / "found", tmp_path / "work")
    fuzzer.batch("x", cases)
    [found] = fuzzer.tallies["x"].found
    assert what in found
    [kept] = (tmp_path / "found").iterdir()
    assert (kept / "a").read_bytes() != b"good"
    assert what in (kept / "WHAT.txt").read_text()
    assert found in summary(fuzzer.tallies)


def test_what_is_refused_for_a_new_reason_is_a_new_start(tmp_path):
    def read(folder: Path) -> None:
        if (folder / "a").read_bytes() != b"good":
            _refuse(folder)

    fuzzer = Fuzzer({"x": Target(lambda _: [{"a": b"good"}], read)}, tmp_path / "found", tmp_path / "work")
    fuzzer.batch("x", 5)
    tally = fuzzer.tallies["x"]
    assert tally.reasons == {"is refused"}
    assert len(tally.corpus) == 2
    assert tally.found == []
