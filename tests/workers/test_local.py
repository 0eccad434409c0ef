"""Running a plan in one process over a store: reuse, interruption, records."""

import threading
from pathlib import Path

import numpy as np
import pytest

from lvba.plan import Plan
from lvba.trajectory import Trajectory
from workers import local
from workers.store import ZarrStore

CALLS: list[str] = []


def make(name, *inputs, fail=False):
    CALLS.append(name)
    if fail and FAIL:
        raise KeyboardInterrupt
    times = np.arange(3.0) + sum(t.times.sum() for t in inputs)
    # Fortran order on purpose: a reloaded artifact is C-ordered
    return Trajectory(times, np.asfortranarray(np.random.default_rng(len(name)).normal(size=(3, 4, 4))))


def reduce(*inputs):
    CALLS.append("reduce")
    return {"sum": [float((t.world_from_sensor @ t.world_from_sensor).sum()) for t in inputs]}


FAIL = False
NAMES = ["a", "bb", "ccc", "dddd"]


def chain(failing=""):
    work = Plan()
    refs: list = []
    for name in NAMES:
        refs.append(work.add(name, make, name, *refs, fail=name == failing))
    work.add("reduce", reduce, *refs)
    return work


@pytest.fixture(autouse=True)
def fresh_calls():
    CALLS.clear()


def contents(folder: Path):
    return {
        p.relative_to(folder).as_posix(): p.read_bytes()
        for p in sorted(folder.rglob("*"))
        if p.is_file() and p.name != "manifest.json"
    }


def test_records_of_a_run_and_of_its_repetition(tmp_path):
    first = local.run(chain(), ZarrStore(tmp_path))
    assert [r.name for r in first] == [*NAMES, "reduce"]
    assert not any(r.reused for r in first)
    assert all(r.peak_memory_mb > 1 and r.tasks == 1 for r in first)
    assert [*NAMES, "reduce"] == CALLS
    again = local.run(chain(), ZarrStore(tmp_path))
    assert all(r.reused for r in again)
    assert [r.seconds for r in again] == [r.seconds for r in first]
    assert [*NAMES, "reduce"] == CALLS


@pytest.mark.parametrize("name", NAMES)
def test_interrupted_in_any_step_it_goes_on_and_ends_with_the_same_bytes(tmp_path, monkeypatch, name):
    local.run(chain(name), ZarrStore(tmp_path / "undisturbed"))
    CALLS.clear()
    monkeypatch.setitem(globals(), "FAIL", True)
    with pytest.raises(KeyboardInterrupt):
        local.run(chain(name), ZarrStore(tmp_path / "interrupted"))
    monkeypatch.setitem(globals(), "FAIL", False)
    records = local.run(chain(name), ZarrStore(tmp_path / "interrupted"))
    done = NAMES.index(name)
    assert [r.reused for r in records] == [True] * done + [False] * (5 - done)
    assert [*NAMES[: done + 1], *NAMES[done:], "reduce"] == CALLS
    assert contents(tmp_path / "undisturbed") == contents(tmp_path / "interrupted")


class Slow(ZarrStore):
    """Writes the first artifact when the second step has begun, and none that is called by a name."""

    def __init__(self, folder, lacks=""):
        super().__init__(folder)
        self.began = threading.Event()
        self.lacks = lacks

    def put(self, key, value, facts):
        assert self.began.wait(60)
        if self.lacks and key.startswith(self.lacks):
            raise OSError(28, "no space left", str(self.folder))
        super().put(key, value, facts)


def begin_second(store):
    return lambda step, index, total: store.began.set() if index == 1 else None


def test_an_artifact_is_written_while_the_next_step_runs(tmp_path):
    store = Slow(tmp_path / "slow")
    local.run(chain(), store, on_step=begin_second(store))
    local.run(chain(), ZarrStore(tmp_path / "usual"))
    assert contents(tmp_path / "slow") == contents(tmp_path / "usual")
    assert store.held() == []


@pytest.mark.parametrize("name", [*NAMES, "reduce"])
def test_what_cannot_be_written_ends_the_run_and_what_was_written_before_stays(tmp_path, name):
    store = Slow(tmp_path, lacks=name)
    with pytest.raises(OSError, match="no space left"):
        local.run(chain(), store, on_step=begin_second(store))
    done = [*NAMES, "reduce"].index(name)
    assert sorted(key.split("-")[0] for key in store) == sorted([*NAMES, "reduce"][:done])


def test_interrupted_while_an_artifact_is_written_it_is_there(tmp_path, monkeypatch):
    monkeypatch.setitem(globals(), "FAIL", True)
    store = Slow(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        local.run(chain("bb"), store, on_step=begin_second(store))
    assert [key.split("-")[0] for key in store] == ["a"]


def test_only_what_is_damaged_is_made_again(tmp_path):
    work = chain()
    local.run(work, ZarrStore(tmp_path))
    before = contents(tmp_path)
    key = next(step.key for step in work.steps.values() if step.name == "bb")
    (tmp_path / key / "zarr.json").write_text("{")
    CALLS.clear()
    local.run(work, ZarrStore(tmp_path))
    assert CALLS == ["bb"]
    assert contents(tmp_path) == before


def test_artifacts_are_dropped_from_memory_after_their_last_use(tmp_path):
    store = ZarrStore(tmp_path)
    held = []
    local.run(chain(), store, on_step=lambda step, index, total: held.append(len(store._values)))
    assert held == [0, 1, 2, 3, 4]
    assert store._values == {}


def test_steps_are_announced(tmp_path):
    told = []
    local.run(chain(), ZarrStore(tmp_path), on_step=lambda step, i, n: told.append((step.name, i, n)))
    assert told[0] == ("a", 0, 5)
    assert told[-1] == ("reduce", 4, 5)


def test_peak_memory_is_that_of_the_step():
    local.reset_peak_memory()
    base = local.peak_memory_mb()
    block = np.ones(25_000_000)
    assert local.peak_memory_mb() - base > 150
    del block
    local.reset_peak_memory()
    assert local.peak_memory_mb() - base < 100


def add(first, *others):
    return first + sum(others)


def test_what_is_held_for_later_steps_is_bounded_and_the_result_the_same(tmp_path, monkeypatch):
    """Ten large artifacts, each needed by a step of its own later, whose results and they are needed at the end."""
    work = Plan()
    large = [work.add(f"large{n}", np.full, (1000, 100), float(n)) for n in range(10)]
    late = [work.add(f"late{n}", add, ref, 1.0) for n, ref in enumerate(large)]
    work.add("all", add, *large, *late)
    held = []
    monkeypatch.setattr(local, "HELD_BYTES", 3_000_000)
    store = ZarrStore(tmp_path / "little")
    local.run(work, store, on_step=lambda *_: held.append(sum(store.size(key) for key in store.held())))
    assert 2_000_000 < max(held) < 5_000_000  # of 16 million
    assert store.held() == []
    monkeypatch.undo()
    local.run(work, ZarrStore(tmp_path / "much"))
    assert contents(tmp_path / "little") == contents(tmp_path / "much")
